"""Small BoxCars116k trees with exact boxes, written for tests independently of labelgen's own synthetic traffic."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from labelgen.geometry import Camera, road_cuboids

PP = (960.0, 540.0)


def camera_above_road(yaw_deg: float, pitch_deg: float = 20.0, focal: float = 1800.0) -> Camera:
    """A camera that looks along the road, turned by `yaw_deg`, down by `pitch_deg`; at 10 m or so."""
    yaw, pitch = np.radians([yaw_deg, pitch_deg])
    turn = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    ahead = turn @ np.array([np.sin(yaw), 0, np.cos(yaw)])
    across = turn @ np.array([np.cos(yaw), 0, -np.sin(yaw)])
    vp1, vp2 = (np.array(PP) + focal * d[:2] / d[2] for d in (ahead, across))
    return Camera(vp1, vp2, PP, scale=0.02, image_wh=(1920, 1080))


CAMERAS = {"alpha": camera_above_road(24.0), "beta": camera_above_road(-31.0), "uvoz": camera_above_road(12.0)}


def _crop(vertices: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    low = np.floor(vertices.min(axis=0)) - rng.integers(4, 12, 2)
    high = np.ceil(vertices.max(axis=0)) + rng.integers(4, 12, 2)
    width, height = (high - low).astype(int)
    image = np.full((height, width, 3), 110, np.uint8)
    noise = rng.integers(0, 40, (height // 4 + 1, width // 4 + 1, 3), dtype=np.uint8)
    image += cv2.resize(noise, (int(width), int(height)))
    hull = cv2.convexHull((vertices - low).astype(np.float32)).astype(np.int32)
    cv2.fillConvexPoly(image, hull, tuple(int(c) for c in rng.integers(30, 220, 3)))
    return image, low


def write_tree(root: Path, *, vehicles: int = 12, per_vehicle: int = 3, seed: int = 0, **keep: bool) -> dict[str, Any]:
    """Write a whole tree; `keep` may drop parts: pkl, json, images, atlas, splits.

    Returns:
        the annotations, as they stand in dataset.pkl.
    """
    rng = np.random.default_rng(seed)
    names = list(CAMERAS)
    samples: list[dict[str, Any]] = []
    atlas: list[list[np.ndarray]] = []
    for v in range(vehicles):
        name = names[v % len(names)]
        camera, to_camera = CAMERAS[name], v % 4 != 3
        instances, encoded = [], []
        for i in range(per_vehicle):
            near = np.array([[rng.uniform(18, 45), rng.uniform(-5, 5)]])
            size = np.array([[rng.uniform(3.6, 5), rng.uniform(1.6, 2), rng.uniform(1.3, 2)]])
            vertices = camera.project(road_cuboids(near, size))[0]
            if not to_camera:  # its own front is the far face, seen with its sides the other way round
                vertices = vertices[[2, 3, 0, 1, 6, 7, 4, 5]]
            image, low = _crop(vertices, rng)
            path = f"{name}/{v}/{v:06d}_{i:03d}.png"
            if keep.get("images", True):
                target = root / "images" / path
                target.parent.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(target), image)
            encoded.append(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].ravel())
            box = [*vertices.min(axis=0), *(vertices.max(axis=0) - vertices.min(axis=0))]
            instances.append(
                {"2DBB": np.array(box), "3DBB": vertices, "3DBB_offset": low, "instance_id": i, "path": path}
            )
        atlas.append(encoded)
        samples.append({"camera": name, "to_camera": to_camera, "annotation": "test car", "instances": instances})
    cameras = {n: {key: getattr(c, key) for key in ("vp1", "vp2", "vp3", "pp")} for n, c in CAMERAS.items()}
    data = {"cameras": cameras, "samples": samples}
    root.mkdir(parents=True, exist_ok=True)
    if keep.get("pkl", True):
        (root / "dataset.pkl").write_bytes(pickle.dumps(data, protocol=2))
    if keep.get("json", True):
        (root / "json_data").mkdir(exist_ok=True)
        (root / "json_data" / "dataset.json").write_text(json.dumps(data, default=lambda a: a.tolist()))
    if keep.get("atlas", True):
        (root / "atlas.pkl").write_bytes(pickle.dumps(atlas, protocol=2))
    if keep.get("splits", True):
        parts = {"train": range(0, vehicles, 2), "validation": range(1, 2), "test": range(3, vehicles, 2)}
        hard = {part: [(v, 0) for v in members] for part, members in parts.items()}
        (root / "classification_splits.pkl").write_bytes(pickle.dumps({"hard": hard}, protocol=2))
    return data
