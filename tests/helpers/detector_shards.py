"""Small shards of painted boxes on a road, with exact labels, for the detector's tests."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from labelgen.geometry import Camera, Pair, Rectification, encode_boxes, road_cuboids
from labelgen.labels import Labels, Sample
from labelgen.shards import ShardWriter

CAMERA = Camera(
    np.array([-133.0, -167.0]), np.array([2433.0, -300.0]), np.array([320.0, 180.0]), 0.06, (640, 360), "cam"
)
ROAD_PX = (140.0, 40.0, 470.0, 230.0)
_FACES = ((0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7), (0, 1, 2, 3))


def painted_sample(
    seed: int, size_wh: tuple[int, int] = (160, 96), pair: Pair = Pair.VP2_VP3, frame: int = -1
) -> Sample:
    """One rectified picture with one to three boxes, near the middle so that none is cut."""
    rng = np.random.default_rng([11, seed])
    rectification = Rectification.from_window(CAMERA, ROAD_PX, pair, size_wh)
    image = np.full((size_wh[1], size_wh[0], 3), 105, np.uint8) + rng.integers(
        0, 12, (size_wh[1], size_wh[0], 1), np.uint8
    )
    lanes = rng.permutation([-9.0, -14.0, -19.0])[: rng.integers(1, 4)]
    near = np.stack([rng.uniform(24, 34, len(lanes)), lanes + rng.uniform(-0.5, 0.5, len(lanes))], axis=1)
    sizes = np.stack(
        [rng.uniform(3.6, 5.2, len(lanes)), np.full(len(lanes), 1.9), rng.uniform(1.3, 2.2, len(lanes))], axis=1
    )
    vertices = rectification.points(CAMERA.project(road_cuboids(near, sizes)))
    keep = [bool(np.isfinite(v).all() and (v > 1).all() and (v < np.array(size_wh) - 1).all()) for v in vertices]
    for box in vertices[keep]:
        colour = rng.integers(0, 255, 3).astype(float)
        # Far faces first: those that turn away are painted over.
        for face in sorted(_FACES, key=lambda f: box[list(f), 1].mean()):
            shade = 0.5 + 0.5 * _FACES.index(face) / 4
            points = np.round((box[list(face)] - 0.5) * 16).astype(np.int32)
            cv2.fillConvexPoly(image, points, (colour * shade).tolist(), cv2.LINE_AA, 4)
    encoded = encode_boxes(vertices[keep], rectification.vpu)
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
    labels = Labels(encoded.boxes_xyxy, np.clip(encoded.cc, 0, 1))
    return Sample(data, labels, rectification, CAMERA, "painted", seed if frame < 0 else frame, seed / 25)


def write_painted_shards(
    folder: Path, samples: int, *, seed: int = 0, size_wh: tuple[int, int] = (160, 96), pair: Pair = Pair.VP2_VP3,
    kind: str = "exact",
) -> Path:  # fmt: skip
    """A folder with one shard of `samples` pictures that show at least one box."""
    folder.mkdir(parents=True, exist_ok=True)
    with ShardWriter(folder / "shard-00000.h5", pair, size_wh, source="painted", settings={"kind": kind}) as writer:
        number = 0
        while len(writer) < samples:
            sample = painted_sample(1000 * seed + number, size_wh, pair)
            if len(sample.labels):
                writer.add(sample)
            number += 1
        writer.last = True
    return folder
