"""A road with cuboids that drive along it, whose speeds are known: exact boxes, masks, and files to run commands on."""

from __future__ import annotations

import json
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

from detector.speed.detections import Detections
from detector.speed.variant import Variant
from detector.speed.view import MeasurementView
from labelgen.geometry import Camera, Pair, RoadMask, encode_boxes, road_cuboids
from labelgen.geometry.homography import bounding_boxes

FRAME_WH = (640, 360)
SIZES = {Pair.VP2_VP3: (640, 360), Pair.VP1_VP2: (360, 640)}
CAR = (4.4, 1.8, 1.5)


def make_camera(factor: float = 1.0) -> Camera:
    """A full-HD camera about 9 m above the road that looks along it, a little to the right; scaled by `factor`."""
    full = Camera([1300.0, -350.0], [-5000.0, 560.0], [960.5, 540.5], 0.02, image_wh=(1920, 1080), name="bridge")
    return full.resized(factor)


def make_road(camera: Camera, near_m: float = 14.0, far_m: float = 70.0, half_m: float = 6.0) -> RoadMask:
    corners = camera.project([[near_m, -half_m], [near_m, half_m], [far_m, half_m], [far_m, -half_m]])
    assert camera.image_wh is not None
    mask = np.zeros((camera.image_wh[1], camera.image_wh[0]), np.uint8)
    cv2.fillPoly(mask, [np.round(corners).astype(np.int32)], 255)
    return RoadMask(mask)


@dataclass(frozen=True)
class Drive:
    """A cuboid at constant speed: at time 0 the middle of its near edge is `start_m` ahead; heading -1 comes closer."""

    speed_kmh: float
    start_m: float
    y_m: float = 0.0
    heading: int = -1
    size_lwh: tuple[float, float, float] = CAR

    def x_m(self, time_s: float) -> float:
        return self.start_m + self.heading * self.speed_kmh / 3.6 * time_s

    def vertices_px(self, camera: Camera, time_s: float) -> np.ndarray:
        near = np.array([[self.x_m(time_s), self.y_m]])
        return camera.project(road_cuboids(near, np.array([self.size_lwh])))[0]

    def seen(self, camera: Camera, time_s: float) -> np.ndarray | None:
        """The projected vertices while all of them are in the frame."""
        if self.x_m(time_s) < 5:
            return None
        vertices = self.vertices_px(camera, time_s)
        assert camera.image_wh is not None
        return vertices if (vertices > 0).all() and (vertices < camera.image_wh).all() else None


def exact_detections(view: MeasurementView, drives: list[Drive], frame: int, time_s: float) -> Detections:
    """What a detector without any error finds in one frame."""
    shown = [v for drive in drives if (v := drive.seen(view.camera, time_s)) is not None]
    vertices = np.array(shown).reshape(-1, 8, 2)
    if view.rectification is None:
        boxes = bounding_boxes(vertices)
        return view.place(frame, time_s, boxes, vertices_px=vertices)[0]
    encoded = encode_boxes(view.rectification.points(vertices), view.rectification.vpu)
    return view.place(frame, time_s, encoded.boxes_xyxy, encoded.cc)[0]


def make_view(variant: Variant, pair: Pair = Pair.VP2_VP3, factor: float = 1.0) -> MeasurementView:
    camera = make_camera(factor)
    return MeasurementView.create(variant, camera, make_road(camera), pair, SIZES[pair])


def frame_times(duration_s: float, fps: float) -> list[float]:
    return [number / fps for number in range(round(duration_s * fps))]


def write_scene(folder: Path, drives: list[Drive], times_s: list[float], *, suffix: str = ".mp4") -> Path:
    """NAME.mp4 with its calibration and road mask beside it, and masks.json, the exact masks of its frames (COCO)."""
    folder.mkdir(parents=True, exist_ok=True)
    camera = make_camera(FRAME_WH[0] / 1920)
    (folder / "road.calibration.json").write_text(json.dumps(camera.to_dict()))
    cv2.imwrite(str(folder / "road.mask.png"), make_road(camera).pixels.astype(np.uint8) * 255)
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    pictures = []
    for number, time_s in enumerate(times_s):
        images.append({"id": number, "frame": number, "width": FRAME_WH[0], "height": FRAME_WH[1]})
        picture = np.full((FRAME_WH[1], FRAME_WH[0], 3), 110, np.uint8)
        for drive in drives:
            vertices = drive.seen(camera, time_s)
            if vertices is None:
                continue
            hull = cv2.convexHull(vertices.astype(np.float32))[:, 0]
            cv2.fillConvexPoly(picture, np.round(hull * 16 - 8).astype(np.int32), (200, 60, 40), shift=4)
            polygon = np.round(hull.astype(float), 3).ravel().tolist()
            annotations.append(
                {"id": len(annotations) + 1, "image_id": number, "category_id": 3, "iscrowd": 0,
                 "segmentation": [polygon]}
            )  # fmt: skip
        pictures.append(picture)
    categories = [{"id": 3, "name": "car"}]
    (folder / "masks.json").write_text(
        json.dumps({"images": images, "annotations": annotations, "categories": categories})
    )
    path = folder / f"road{suffix}"
    write_video(path, pictures, times_s)
    return path


def write_video(path: Path, pictures: list[np.ndarray], times_s: list[float]) -> None:
    """H.264 with a time stamp of its own for every frame, to the millisecond."""
    kind = {".ts": "mpegts"}.get(path.suffix)
    with av.open(str(path), "w", format=kind) as container:
        options = {"tune": "zerolatency", "preset": "ultrafast", "g": "10", "crf": "28"}
        stream: Any = container.add_stream("libx264", rate=Fraction(25), options=options)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = Fraction(1, 1000)
        for picture, time_s in zip(pictures, times_s, strict=True):
            frame = av.VideoFrame.from_ndarray(picture, format="bgr24")
            frame.pts, frame.time_base = round(time_s * 1000), Fraction(1, 1000)
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode(None):
            container.mux(packet)
