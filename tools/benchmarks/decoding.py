"""What leaving frames undecoded saves the mask job, and whether its memory stays the same over a long video.

    python -m tools.benchmarks.decoding speed [--minutes 2] [--b-frames 0] [--rounds 3]
    python -m tools.benchmarks.decoding memory --minutes 60 [--size 1920x1080] [--keyframes]

A video of 1920x1080 with a key frame each 50 frames and eight moving cuboids, H.264 as a camera makes it or, with
`--b-frames 3`, as x264 does by default. Masks are ready in a COCO file. `speed` runs the whole job `bcs-masks` in three
ways, side by side in one process: every 25th frame with all frames decoded, the same with no more decoded than needed,
and key frames only. Processor time, which other work on the machine disturbs least. `memory` runs one way and prints
the greatest memory of the process.
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

from labelgen.datasets.scene import Scene, SceneFiles, find_scene
from labelgen.geometry import Camera, Pair, road_cuboids
from labelgen.jobs.mask_settings import MaskSettings
from labelgen.jobs.runner import Job
from labelgen.jobs.video import VideoUnit, video_job

__all__ = ["main", "memory", "speed", "write_video"]

_KEY_EVERY, _TAKE_EVERY, _FPS = 50, 25, 25


class _InSequence:
    """A source of frames of which all are decoded."""

    def __init__(self, frames: Any) -> None:
        self._frames = frames

    def __getattr__(self, name: str) -> Any:
        return getattr(self._frames, name)


class _InSequenceFiles(SceneFiles):
    """A scene whose video is decoded in sequence."""

    def open(self, *, fps: float | None = None) -> Scene:
        scene = super().open(fps=fps)
        return replace(scene, frames=_InSequence(scene.frames))


def write_video(folder: Path, minutes: float, size_wh: tuple[int, int] = (1920, 1080), b_frames: int = 0) -> Path:
    """Write a video, its calibration, road mask and `masks.json`. Two groups of pictures are repeated to its length."""
    scale = size_wh[0] / 1920
    camera = Camera(
        np.array([-400.0, -500.0]), np.array([7300.0, -900.0]), np.array([960.0, 540.0]), 0.02, name="bench"
    )
    camera = camera.resized(scale)
    rng = np.random.default_rng(1)
    ground = cv2.resize(rng.integers(70, 140, (270, 480, 3), dtype=np.uint8), size_wh, interpolation=cv2.INTER_CUBIC)
    path, hulls = folder / "clip.mp4", []
    options = {"g": str(_KEY_EVERY), "bf": str(b_frames), "preset": "fast", "x264-params": "scenecut=0"}
    with av.open(f"file:{path}", "w") as container:
        stream: Any = container.add_stream("libx264", rate=_FPS, options=options)
        stream.width, stream.height, stream.pix_fmt = *size_wh, "yuv420p"
        packets = []
        for number in range(2 * _KEY_EVERY):
            frame = ground.copy()
            shift = 0.2 * (number % _KEY_EVERY)
            near = np.stack([22 + 6 * np.arange(8) // 2 * 2 + shift % 6, np.tile([-13.0, -9.0], 4)], axis=1)
            corners = camera.project(road_cuboids(near, np.tile([4.3, 1.8, 1.5], (8, 1))))
            hulls.append([cv2.convexHull(vertices.astype(np.float32)).astype(np.int32) for vertices in corners])
            for i, hull in enumerate(hulls[-1]):
                cv2.fillConvexPoly(frame, hull, (40 + 20 * i, 90, 200 - 20 * i))
            noise = rng.integers(0, 6, (size_wh[1], size_wh[0], 1), dtype=np.uint8)
            picture = av.VideoFrame.from_ndarray(np.asarray(frame + noise, np.uint8), format="bgr24")
            packets += [_Stored(packet) for packet in stream.encode(picture)]
        packets += [_Stored(packet) for packet in stream.encode(None)]
        count = max(1, round(minutes * 60 * _FPS / len(packets)))
        for repeat in range(count):
            for stored in packets:
                container.mux(stored.packet(stream, repeat * 2 * _KEY_EVERY))
    camera.save(folder / "clip.calibration.json")
    road = np.zeros(size_wh[::-1], np.uint8)
    outline = camera.project(np.array([[17.0, -6.0], [17.0, -16.0], [48.0, -16.0], [48.0, -6.0]]))
    cv2.fillConvexPoly(road, outline.astype(np.int32), 255)
    cv2.imwrite(str(folder / "clip.mask.png"), road)
    _write_masks(folder / "masks.json", hulls, count * 2 * _KEY_EVERY, size_wh)
    return path


class _Stored:
    """A packet that can be written several times."""

    def __init__(self, packet: Any) -> None:
        self._data, self._stamps = bytes(packet), (packet.pts, packet.dts)
        self._base, self._is_key = packet.time_base, packet.is_keyframe

    def packet(self, stream: Any, frames_later: int) -> Any:
        packet = av.Packet(self._data)
        later = round(frames_later / _FPS / self._base)
        packet.pts, packet.dts = (stamp + later for stamp in self._stamps)
        packet.time_base, packet.is_keyframe, packet.stream = self._base, self._is_key, stream
        return packet


def _write_masks(path: Path, hulls: list[Any], count: int, size_wh: tuple[int, int]) -> None:
    numbers = range(0, count, _TAKE_EVERY)
    images = [
        {"id": n, "file_name": "clip.mp4", "frame": n, "width": size_wh[0], "height": size_wh[1]} for n in numbers
    ]
    annotations: list[dict[str, Any]] = []
    for n in numbers:
        for hull in hulls[n % len(hulls)]:
            polygon = [hull.ravel().tolist()]
            annotations.append(
                {"id": len(annotations) + 1, "image_id": n, "category_id": 3, "segmentation": polygon, "score": 0.9}
            )
    coco = {"images": images, "annotations": annotations, "categories": [{"id": 3, "name": "car"}]}
    path.write_text(json.dumps(coco))


def _job(video: Path, *, keyframes: bool = False) -> Job:
    settings = MaskSettings(f"coco:{video.parent / 'masks.json'}")
    return video_job([find_scene(video)], Pair.VP2_VP3, (640, 360), settings, every=_TAKE_EVERY, keyframes=keyframes)


def _in_sequence(job: Job) -> Job:
    units = []
    for unit in job.units:
        assert isinstance(unit, VideoUnit)
        units.append(replace(unit, files=_InSequenceFiles(**vars(unit.files))))
    return replace(job, units=units)


def _run(job: Job, out: Path) -> tuple[float, int]:
    """Return processor seconds and how many frames were labelled."""
    out.mkdir(exist_ok=True)
    for old in out.glob("*.h5"):
        old.unlink()
    counts: list[int] = []
    begun = time.process_time()
    for unit in job.units:
        unit.run(out, counts.append)
    return time.process_time() - begun, sum(counts)


def speed(folder: Path, minutes: float, b_frames: int, rounds: int) -> list[dict[str, Any]]:
    """Return, for each way, processor seconds for a minute of video and for a labelled frame, and the gain."""
    video = write_video(folder, minutes, b_frames=b_frames)
    every = _job(video)
    ways = {"all frames decoded": _in_sequence(every), "every 25": every, "key frames": _job(video, keyframes=True)}
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    labelled = dict.fromkeys(ways, 0)
    for _ in range(rounds):
        for name, job in ways.items():
            taken, labelled[name] = _run(job, folder / "out")
            seconds[name].append(taken)
    first = next(iter(ways))
    return [
        {
            "way": name,
            "s_per_minute": statistics.median(seconds[name]) / minutes,
            "s_per_labelled_frame": statistics.median(seconds[name]) / max(1, labelled[name]),
            "gain": statistics.median(a / b for a, b in zip(seconds[first], seconds[name], strict=True)),
        }
        for name in ways
    ]


def memory(folder: Path, minutes: float, size_wh: tuple[int, int], *, keyframes: bool) -> float:
    """Return the greatest memory of the process after a job on a long video, MB."""
    _run(_job(write_video(folder, minutes, size_wh), keyframes=keyframes), folder / "out")
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    """Run the benchmark and print its figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["speed", "memory"])
    parser.add_argument("--minutes", type=float, default=2)
    parser.add_argument("--size", default="1920x1080", help="of the video, for memory")
    parser.add_argument("--b-frames", type=int, default=0)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--keyframes", action="store_true", help="for memory")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as name:
        if options.what == "memory":
            width, height = (int(number) for number in options.size.split("x"))
            peak = memory(Path(name), options.minutes, (width, height), keyframes=options.keyframes)
            print(f"{options.minutes:g} minutes of {options.size}: at most {peak:.0f} MB")
            return
        for row in speed(Path(name), options.minutes, options.b_frames, options.rounds):
            print(
                f"{row['way']:20} {row['s_per_minute']:6.2f} s a minute of video   "
                f"{1000 * row['s_per_labelled_frame']:6.1f} ms a labelled frame   {row['gain']:5.2f} times"
            )


if __name__ == "__main__":
    main()
