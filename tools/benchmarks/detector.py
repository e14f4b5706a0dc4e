"""Measure the speed of the detector.

`branch`: the network with c_c beside torchvision's own RetinaNet: same weights, same input, in alternation.
`stages`: a video from decoding to tracks: frames per second, and the time of each stage.

    python -m tools.benchmarks.detector branch [--backbone resnet50] [--size 640x360] [--pairs 20]
    python -m tools.benchmarks.detector stages CHECKPOINT VIDEO_OR_SESSION [--frames 300] [--half|--no-half] [--compile]
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from torchvision.models.detection import RetinaNet

from detector.inference import Detector, load_detector
from detector.model.retinanet import CcRetinaNet, ModelConfig, build_model
from detector.speed.model_detections import DetectorDetections, model_view
from detector.speed.pipeline import detect
from detector.tracking.iou_tracker import IouTracker
from detector.training.config import find_preset
from labelgen.datasets.scene import find_scene
from labelgen.geometry import parse_size
from labelgen.media.frames import Frame
from labelgen.media.timed_frames import TimedFrames

__all__ = ["benchmark_branch", "benchmark_stages", "plain_retinanet", "synchronised_s"]

_STAGE_FRAMES = 40
"""Frames on which each stage is timed by itself; they are kept in memory."""


def synchronised_s(device: torch.device) -> float:
    """Wait until the device has finished, and return the clock in s."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def plain_retinanet(ours: CcRetinaNet) -> RetinaNet:
    """Build torchvision's own RetinaNet on shared weights: it gives the same boxes, without c_c."""
    plain = RetinaNet(
        ours.backbone, 1, anchor_generator=ours.anchor_generator, score_thresh=ours.score_thresh,
        detections_per_img=ours.detections_per_img,
    )  # fmt: skip
    plain.transform = ours.transform
    plain.head.classification_head = ours.head.classification_head
    plain.head.regression_head.conv = ours.head.regression_head.conv
    plain.head.regression_head.bbox_reg = ours.head.regression_head.bbox_reg
    return plain.eval()


def benchmark_branch(config: ModelConfig, size_wh: tuple[int, int], pairs: int, device: str) -> dict[str, Any]:
    """Measure the median inference time of both networks, and the median ratio of alternating pairs.

    The ratio of processor times is given as well: other programs on the machine disturb it less.

    Args:
        config: of the network.
        size_wh: width, height px of the picture.
        pairs: number of measured pairs.
        device: torch device.
    """
    place = torch.device(device)
    torch.manual_seed(0)
    ours = build_model(config).eval().to(place, memory_format=torch.channels_last)
    plain = plain_retinanet(ours).to(place, memory_format=torch.channels_last)
    image = [torch.rand(3, size_wh[1], size_wh[0], device=place)]
    times: dict[str, list[tuple[float, float]]] = {"ours": [], "torchvision": []}
    networks = {"ours": ours, "torchvision": plain}
    with torch.inference_mode():
        for number in range(pairs + 3):
            # Each network goes first in every other pair.
            for name in sorted(networks, reverse=bool(number % 2)):
                begin, busy = synchronised_s(place), time.process_time()
                networks[name](image)
                times[name].append((synchronised_s(place) - begin, time.process_time() - busy))
    wall, cpu = (
        [a[k] / b[k] for a, b in zip(times["ours"][3:], times["torchvision"][3:], strict=True)] for k in (0, 1)
    )
    return {
        "backbone": config.backbone, "size": list(size_wh), "pairs": pairs, "device": device,
        "ours_ms": 1000 * statistics.median(wall for wall, _ in times["ours"][3:]),
        "torchvision_ms": 1000 * statistics.median(wall for wall, _ in times["torchvision"][3:]),
        "median_ratio": statistics.median(wall), "median_ratio_cpu_time": statistics.median(cpu),
    }  # fmt: skip


