"""Short clips of cuboids on a road, with exact masks, for tests."""

from __future__ import annotations

import json
from pathlib import Path

import av
import cv2
import numpy as np
from pycocotools import mask as coco_mask

from labelgen.geometry import Camera, road_cuboids

SIZE = (640, 360)
# Three times the frame of a plausible full-HD camera, 11 m above the road, seen obliquely.
CAMERA = Camera(np.array([-133.0, -167.0]), np.array([2433.0, -300.0]), np.array([320.0, 180.0]), 0.06, SIZE, "clip")
ROAD_M = np.array([[20.0, -4.0], [20.0, -22.0], [70.0, -22.0], [70.0, -4.0]])


def road_mask() -> np.ndarray:
    """(360, 640) uint8."""
    mask = np.zeros(SIZE[::-1], np.uint8)
    cv2.fillConvexPoly(mask, np.round(CAMERA.project(ROAD_M)).astype(np.int32), 255)
    return mask


def vehicle_boxes(frame: int) -> np.ndarray:
    """(2, 8, 2) px, two cars that drive towards the camera, again and again."""
    x = 22.0 + (16.0 - 0.4 * frame) % 18.0
    near = np.array([[x, -9.0], [x + 5.0, -15.0]])
    return CAMERA.project(road_cuboids(near, np.array([[4.4, 1.8, 1.5], [5.2, 2.0, 2.1]])))


def write_clip(folder: Path, frames: int = 60, *, name: str = "clip.mp4", coco: bool = True, cars: bool = True) -> Path:
    """Write NAME, its calibration, road mask and, with `coco`, masks.json."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    rng = np.random.default_rng(0)
    ground = cv2.resize(rng.integers(90, 130, (90, 160, 3), dtype=np.uint8), SIZE)
    images, annotations = [], []
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height = SIZE
        stream.bit_rate = 3_000_000
        for n in range(frames):
            picture = ground.copy()
            images.append({"id": n, "file_name": name, "frame": n, "width": SIZE[0], "height": SIZE[1]})
            for i, vertices in enumerate(vehicle_boxes(n) if cars else ()):
                mask = np.zeros(SIZE[::-1], np.uint8)
                hull = cv2.convexHull(vertices.astype(np.float32))
                cv2.fillConvexPoly(mask, np.round((hull - 0.5) * 256).astype(np.int32), 1, shift=8)
                picture[mask > 0] = (30 + 150 * i, 60, 200 - 120 * i)
                rle = coco_mask.encode(np.asfortranarray(mask))
                rle["counts"] = rle["counts"].decode()
                annotations.append(
                    {"id": len(annotations) + 1, "image_id": n, "category_id": 3, "segmentation": rle, "score": 0.9}
                )
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        container.mux(stream.encode())
    stem = path.stem
    (folder / f"{stem}.calibration.json").write_text(json.dumps(CAMERA.to_dict()))
    cv2.imwrite(str(folder / f"{stem}.mask.png"), road_mask())
    if coco:
        data = {"images": images, "annotations": annotations, "categories": [{"id": 3, "name": "car"}]}
        (folder / "masks.json").write_text(json.dumps(data))
    return path
