"""Throughput of labels through an ONNX network against the calls they cannot avoid, side by side in one run.

    python -m tools.benchmarks.onnx_masks NETWORK VIDEO_OR_SESSION [--frames 40] [--every 10]

Bare: decode, letterbox, session run. Labels: the same frames through `create_mask_source`, `label_masks`, the warp and
the JPEG of the rectified picture. Frames alternate between the two sides, and both are timed by processor time, which
other work on the machine disturbs least. The network's pictures must be of a fixed size, letterboxed.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.datasets.scene import find_scene
from labelgen.geometry import Pair, Rectification, Region
from labelgen.labeling.from_masks import label_masks
from labelgen.masks import MaskOptions, create_mask_source
from labelgen.shards.image_codec import ImageCodec

__all__ = ["compare", "main"]


def _bare_call(session: Any, image: NDArray[np.uint8]) -> None:
    name, (_, _, height, width) = session.get_inputs()[0].name, session.get_inputs()[0].shape
    scale = min(width / image.shape[1], height / image.shape[0])
    inner = round(image.shape[1] * scale), round(image.shape[0] * scale)
    canvas = np.full((height, width, 3), 114, dtype=np.uint8)
    x, y = (width - inner[0]) // 2, (height - inner[1]) // 2
    canvas[y : y + inner[1], x : x + inner[0]] = cv2.resize(image, inner)
    session.run(None, {name: cv2.dnn.blobFromImage(canvas, 1 / 255, swapRB=True)})


def compare(
    network: Path, video: Path, *, frames: int = 40, every: int = 10, tiles: str | None = None
) -> dict[str, Any]:
    """Return processor seconds of both sides, their ratio, and the number of labels.

    Args:
        network: ONNX file.
        video: with its calibration and road mask.
        frames: number of frames.
        every: every so many-th frame of the video is taken.
        tiles: see `labelgen.masks.MaskOptions`; the bare side runs the network once a frame in any case.
    """
    import onnxruntime

    scene = find_scene(video).open()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(network), options, providers=["CPUExecutionProvider"])
    source = create_mask_source(
        f"onnx:{network}", score_threshold=0.3, device="cpu", camera=scene.camera, road_mask=scene.road.pixels,
        options=MaskOptions(tiles=tiles),
    )  # fmt: skip
    rectification = Rectification.of_region(Region.ROAD, scene.camera, scene.road, Pair.VP2_VP3, (640, 360))
    codec, seconds, labels, taken = ImageCodec(), {"decode": 0.0, "bare": 0.0, "labels": 0.0}, 0, 0
    start = time.process_time()
    for frame in scene.frames.frames(lambda number: number % every == 0):
        decoded = time.process_time()
        masks = source.masks([frame.image])[0]
        found, _, _ = label_masks(masks, rectification, scene.camera, scene.road.pixels)
        codec.encode(rectification.warp_image(frame.image))
        labelled = time.process_time()
        _bare_call(session, frame.image)
        taken += 1
        if taken > 1:  # the first run warms caches
            labels += len(found)
            seconds["decode"] += decoded - start
            seconds["labels"] += labelled - decoded
            seconds["bare"] += time.process_time() - labelled
        if taken > frames:
            break
        start = time.process_time()
    bare, whole = (seconds["decode"] + seconds[side] for side in ("bare", "labels"))
    return {
        "frames": taken - 1, "labels": labels, "bare_s": bare, "labels_s": whole, "decode_s": seconds["decode"],
        "labels_per_s": labels / whole, "ratio": bare / whole,
    }  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("network", type=Path)
    parser.add_argument("video", type=Path)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--every", type=int, default=10)
    parser.add_argument("--tiles")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    report = compare(given.network, given.video, frames=given.frames, every=given.every, tiles=given.tiles)
    print(json.dumps(report, indent=1))
    if given.json:
        given.json.write_text(json.dumps(report))


if __name__ == "__main__":
    main()
