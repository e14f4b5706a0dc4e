"""Draw the truth of a synthetic session over its video: masks, 3D boxes, speeds.

python -m tools.studies.draw_truth ROOT/dataset/session0_center --out truth.avi
python -m tools.studies.draw_truth ROOT/dataset/session0_center --out truth.png --frame 40
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from labelgen.errors import DataError, LabelgenError

__all__ = ["draw_vehicle", "main"]

_EDGES = [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)]
_NEAR = {(0, 1), (4, 5), (0, 4), (1, 5)}


def draw_vehicle(image: Any, vehicle: dict[str, Any], mask: Any | None) -> None:
    """Draw one vehicle into a frame.

    Args:
        image: (H, W, 3) uint8 BGR, changed in place.
        vehicle: an entry of boxes.jsonl.
        mask: (H, W) bool, or None.
    """
    import cv2
    import numpy as np

    hue = (vehicle["track_id"] * 67) % 180
    colour = cv2.cvtColor(np.array([[[hue, 200, 255]]], dtype=np.uint8), cv2.COLOR_HSV2BGR)[0, 0].astype(int).tolist()
    if mask is not None:
        contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(image, contours, -1, colour, 1)
        image[mask] = (0.75 * image[mask] + 0.25 * np.array(colour)).astype(np.uint8)
    points = np.round(np.array(vehicle["vertices_px"]) * 16 - 8).astype(int).tolist()
    for a, b in _EDGES:
        tone = (0, 0, 255) if (a, b) in _NEAR else (255, 220, 0)
        cv2.line(image, tuple(points[a]), tuple(points[b]), tone, 1, cv2.LINE_AA, 4)
    x, y = (min(p[k] for p in points) // 16 for k in (0, 1))
    text = f"{vehicle['track_id']} {vehicle['kind']} {vehicle['speed_kmh']:.1f} km/h"
    cv2.putText(image, text, (max(x, 2), max(y - 6, 14)), cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1, cv2.LINE_AA)


def main(
    session: Annotated[Path, typer.Argument(help="Folder ROOT/dataset/NAME of a synthetic session.")],
    out: Annotated[Path, typer.Option("--out", help="A video (.avi) or, with --frame, a picture.")],
    frame: Annotated[int | None, typer.Option("--frame", help="Draw this frame alone.")] = None,
) -> None:
    """Draw the truth over a synthetic session's video."""
    import av
    import cv2
    import numpy as np
    from pycocotools.coco import COCO

    from labelgen.media.video_writer import VideoWriter

    folder = session.resolve().parent.parent / "truth" / session.resolve().name
    if not (folder / "boxes.jsonl").exists():
        raise DataError(f"{folder}: no truth there; name a session written by `labelgen synth session`")
    lines = [json.loads(line) for line in (folder / "boxes.jsonl").read_text(encoding="utf-8").splitlines()]
    coco = COCO(str(folder / "masks.json"))
    writer: VideoWriter | None = None
    with av.open(f"file:{session / 'video.avi'}") as container:
        for number, picture in enumerate(container.decode(video=0)):
            if frame is not None and number != frame:
                continue
            image = picture.to_ndarray(format="bgr24")
            masks = {a["track_id"]: coco.annToMask(a).astype(np.bool_) for a in coco.imgToAnns[number]}
            for vehicle in lines[number]["vehicles"]:
                draw_vehicle(image, vehicle, masks.get(vehicle["track_id"]))
            if frame is not None:
                cv2.imwrite(str(out), image)
                return
            if writer is None:
                size = (image.shape[1], image.shape[0])
                writer = VideoWriter(out, float(container.streams.video[0].average_rate or 25), size)
            writer.write(image)
    if writer is not None:
        writer.__exit__(None, None, None)


if __name__ == "__main__":
    try:
        typer.run(main)
    except LabelgenError as err:
        raise SystemExit(f"error: {err}") from None