def benchmark_stages(
    checkpoint: Path, source: Path, frames: int, *, device: str | None, half: bool | None, compiled: bool
) -> dict[str, Any]:
    """Measure frames per second end to end, where stages overlap, and the time of each stage by itself.

    Processor time per frame is given as well: other programs on the machine disturb it less.

    Args:
        checkpoint: of the detector.
        source: video with calibration and road mask, or session.
        frames: number of frames to measure, from the beginning of the video.
        device: torch device; None for the GPU where there is one.
        half: half precision; None for where the device gains from it.
        compiled: compile the network.
    """
    detector = load_detector(checkpoint, score=0.3, device=device, half=half, compiled=compiled)
    scene = find_scene(source).open()
    video = scene.frames
    view = model_view(detector.metadata, scene.camera, scene.road)
    source_of_detections = DetectorDetections(detector, view)
    stages = _time_stages(detector, source_of_detections, list(islice(video.frames(), min(frames, _STAGE_FRAMES))))
    begin = time.perf_counter()
    decoded = sum(1 for _ in islice(video.frames(), min(frames, _STAGE_FRAMES)))
    decode = (time.perf_counter() - begin) / decoded

    tracker, count, vehicles, tracking = IouTracker(), 0, 0, 0.0
    begin, busy = time.perf_counter(), time.process_time()
    for _, detections in islice(detect(source_of_detections, TimedFrames(video, fps=video.fps)), frames):
        start = time.perf_counter()
        tracker.update(detections.frame, detections.boxes_xyxy, detections.scores)
        tracking += time.perf_counter() - start
        count, vehicles = count + 1, vehicles + len(detections)
    seconds, busy = time.perf_counter() - begin, time.process_time() - busy
    result = {
        "frames": count, "detections": vehicles, "frame_wh": list(video.size_wh),
        "size_wh": list(detector.metadata.size_wh),
        "device": str(detector.device), "half": detector.half, "threads": torch.get_num_threads(),
        "fps": count / seconds,
        "cpu_ms_per_frame": 1000 * busy / count,
        "decode_ms": 1000 * decode, **stages, "track_ms": 1000 * tracking / count,
    }  # fmt: skip
    if detector.device.type == "cuda":
        result["peak_mib"] = torch.cuda.max_memory_allocated() / 2**20
    return result


def _time_stages(detector: Detector, source: DetectorDetections, frames: Sequence[Frame]) -> dict[str, float]:
    """Measure rectification and network by themselves, in ms per frame."""
    view = source.view
    assert view.rectification is not None
    to_input = detector.rectifier(view.rectification, view.camera)
    list(source.detections(frames[:3]))  # the first passes take longer
    begin = synchronised_s(detector.device)
    inputs = [to_input(frame.image) for frame in frames]
    rectify = synchronised_s(detector.device) - begin
    begin = synchronised_s(detector.device)
    for item in inputs:
        detector.detect([item])
    network = synchronised_s(detector.device) - begin
    return {"rectify_ms": 1000 * rectify / len(frames), "detect_ms": 1000 * network / len(frames)}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark on command line arguments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--threads", type=int, help="of PyTorch")
    kinds = parser.add_subparsers(dest="kind", required=True)
    branch = kinds.add_parser("branch")
    branch.add_argument("--preset", default="paper-640x360")
    branch.add_argument("--backbone")
    branch.add_argument("--size", default="640x360")
    branch.add_argument("--pairs", type=int, default=20)
    branch.add_argument("--device", default="cpu")
    stages = kinds.add_parser("stages")
    stages.add_argument("checkpoint", type=Path)
    stages.add_argument("source", type=Path)
    stages.add_argument("--frames", type=int, default=300)
    stages.add_argument("--device")
    stages.add_argument("--half", action=argparse.BooleanOptionalAction, default=None)
    stages.add_argument("--compile", action="store_true")
    given = parser.parse_args(arguments)
    if given.threads:
        torch.set_num_threads(given.threads)
    if given.kind == "branch":
        config = find_preset(given.preset).model
        config = replace(config, backbone=given.backbone) if given.backbone else config
        result = benchmark_branch(config, parse_size(given.size), given.pairs, given.device)
    else:
        result = benchmark_stages(
            given.checkpoint, given.source, given.frames, device=given.device, half=given.half, compiled=given.compile
        )
    for name, value in result.items():
        print(f"{name:14} {value:.4g}" if isinstance(value, float) else f"{name:14} {value}")
    if given.json is not None:
        given.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
