"""Throughput of the label jobs against the OpenCV calls they cannot avoid, side by side in one run, on one core.

    python -m tools.benchmarks.labels [--crops 1000] [--frames 40] [--rounds 5]

`boxcars`: decode, warp and encode of crops of about 200 px. `masks`: decode of a 1920x1080 video, warp and encode
of the labelled frames; masks are read before, so that the time to make them is left out.

Both sides are timed by processor time, which other work on the machine disturbs least.
"""

from __future__ import annotations

import argparse
import json
import os
import pickle
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

from labelgen.datasets.boxcars116k import BoxCars
from labelgen.datasets.manifest import load_manifest
from labelgen.datasets.scene import Scene, find_scene
from labelgen.geometry import Camera, Pair, road_cuboids
from labelgen.jobs.boxcars import boxcars_job
from labelgen.jobs.mask_settings import MaskSettings
from labelgen.jobs.video import VideoUnit, video_job
from labelgen.masks import InstanceMasks, MaskSource

__all__ = ["compare", "main"]

_QUALITY = [cv2.IMWRITE_JPEG_QUALITY, 95]


def _camera() -> Camera:
    return Camera(np.array([-400.0, -500.0]), np.array([7300.0, -900.0]), np.array([960.0, 540.0]), 0.02, name="bench")


def _write_crops(root: Path, count: int) -> None:
    camera, rng = _camera(), np.random.default_rng(0)
    near = np.stack([rng.uniform(22, 28, count), rng.uniform(-13, -9, count)], axis=1)
    boxes = camera.project(road_cuboids(near, np.tile([4.3, 1.8, 1.5], (count, 1))))
    instances = []
    for i, vertices in enumerate(boxes):
        size = 200
        offset = np.floor(vertices.mean(axis=0)) - size // 2
        image = cv2.resize(
            rng.integers(0, 255, (25, 25, 3), dtype=np.uint8), (size, size), interpolation=cv2.INTER_CUBIC
        )
        image = np.minimum(image, 240) + rng.integers(0, 12, image.shape, dtype=np.uint8)
        path = root / "images" / "c" / f"{i:06d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), image)
        instances.append({"2DBB": [0, 0, 1, 1], "3DBB": vertices, "3DBB_offset": offset, "path": f"c/{i:06d}.png"})
    vps = {key: getattr(camera, key) for key in ("vp1", "vp2", "vp3", "pp")}
    samples = [{"camera": "bench", "to_camera": True, "annotation": "", "instances": instances}]
    (root / "dataset.pkl").write_bytes(pickle.dumps({"cameras": {"bench": vps}, "samples": samples}, protocol=2))


def _write_video(root: Path, taken: int, every: int) -> Path:
    """Write a full-HD clip with moving cuboids, its calibration, road mask and masks in COCO format."""
    camera, rng = _camera(), np.random.default_rng(1)
    path = root / "clip.mp4"
    ground = cv2.resize(rng.integers(70, 140, (135, 240, 3), dtype=np.uint8), (1920, 1080))
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    with av.open(f"file:{path}", "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.bit_rate = 1920, 1080, 8_000_000
        for n in range(taken * every):
            frame = ground.copy()
            near = np.stack([22 + 6 * np.arange(8) // 2 * 2 + 0.1 * (n % 30), np.tile([-13.0, -9.0], 4)], axis=1)
            for i, vertices in enumerate(camera.project(road_cuboids(near, np.tile([4.3, 1.8, 1.5], (8, 1))))):
                hull = cv2.convexHull(vertices.astype(np.float32)).astype(np.int32)
                cv2.fillConvexPoly(frame, hull, (40 + 20 * i, 90, 200 - 20 * i))
                if n % every == 0:
                    annotations.append(
                        {
                            "id": len(annotations) + 1,
                            "image_id": n,
                            "category_id": 3,
                            "segmentation": [hull.ravel().tolist()],
                            "score": 0.9,
                        }
                    )
            if n % every == 0:
                images.append({"id": n, "file_name": "clip.mp4", "frame": n, "width": 1920, "height": 1080})
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="bgr24")))
        container.mux(stream.encode())
    camera.save(root / "clip.calibration.json")
    road = np.zeros((1080, 1920), np.uint8)
    cv2.fillConvexPoly(
        road, camera.project([[17.0, -6.0], [17.0, -16.0], [48.0, -16.0], [48.0, -6.0]]).astype(np.int32), 255
    )
    cv2.imwrite(str(root / "clip.mask.png"), road)
    categories = [{"id": 3, "name": "car"}]
    coco = {"images": images, "annotations": annotations, "categories": categories}
    (root / "masks.json").write_text(json.dumps(coco))
    return path


