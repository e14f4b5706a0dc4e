"""Shards of synthetic sessions with the exact truth: every visible vehicle, its label from the corners of its 3D box.

What `labelgen bcs-masks` makes of the same session goes through masks, and leaves out vehicles off the road mask; a
detector is trained and judged more sharply on labels without either.

    python -m labelgen.synth.truth.shards SESSION... --out DIR [--pair VP2-VP3] [--size 480x270] [--quality 95]
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from labelgen.atomic_files import make_folder
from labelgen.datasets.scene import find_scene
from labelgen.geometry import Pair, Rectification, Region, encode_boxes, parse_size
from labelgen.geometry.homography import bounding_boxes
from labelgen.labels import Flag, Labels, Sample
from labelgen.media.open_frames import open_frames
from labelgen.shards import ShardWriter
from labelgen.shards.image_codec import ImageCodec

MIN_HEIGHT_PX = 10.0
MIN_SHOWN = 0.15
MIN_VISIBLE = 0.3


def exact_labels(vehicles: Sequence[dict[str, Any]], rectification: Rectification) -> Labels:
    """Labels of one frame of `truth/NAME/boxes.jsonl`.

    Left out: vehicles less than `MIN_VISIBLE` of which are seen past others, less than `MIN_SHOWN` of whose box lies in
    the picture, or which are lower than `MIN_HEIGHT_PX`. Boxes are cut at the picture's border; then, and where the
    frame's border cuts them, they carry `Flag.TRUNCATED`.
    """
    seen = [vehicle for vehicle in vehicles if vehicle["visible"] is None or vehicle["visible"] >= MIN_VISIBLE]
    if not seen:
        return Labels.empty()
    corners = np.array([vehicle["vertices_px"] for vehicle in seen])
    assert rectification.frame_wh is not None
    rectified = rectification.points(corners)
    keep = np.isfinite(rectified).all(axis=(1, 2))
    corners, rectified = corners[keep], rectified[keep]
    encoded = encode_boxes(rectified, rectification.vpu)
    boxes, size = encoded.boxes_xyxy, np.array(rectification.size_wh, dtype=np.float64)
    cut = np.concatenate([np.clip(boxes[:, :2], 0, size), np.clip(boxes[:, 2:], 0, size)], axis=1)
    frame = bounding_boxes(corners)
    frame_wh = np.asarray(rectification.frame_wh, dtype=np.float64)
    shown = np.concatenate([np.clip(frame[:, :2], 0, frame_wh), np.clip(frame[:, 2:], 0, frame_wh)], axis=1)
    share = np.minimum(_area(cut) / _area(boxes), _area(shown) / _area(frame))
    keep = (share >= MIN_SHOWN) & (cut[:, 3] - cut[:, 1] >= MIN_HEIGHT_PX) & (cut[:, 2] - cut[:, 0] >= 2)
    keep &= (encoded.cc >= 0) & (encoded.cc <= 1)
    flags = (Flag.TRUNCATED * (share < 0.999)).astype(np.uint16)
    return Labels(cut[keep], encoded.cc[keep], flags=flags[keep])


def _area(boxes: Any) -> Any:
    return np.prod(boxes[:, 2:] - boxes[:, :2], axis=1)


def write_session_shard(
    session: Path, out: Path, number: int, pair: Pair, size_wh: tuple[int, int], codec: ImageCodec
) -> int:
    """One shard of a session folder (ROOT/dataset/NAME); returns how many labels it holds."""
    scene = find_scene(session)
    assert scene.frames_path is not None
    frames = open_frames(scene.frames_path)
    camera = scene.camera(frames.size_wh)
    rectification = Rectification.from_road_mask(camera, scene.road(frames.size_wh), pair, size_wh)
    truth = session.resolve().parents[1] / "truth" / scene.name / "boxes.jsonl"
    settings = {"kind": "exact", "region": str(Region.ROAD), "min_height_px": MIN_HEIGHT_PX, **codec.describe()}
    path = out / f"shard-{number:03d}-{scene.name}-00000.h5"
    with ShardWriter(path, pair, size_wh, source=scene.name, settings=settings) as writer, truth.open() as lines:
        for frame, line in zip(frames.frames(), lines, strict=False):
            labels = exact_labels(json.loads(line)["vehicles"], rectification)
            if len(labels):
                image = codec.encode(rectification.warp_image(frame.image))
                window = np.array([0.0, 0.0, *frames.size_wh])
                writer.add(
                    Sample(
                        image, labels, rectification, camera, scene.name, frame.number, frame.time_s, window_xyxy=window
                    )
                )
        writer.last = True
    return writer.labels


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sessions", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--pair", default="VP2-VP3")
    parser.add_argument("--size", default="480x270")
    parser.add_argument("--quality", type=int, default=95, help="of the JPEGs")
    given = parser.parse_args(arguments)
    out, size_wh, codec = make_folder(given.out), parse_size(given.size), ImageCodec(given.quality)
    for number, session in enumerate(given.sessions):
        count = write_session_shard(session, out, number, Pair.parse(given.pair), size_wh, codec)
        print(f"{session}: {count} labels")


if __name__ == "__main__":
    main()
