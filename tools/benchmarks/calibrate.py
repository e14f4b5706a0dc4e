"""Measure how many times faster than real time a video is calibrated from, on one core, and the share of each stage.

    python -m tools.benchmarks.calibrate VIDEO [--size 1280x720 --fps 30 --seconds 60]

With --size the video is first encoded anew as H.264 of that size and rate, played forwards and backwards until it is
long enough: compressed like a real one, whatever the source is. That is not counted. Every library uses one thread,
times are processor time of this process, and the pass does not stop early.
"""

from __future__ import annotations

import functools
import inspect
import os
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from labelgen.errors import DataError, LabelgenError

__all__ = ["main", "measure"]

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_STAGES = (
    ("labelgen.media.video_reader", "VideoFile", "_decode", "decoding"),
    ("labelgen.calibration.pipeline", None, "estimate_orientation", "tracks and edges"),
    ("labelgen.calibration.pipeline", None, "refine_orientation", "bundle adjustment"),
    ("labelgen.calibration.observation.klt_tracks", "FeatureTracker", "update", "features"),
    ("labelgen.calibration.observation.camera_shake", "CameraShake", "update", "camera motion"),
    ("labelgen.calibration.observation.edgelets", "EdgeletFinder", "update", "edges"),
    ("labelgen.calibration.observation.background_image", "BackgroundImageEstimator", "update", "background frames"),
    ("labelgen.calibration.observation.silhouettes", "SilhouetteCollector", "update", "silhouettes"),
    ("labelgen.calibration.observation.silhouettes", "SilhouetteCollector", "silhouettes", "silhouettes"),
    ("labelgen.calibration.scale.methods", "ScaleMethod", "__call__", "scale"),
    (
        "labelgen.calibration.observation.background_image",
        "BackgroundImageEstimator",
        "median_image",
        "background image",
    ),
)


def measure(video: Path) -> dict[str, Any]:
    """Calibrate from a video and measure the time.

    Returns:
        seconds of video, seconds of processor time for the whole, times real time, the whole as a multiple of what
        decoding all frames alone takes, and shares by stage.
    """
    import importlib

    import cv2

    from labelgen.calibration import pipeline
    from labelgen.calibration.scale.methods import parse_scale_method
    from labelgen.media.video_reader import VideoFile

    cv2.setNumThreads(1)
    spent: dict[str, float] = {}
    start = time.process_time()
    for _ in VideoFile(video, threads=1).frames(lambda number: False):
        pass
    all_decoded = time.process_time() - start
    modules = [importlib.import_module(module) for module, _, _, _ in _STAGES]
    owners = [
        module if holder is None else getattr(module, holder)
        for module, (_, holder, _, _) in zip(modules, _STAGES, strict=True)
    ]
    plain = [getattr(owner, method) for owner, (_, _, method, _) in zip(owners, _STAGES, strict=True)]
    for owner, function, (_, _, method, name) in zip(owners, plain, _STAGES, strict=True):
        timed = _timed_pieces if inspect.isgeneratorfunction(function) else _timed
        setattr(owner, method, timed(function, name, spent))
    try:
        start = time.process_time()
        estimate_scale = parse_scale_method(["auto-models"])
        calibration = pipeline.calibrate_video(VideoFile(video, threads=1), stop_early=False)
        estimate_scale(calibration.camera, calibration.silhouettes)
        total = time.process_time() - start
    finally:
        for owner, function, (_, _, method, _) in zip(owners, plain, _STAGES, strict=True):
            setattr(owner, method, function)
    spent["the rest"] = total - sum(spent.values())
    seconds = calibration.observations.duration_s
    return {
        "seconds": seconds,
        "cpu_s": total,
        "times_real_time": seconds / total,
        "times_decoding": total / all_decoded,
        "share_percent": {name: 100 * s / total for name, s in sorted(spent.items(), key=lambda item: -item[1])},
    }


def _timed(function: Any, name: str, spent: dict[str, float]) -> Any:
    """Return a function that adds its processor time to `spent[name]`."""

    def run(*args: Any, **kwargs: Any) -> Any:
        start = time.process_time()
        try:
            return function(*args, **kwargs)
        finally:
            spent[name] = spent.get(name, 0.0) + time.process_time() - start

    return run


def _timed_pieces(function: Any, name: str, spent: dict[str, float]) -> Any:
    """Return a generator function whose time per item is added up."""

    def run(*args: Any, **kwargs: Any) -> Any:
        following = _timed(functools.partial(next, function(*args, **kwargs), None), name, spent)
        while (item := following()) is not None:
            yield item

    return run


def recode(video: Path, out: Path, size_wh: tuple[int, int], fps: int, seconds: float) -> None:
    """Encode a video anew, played forwards and backwards until it is long enough."""
    import av
    import cv2

    from labelgen.media.video_reader import VideoFile

    frames = [
        cv2.resize(frame.image, size_wh, interpolation=cv2.INTER_CUBIC) for frame in _first(VideoFile(video), 300)
    ]
    with av.open(f"file:{out}", "w") as container:
        stream: Any = container.add_stream("libx264", rate=fps, options={"preset": "veryfast", "crf": "23"})
        stream.width, stream.height, stream.pix_fmt = *size_wh, "yuv420p"
        for number in range(round(seconds * fps)):
            turn = number % (2 * len(frames) - 2) if len(frames) > 1 else 0
            image = frames[min(turn, 2 * len(frames) - 2 - turn) if len(frames) > 1 else 0]
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        container.mux(stream.encode())


def _first(video: Any, count: int) -> Any:
    for frame in video.frames():
        if frame.number >= count:
            return
        yield frame


def main(
    video: Annotated[Path, typer.Argument(help="Video to calibrate from.")],
    size: Annotated[str | None, typer.Option(metavar="WxH", help="Encode it anew in this size first.")] = None,
    fps: Annotated[int, typer.Option(min=1, help="Rate of the new video.")] = 30,
    seconds: Annotated[float, typer.Option(min=1, help="Length of the new video.")] = 60.0,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the figures as JSON as well.")] = None,
) -> None:
    """Measure the time of a calibration and the share of each stage."""
    from labelgen.atomic_files import write_json
    from labelgen.geometry import parse_size

    for name in _THREADS:
        os.environ[name] = "1"
    if not video.is_file():
        raise DataError(f"{video}: no such video")
    with tempfile.TemporaryDirectory() as folder:
        measured = video
        if size is not None:
            measured = Path(folder) / "video.mp4"
            recode(video, measured, parse_size(size), fps, seconds)
        figures = measure(measured)
    typer.echo(
        f"{figures['seconds']:.1f} s of video in {figures['cpu_s']:.1f} s: "
        f"{figures['times_real_time']:.1f} times real time; "
        f"{figures['times_decoding']:.2f} times as long as decoding all of it"
    )
    for name, share in figures["share_percent"].items():
        typer.echo(f"  {name:<20}{share:5.1f} %")
    if json_file is not None:
        write_json(json_file, figures)


if __name__ == "__main__":
    try:
        typer.run(main)
    except LabelgenError as err:
        raise SystemExit(f"error: {err}") from None
