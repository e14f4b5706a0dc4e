"""Measure frames per second of the six published sizes, from video to tracks, beside torchvision's own RetinaNet.

One checkpoint runs at every size: its network is convolutional, so it detects vehicles at any of them, less well than
one trained for it. The ways to run it:

    torchvision        torchvision's RetinaNet as it comes, the same weights: no c_c, batch norm not folded, float32
    torchvision half   the same under autocast, as torchvision's users run it
    float32            `detector.inference.Detector` in full precision
    half               the same in half precision, as in use
    half compiled      the same with `--compile`

    python -m tools.benchmarks.sizes CHECKPOINT SESSION [--sizes 640x360 ...] [--frames 200] [--rounds 3] [--no-compile]

Detections are tracked, but no speeds are measured. Every way gets the same frames; the result is the median of the
rounds.
"""

from __future__ import annotations

import argparse
import gc
import itertools
import json
import logging
import statistics
import time
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from detector.checkpoint import ModelMetadata, load_model
from detector.inference import Detector
from detector.model.retinanet import CcRetinaNet
from detector.speed.model_detections import DetectorDetections, model_view
from detector.speed.pipeline import detect
from detector.tracking.iou_tracker import IouTracker
from detector.training.config import PRESETS
from labelgen.datasets.scene import Scene, find_scene
from labelgen.geometry import parse_size
from labelgen.media.frames import Frame, FrameSource
from labelgen.media.timed_frames import TimedFrames
from tools.benchmarks.detector import plain_retinanet, synchronised_s

__all__ = ["PUBLISHED_SIZES", "benchmark_sizes"]

PUBLISHED_SIZES = [p.size_wh for p in PRESETS.values() if p.name.startswith("paper-") and p.size_wh is not None]
_SCORE = 0.3
"""Lowest score of a detection, as is usual for measuring speeds."""

logger = logging.getLogger(__name__)


class _WithoutCc(nn.Module):
    """torchvision's RetinaNet with a constant c_c, which the stages after it need."""

    def __init__(self, model: CcRetinaNet, half: bool) -> None:
        super().__init__()
        self.model, self._half = plain_retinanet(model), half

    def forward(self, images: list[Tensor]) -> list[dict[str, Tensor]]:
        with torch.autocast(images[0].device.type, enabled=self._half):
            outputs: list[dict[str, Tensor]] = self.model(images)
        for output in outputs:
            output["cc"] = torch.full_like(output["scores"], 0.3)
        return outputs


def _ways(
    model: CcRetinaNet, metadata: ModelMetadata, device: str | None, compiled: bool
) -> dict[str, Callable[[], Detector]]:
    """Return functions that build the detectors, so that only one is in the device's memory at a time."""

    def plain(half: bool) -> Detector:
        network: Any = _WithoutCc(deepcopy(model), half)
        detector = Detector(network, metadata, device=device, half=False, fold=False)
        detector.model.to(memory_format=torch.contiguous_format)
        return detector

    def ours(half: bool, compiled: bool = False) -> Detector:
        return Detector(deepcopy(model), metadata, device=device, half=half, compiled=compiled)

    ways: dict[str, Callable[[], Detector]] = {
        "torchvision": lambda: plain(False),
        "torchvision half": lambda: plain(True),
        "float32": lambda: ours(False),
        "half": lambda: ours(True),
    }
    if compiled:
        ways["half compiled"] = lambda: ours(True, True)
    return ways


def _end_to_end(model: DetectorDetections, video: FrameSource, frames: int) -> tuple[float, int]:
    """Measure frames per second from decoding to tracks, and count the detections."""
    tracker, count, vehicles = IouTracker(), 0, 0
    begin = time.perf_counter()
    for _, detections in itertools.islice(detect(model, TimedFrames(video, fps=video.fps)), frames):
        tracker.update(detections.frame, detections.boxes_xyxy, detections.scores)
        count, vehicles = count + 1, vehicles + len(detections)
    return count / (time.perf_counter() - begin), vehicles