def _bare_crops(root: Path) -> None:
    """Read and decode, warp, encode: the calls that no implementation can avoid."""
    matrix = np.array([[1.5, 0.2, -10.0], [0.1, 0.9, 3.0], [0.0002, 0.0001, 1.0]])
    for path in sorted((root / "images" / "c").iterdir()):
        image = np.asarray(cv2.imdecode(np.fromfile(path, dtype=np.uint8), cv2.IMREAD_COLOR))
        cv2.imencode(".jpg", cv2.warpPerspective(image, matrix, (320, 180)), _QUALITY)


def _bare_video(path: Path, every: int) -> None:
    matrix = np.array([[0.4, 0.02, -10.0], [0.01, 0.4, 3.0], [0.00002, 0.00001, 1.0]])
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, 1])
    number = 0
    while capture.grab():
        if number % every == 0:
            frame = np.asarray(capture.retrieve()[1])
            cv2.imencode(".jpg", cv2.warpPerspective(frame, matrix, (640, 360)), _QUALITY)
        number += 1


def compare(ours: Callable[[], None], bare: Callable[[], None], rounds: int) -> tuple[float, float, float]:
    """Return the median seconds of both actions over alternating rounds, and the median ratio bare / ours."""
    times: list[tuple[float, float]] = []
    for _ in range(rounds):
        pair = []
        for action in (ours, bare):
            start = time.process_time()
            action()
            pair.append(time.process_time() - start)
        times.append((pair[0], pair[1]))
    mine, theirs = (statistics.median(column) for column in zip(*times, strict=True))
    return mine, theirs, statistics.median(b / a for a, b in times)


class _ReadySource:
    """A mask source whose masks are in memory."""

    name = "ready"
    every_frame = 0
    prime_frames = 0
    batch_size = 4

    def __init__(self, source: MaskSource, numbers: range) -> None:
        self._masks = {n: source.masks([np.empty((0, 0, 3), np.uint8)], [n], [""])[0] for n in numbers}
        self.problems: list[str] = []

    def prime(self, frames: Any) -> None:
        """Do nothing."""

    def observe(self, image: Any) -> None:
        """Do nothing."""

    def masks(self, images: Any, frame_numbers: Any = None, file_names: Any = None) -> list[InstanceMasks]:
        """Return the masks of frames."""
        return [self._masks[n] for n in frame_numbers]


@dataclass(frozen=True)
class _ReadyUnit(VideoUnit):
    ready: _ReadySource | None = None

    def mask_source(self, scene: Scene) -> Any:
        return self.ready


def _run_all(job: Any, out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    for old in out.glob("shard-*.h5"):
        old.unlink()
    for unit in job.units:
        unit.run(out, lambda n: None)


def main() -> None:
    """Run the benchmark and print one line per job: images per second, ours and bare, and the ratio."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--crops", type=int, default=1000)
    parser.add_argument("--frames", type=int, default=40, help="taken frames of the video, one in 25")
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {sorted(os.sched_getaffinity(0))[0]})
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        _write_crops(root, options.crops)
        data = BoxCars(root, load_manifest("boxcars116k")["layout"])
        crops = boxcars_job(data, Pair.VP2_VP3, (320, 180))
        mine, bare, ratio = compare(
            lambda: _run_all(crops, root / "out-crops"), lambda: _bare_crops(root), options.rounds
        )
        n = options.crops
        print(f"boxcars  {n / mine:7.1f} images/s   bare OpenCV {n / bare:7.1f}   ratio {ratio:.3f}")
        video = _write_video(root, options.frames, 25)
        settings = MaskSettings(f"coco:{root / 'masks.json'}")
        masks = video_job([find_scene(video)], Pair.VP2_VP3, (640, 360), settings, every=25)
        unit = masks.units[0]
        assert isinstance(unit, VideoUnit)
        ready = _ReadySource(unit.mask_source(unit.files.open()), range(0, 25 * options.frames, 25))
        masks = replace(masks, units=[_ReadyUnit(**{f.name: getattr(unit, f.name) for f in fields(unit)}, ready=ready)])
        mine, bare, ratio = compare(
            lambda: _run_all(masks, root / "out-masks"), lambda: _bare_video(video, 25), options.rounds
        )
        n = options.frames
        print(f"masks    {n / mine:7.1f} images/s   bare OpenCV {n / bare:7.1f}   ratio {ratio:.3f}")


if __name__ == "__main__":
    main()
