"""A shuffled sheet of vehicles cut from a real and a synthetic video: can you tell which are which?

    python -m tools.lookalike_sheet REAL.mp4 SYNTHETIC.avi --out sheet.png --key key.json

Both videos are treated alike: vehicles are what differs from the median picture. The answer goes into the key alone.
The sheet shows parts of the real video: whether you may pass it on depends on that video's licence.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any
from zlib import crc32

import typer

from labelgen.errors import DataError, LabelgenError

__all__ = ["main", "vehicle_crops"]


def vehicle_crops(video: Path, count: int, seed: int, min_px: int) -> list[Any]:
    """`count` crops (h, w, 3) uint8 BGR of moving things whose shorter side has at least `min_px`.

    Different ones as far as there are any.

    Raises:
        DataError: the video cannot be read, or too little moves in it.
    """
    import av
    import cv2
    import numpy as np

    rng = np.random.default_rng(seed)
    try:
        with av.open(str(video)) as container:
            frames = [f.to_ndarray(format="bgr24") for k, f in enumerate(container.decode(video=0)) if k % 8 == 0][:200]
    except (OSError, ValueError) as err:
        raise DataError(f"{video}: not a readable video ({err})") from None
    if len(frames) < 5:
        raise DataError(f"{video}: too short; it takes at least 40 frames")
    median = np.median(np.stack(frames[:: max(1, len(frames) // 40)]), axis=0).astype(np.uint8)
    crops: list[Any] = []
    again: list[Any] = []
    for k in rng.permutation(len(frames)):
        change = cv2.absdiff(frames[k], median).max(axis=2)
        mask = cv2.morphologyEx((change > 30).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((15, 15), np.uint8))
        _, _, stats, _ = cv2.connectedComponentsWithStats(mask)
        fits = [s for s in stats[1:] if _looks_whole(s, frames[k].shape, min_px)]
        if fits:
            x, y, w, h, _ = (int(v) for v in fits[int(rng.integers(len(fits)))])
            pad = int(0.12 * max(w, h))
            crop = frames[k][max(0, y - pad) : y + h + pad, max(0, x - pad) : x + w + pad]
            (again if any(_same(crop, other) for other in crops) else crops).append(crop)
        if len(crops) == count:
            return crops
    if len(crops) + len(again) >= count:
        return [*crops, *again][:count]
    raise DataError(f"{video}: only {len(crops)} of {count} vehicles found; lower --min-px")


def _same(a: Any, b: Any) -> bool:
    """Whether two crops may show one vehicle: much the same colours at much the same places."""
    import cv2
    import numpy as np

    small = [cv2.resize(c, (8, 8), interpolation=cv2.INTER_AREA).astype(np.float32) for c in (a, b)]
    return float(np.abs(small[0] - small[1])[1:-1, 1:-1].mean()) < 16


def _looks_whole(stats: Any, shape: tuple[int, ...], min_px: int) -> bool:
    x, y, w, h, area = (int(v) for v in stats)
    inside = x > 2 and y > 2 and x + w < shape[1] - 2 and y + h < shape[0] - 2
    return inside and min(w, h) >= min_px and 0.45 < w / h < 2.2 and area > 0.5 * w * h


def main(
    real: Annotated[Path, typer.Argument(help="A real video.")],
    synthetic: Annotated[Path, typer.Argument(help="A synthetic video.")],
    out: Annotated[Path, typer.Option("--out", help="The sheet, a picture.")],
    key: Annotated[Path, typer.Option("--key", help="The answer, JSON.")],
    count: Annotated[int, typer.Option(min=1, help="Vehicles of each kind.")] = 5,
    seed: Annotated[int, typer.Option(help="Choice and order.")] = 0,
    min_px: Annotated[int, typer.Option(help="Shorter side of a crop at least, px.")] = 60,
) -> None:
    """Make a shuffled sheet of real and synthetic vehicles."""
    import cv2
    import numpy as np

    tiles = [(crop, "real") for crop in vehicle_crops(real, count, seed, min_px)]
    tiles += [(crop, "synthetic") for crop in vehicle_crops(synthetic, count, seed, min_px)]
    # Sheets of several videos with one seed are not to have the same order.
    rng = np.random.default_rng([seed, 9, crc32(real.name.encode())])
    order = rng.permutation(len(tiles))
    side, across = 300, 5
    sheet = np.full((-(-len(tiles) // across) * side, across * side, 3), 40, dtype=np.uint8)
    answer = {}
    for place, k in enumerate(order.tolist()):
        crop, kind = tiles[k]
        if rng.random() < 0.5:  # roads are not to be known by their markings
            crop = crop[:, ::-1]
        scale = (side - 10) / max(crop.shape[:2])
        picture = cv2.resize(
            crop, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
        )
        y, x = place // across * side, place % across * side
        sheet[y : y + picture.shape[0], x : x + picture.shape[1]] = picture
        cv2.putText(sheet, str(place + 1), (x + 6, y + side - 12), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (255, 255, 255), 1)
        answer[str(place + 1)] = kind
    cv2.imwrite(str(out), sheet)
    key.write_text(json.dumps(answer, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    try:
        typer.run(main)
    except LabelgenError as err:
        raise SystemExit(f"error: {err}") from None
