"""Check that masks, 3D boxes and pixels of a synthetic session agree.

    python -m tools.studies.check_truth ROOT/dataset/session0_center

Measured for each vehicle that nothing hides and that lies inside the frame:
    inside    share of its mask's pixels (centres) inside the projected 3D box
    outline   largest distance between the four sides of its mask's bounding box and of its projected mesh, px
    sides     the same against the projected 3D box; small only for vehicles that are boxes themselves
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from labelgen.errors import DataError, LabelgenError

__all__ = ["check_session", "main"]


def check_session(session: Path) -> dict[str, Any]:
    """Measure how well masks, 3D boxes and pixels agree.

    Args:
        session: ROOT/dataset/NAME.

    Returns:
        Arrays (N,) over all unhidden vehicles inside the frame: `inside` (share), `outline` and `sides` (px), `kind`.

    Raises:
        DataError: there is no truth for the session.
    """
    import cv2
    import numpy as np
    from pycocotools import mask as coco

    folder = session.resolve().parent.parent / "truth" / session.resolve().name
    if not (folder / "masks.json").exists():
        raise DataError(f"{folder}: no truth there; name a session written by `labelgen synth session`")
    data = json.loads((folder / "masks.json").read_text(encoding="utf-8"))
    width, height = data["images"][0]["width"], data["images"][0]["height"]
    masks = {(a["image_id"], a["track_id"]): a for a in data["annotations"]}
    measured: dict[str, list[Any]] = {"kind": [], "inside": [], "outline": [], "sides": []}
    for line in (folder / "boxes.jsonl").read_text(encoding="utf-8").splitlines():
        frame = json.loads(line)
        for vehicle in frame["vehicles"]:
            outline, box = np.array(vehicle["outline_xyxy_px"]), np.array(vehicle["vertices_px"])
            in_picture = (outline[:2] > 1).all() and (outline[2:] < (width - 1, height - 1)).all()
            if not in_picture or vehicle["visible"] < 1:
                continue
            annotation = masks[frame["frame"], vehicle["track_id"]]
            x, y, w, h = annotation["bbox"]
            pixels = np.argwhere(coco.decode(annotation["segmentation"])[y : y + h, x : x + w])[:, ::-1] + (x, y)
            hull = cv2.convexHull(box.astype(np.float32))[:, 0]
            ahead = np.roll(hull, -1, axis=0) - hull
            from_corner = pixels[:, None] + 0.5 - hull
            side = ahead[:, 0] * from_corner[..., 1] - ahead[:, 1] * from_corner[..., 0]
            inside = (side >= 0).all(axis=1) | (side <= 0).all(axis=1)
            mask_box = np.array([x, y, x + w, y + h])
            measured["kind"].append(vehicle["kind"])
            measured["inside"].append(float(inside.mean()))
            measured["outline"].append(float(np.abs(mask_box - outline).max()))
            box_xyxy = np.concatenate([box.min(axis=0), box.max(axis=0)])
            measured["sides"].append(float(np.abs(mask_box - box_xyxy).max()))
    return {key: np.array(values) for key, values in measured.items()}


def main(
    sessions: Annotated[list[Path], typer.Argument(help="Folders ROOT/dataset/NAME of synthetic sessions.")],
) -> None:
    """Print how well masks, 3D boxes and pixels agree."""
    import numpy as np

    for session in sessions:
        measured = check_session(session)
        count = len(measured["kind"])
        if not count:
            typer.echo(f"{session.name}: no unhidden vehicle lies inside the picture")
            continue
        typer.echo(
            f"{session.name}: {count} vehicles; mask inside the box by >= 99.5 %: "
            f"{np.mean(measured['inside'] >= 0.995):.2%} (least {measured['inside'].min():.2%}); "
            f"mask's bounding box within 2 px of the mesh's: {np.mean(measured['outline'] <= 2):.2%}; "
            f"of the 3D box's: {np.mean(measured['sides'] <= 2):.2%}"
        )


if __name__ == "__main__":
    try:
        typer.run(main)
    except LabelgenError as err:
        raise SystemExit(f"error: {err}") from None
