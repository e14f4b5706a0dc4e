"""Shards of synthetic sessions with exact labels: each visible vehicle is labelled from the corners of its 3D box.

    python -m labelgen.synth.truth.shards SESSION... --out DIR [--pair VP2-VP3] [--size 480x270] [--quality 95]

The labels of `labelgen bcs-masks` go through masks instead and leave out vehicles off the road mask. A detector that is
trained or judged on exact labels meets neither of these two sources of error. Vehicles that show too little for a label
are ignored boxes.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from labelgen.atomic_files import make_folder
from labelgen.datasets.scene import find_scene
from labelgen.errors import LabelgenError
from labelgen.geometry import Pair, Rectification, Region, encode_boxes, parse_size
from labelgen.geometry.homography import bounding_boxes
from labelgen.labels import Flag, IgnoredBoxes, IgnoreReason, Labels, Sample
from labelgen.media.open_frames import open_frames
from labelgen.shards import ShardWriter
from labelgen.shards.image_codec import ImageCodec

__all__ = ["EXACT_LABEL_LIMITS", "ExactLabelLimits", "exact_labels", "main", "write_session_shard"]


@dataclass(frozen=True)
class ExactLabelLimits:
    """Which vehicles of a frame get a label. Lower limits give more labels, of vehicles that show less."""

    min_height_px: float = 10.0
    """Least height of a label's box in the rectified image, px."""
    min_width_px: float = 2.0
    """Least width of a label's box in the rectified image, px."""
    min_inside: float = 0.15
    """Least share of a vehicle's box that lies in the rectified image and in the frame."""
    min_visible: float = 0.3
    """Least share of a vehicle's pixels that nothing hides."""


EXACT_LABEL_LIMITS = ExactLabelLimits()


def exact_labels(
    vehicles: Sequence[dict[str, Any]], rectification: Rectification, limits: ExactLabelLimits = EXACT_LABEL_LIMITS
) -> tuple[Labels, IgnoredBoxes]:
    """Label the vehicles of one frame.

    Boxes are cut at the border of the rectified image. Those that are cut there or by the frame's border carry
    `Flag.TRUNCATED`.

    Args:
        vehicles: entries of a line of `truth/NAME/boxes.jsonl`.
        rectification: with the frame's size.
        limits: which vehicles are left out.

    Returns:
        the labels, and the boxes of the vehicles that are left out and yet show in the image.
    """
    if not vehicles:
        return Labels.empty(), IgnoredBoxes.empty()
    corners = np.array([vehicle["vertices_px"] for vehicle in vehicles])
    visible = np.array([1.0 if vehicle["visible"] is None else vehicle["visible"] for vehicle in vehicles])
    assert rectification.frame_wh is not None
    rectified = rectification.points(corners)
    finite = np.isfinite(rectified).all(axis=(1, 2))
    corners, rectified, visible = corners[finite], rectified[finite], visible[finite]
    encoded = encode_boxes(rectified, rectification.vpu)
    boxes_xyxy = encoded.boxes_xyxy
    cut_xyxy = _cut(boxes_xyxy, rectification.size_wh)
    frame_xyxy = bounding_boxes(corners)
    inside = np.minimum(
        _area(cut_xyxy) / _area(boxes_xyxy), _area(_cut(frame_xyxy, rectification.frame_wh)) / _area(frame_xyxy)
    )
    width, height = (cut_xyxy[:, 2:] - cut_xyxy[:, :2]).T
    left_out = {
        IgnoreReason.CUT: inside < limits.min_inside,
        IgnoreReason.TOO_SMALL: (height < limits.min_height_px) | (width < limits.min_width_px),
        IgnoreReason.NO_3D_BOX: (encoded.cc < 0) | (encoded.cc > 1),
        IgnoreReason.OTHER: visible < limits.min_visible,
    }
    keep = ~np.any(list(left_out.values()), axis=0)
    reasons = np.select(list(left_out.values()), [int(reason) for reason in left_out])
    shows = ~keep & (inside > 0) & (visible > 0) & (width > 0) & (height > 0)
    flags = (Flag.TRUNCATED * (inside < 0.999)).astype(np.uint16)
    # Shards store float32, in which a box of no width may come out.
    ignored_xyxy = cut_xyxy[shows].astype(np.float32).astype(np.float64)
    solid = (ignored_xyxy[:, :2] < ignored_xyxy[:, 2:]).all(axis=1)
    return (
        Labels(cut_xyxy[keep], encoded.cc[keep], flags=flags[keep]),
        IgnoredBoxes(ignored_xyxy[solid], reasons[shows][solid]),
    )


