"""Small samples and shards for tests."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from labelgen.geometry import Camera, Pair, Rectification
from labelgen.labels import IgnoredBoxes, Labels, Sample, Split
from labelgen.shards import Reject, ShardWriter

SIZE = (64, 36)
CAMERA = Camera(np.array([269.2, -43.6]), np.array([12914.9, -43.6]), np.array([320.0, 180.0]), 0.05, (640, 360), "cam")


def make_sample(seed: int, labels: int = 2, *, camera: Camera = CAMERA, source: str = "clip") -> Sample:
    """A sample of noise with valid labels."""
    rng = np.random.default_rng(seed)
    rectification = Rectification.from_window(camera, [40, 60, 600, 350], Pair.VP2_VP3, SIZE)
    low = rng.uniform(0, 20, (labels, 2))
    boxes = np.concatenate([low, low + rng.uniform(8, 15, (labels, 2))], axis=1)
    image = rng.integers(0, 255, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
    encoded = cv2.imencode(".png", image)[1].tobytes()
    flags = rng.integers(0, 2, labels) * 16
    return Sample(
        encoded,
        Labels(boxes, rng.uniform(0.3, 0.7, labels), rng.integers(0, 5, labels), rng.uniform(0.5, 1, labels), flags),
        rectification,
        camera,
        source,
        25 * seed,
        seed / 25,
        Split.TRAIN,
        np.array([0.0, 0.0, 640.0, 360.0]),
        IgnoredBoxes(boxes[:1] + 1, [seed % 6]) if seed % 2 == 0 else IgnoredBoxes.empty(),
    )


def write_shard(path: Path, samples: int = 3, *, seed: int = 0, rejects: int = 1, last: bool = True) -> ShardWriter:
    """A small valid shard."""
    with ShardWriter(path, Pair.VP2_VP3, SIZE, source="clip", settings={"kind": "test", "seed": seed}) as writer:
        for i in range(samples):
            writer.add(make_sample(seed + i, labels=i % 3 + 1))
        for i in range(rejects):
            writer.reject(Reject("clip", i, -1, "too small", "ü"))
        writer.last = last
    return writer