def _measure(detector: Detector, scene: Scene, first: list[Frame], frames: int, rounds: int) -> Any:
    """Measure one detector: medians of the rounds, as a row of the result."""
    view = model_view(detector.metadata, scene.camera, scene.road)
    assert view.rectification is not None
    model = DetectorDetections(detector, view)
    to_input = detector.rectifier(view.rectification, view.camera)
    batch = [to_input(frame.image) for frame in first[: detector.batch_size]]
    place = detector.device
    for _ in range(3):
        detector.detect(batch)
    if place.type == "cuda":
        torch.cuda.reset_peak_memory_stats(place)
    network, fps, vehicles = [], [], 0
    times = max(1, min(frames, 64) // len(batch))
    for _ in range(rounds):
        begin = synchronised_s(place)
        for _ in range(times):
            detector.detect(batch)
        network.append((synchronised_s(place) - begin) / (times * len(batch)))
        rate, vehicles = _end_to_end(model, scene.frames, frames)
        fps.append(rate)
    row = {
        "fps": statistics.median(fps), "fps_rounds": fps, "detect_ms": 1000 * statistics.median(network),
        "batch": len(batch), "detections": vehicles,
    }  # fmt: skip
    if place.type == "cuda":
        row["peak_mib"] = torch.cuda.max_memory_allocated(place) / 2**20
    return row


def benchmark_sizes(
    checkpoint: Path, source: Path, sizes: Sequence[tuple[int, int]] = PUBLISHED_SIZES, *,
    frames: int = 200, rounds: int = 3, device: str | None = None, compiled: bool = True,
) -> dict[str, Any]:  # fmt: skip
    """Measure every way at every size, and log each result as soon as it is there.

    Args:
        checkpoint: of any preset.
        source: video with calibration and road mask, or session.
        sizes: width, height px; upright ones are rectified with VP1-VP2, the others with VP2-VP3.
        frames: of the video, per round.
        rounds: end-to-end passes per way.
        device: torch device; None for the GPU where there is one.
        compiled: also measure the compiled way, which takes half a minute more per size.
    """
    model, stored = load_model(checkpoint, score_thresh=_SCORE)
    scene = find_scene(source).open()
    video = scene.frames
    begin = time.perf_counter()
    count = sum(1 for _ in itertools.islice(TimedFrames(video, fps=video.fps).frames(), frames))
    first = list(itertools.islice(video.frames(), 8))
    result: dict[str, Any] = {
        "frame_wh": list(video.size_wh), "frames": count, "decode_fps": count / (time.perf_counter() - begin),
        "threads": torch.get_num_threads(), "torch": torch.__version__, "sizes": {},
    }  # fmt: skip
    logger.info("%d frames of %s, decoded alone at %.0f fps", count, _text(video.size_wh), result["decode_fps"])
    pairs = {p.size_wh: p.pair for p in PRESETS.values() if p.size_wh is not None and p.pair is not None}
    # Compiled ways come last: a run that is stopped early then has the other ways at every size.
    names = list(_ways(model, stored, device, compiled))
    for name in sorted(names, key=lambda key: key.endswith("compiled")):
        for size_wh in sizes:
            metadata = replace(stored, pair=pairs[size_wh], size_wh=size_wh)
            detector = _ways(model, metadata, device, compiled)[name]()
            result.setdefault("device", str(detector.device))
            row = _measure(detector, scene, first, frames, rounds)
            result["sizes"].setdefault(_text(size_wh), {})[name] = row
            memory = f"{row['peak_mib']:7.0f} MiB" if "peak_mib" in row else ""
            figures = f"{row['fps']:7.1f} fps  detect {row['detect_ms']:7.2f} ms {memory}"
            logger.info("%-8s %-17s %s  %d detections", _text(size_wh), name, figures, row["detections"])
            del detector
            gc.collect()
            torch.compiler.reset()  # or the next size would be compiled for any size
            if torch.cuda.is_available():
                torch.cuda.empty_cache()
    return result


def _text(size_wh: tuple[int, int]) -> str:
    return "{}x{}".format(*size_wh)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark on command line arguments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("source", type=Path)
    parser.add_argument("--sizes", nargs="*", type=parse_size, default=PUBLISHED_SIZES)
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--device")
    parser.add_argument("--compile", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    result = benchmark_sizes(
        given.checkpoint, given.source, given.sizes, frames=given.frames, rounds=given.rounds, device=given.device,
        compiled=given.compile,
    )  # fmt: skip
    if given.json is not None:
        given.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