def _cut(boxes_xyxy: Any, size_wh: Sequence[float]) -> Any:
    """Cut boxes (N, 4) at the border of an image."""
    size = np.asarray(size_wh, dtype=np.float64)
    return np.concatenate([np.clip(boxes_xyxy[:, :2], 0, size), np.clip(boxes_xyxy[:, 2:], 0, size)], axis=1)


def _area(boxes_xyxy: Any) -> Any:
    return np.prod(boxes_xyxy[:, 2:] - boxes_xyxy[:, :2], axis=1)


def write_session_shard(
    session: Path, out: Path, number: int, pair: Pair, size_wh: tuple[int, int], codec: ImageCodec
) -> int:
    """Write the shard of one session with exact labels.

    Args:
        session: folder ROOT/dataset/NAME of a synthetic session.
        out: folder of the shard.
        number: of the shard, for its name.
        pair, size_wh: the rectification; px.
        codec: how images are stored.

    Returns:
        Number of labels in the shard.
    """
    scene = find_scene(session)
    assert scene.frames_path is not None
    frames = open_frames(scene.frames_path)
    camera = scene.camera(frames.size_wh)
    rectification = Rectification.from_road_mask(camera, scene.road(frames.size_wh), pair, size_wh)
    truth = session.resolve().parents[1] / "truth" / scene.name / "boxes.jsonl"
    settings = {
        "kind": "exact",
        "region": str(Region.ROAD),
        "min_height_px": EXACT_LABEL_LIMITS.min_height_px,
        **codec.describe(),
    }
    path = out / f"shard-{number:03d}-{scene.name}-00000.h5"
    with ShardWriter(path, pair, size_wh, source=scene.name, settings=settings) as writer, truth.open() as lines:
        for frame, line in zip(frames.frames(), lines, strict=False):
            labels, ignored = exact_labels(json.loads(line)["vehicles"], rectification)
            if len(labels):
                image = codec.encode(rectification.warp_image(frame.image))
                window = np.array([0.0, 0.0, *frames.size_wh])
                sample = Sample(
                    image, labels, rectification, camera, scene.name, frame.number, frame.time_s, window_xyxy=window
                )
                writer.add(replace(sample, ignored=ignored))
        writer.last = True
    return writer.labels


def main(
    sessions: Annotated[
        list[Path], typer.Argument(metavar="SESSION...", help="Folders ROOT/dataset/NAME of synthetic sessions.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Where the shards go, one per session.")],
    pair: Annotated[str, typer.Option("--pair", help="Pair of vanishing points.")] = "VP2-VP3",
    size: Annotated[str, typer.Option("--size", metavar="WxH", help="Size of the rectified frames.")] = "480x270",
    quality: Annotated[int, typer.Option("--quality", help="JPEG quality.")] = 95,
) -> None:
    """Write shards of synthetic sessions with exact labels."""
    size_wh, codec = parse_size(size), ImageCodec(quality)
    make_folder(out)
    for number, session in enumerate(sessions):
        count = write_session_shard(session, out, number, Pair.parse(pair), size_wh, codec)
        typer.echo(f"{session}: {count} labels")


if __name__ == "__main__":
    try:
        typer.run(main)
    except LabelgenError as err:
        raise SystemExit(f"error: {err}") from None
