"""`labelgen detect`."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from labelgen.before_torch import check_device, check_torch_file
from labelgen.cli.options import (
    CalibrationOption,
    DeinterlaceOption,
    FpsOption,
    JsonOption,
    KeyframesOption,
    OverwriteOption,
    RoadMaskOption,
    StreamOption,
    check_report_path,
    print_table,
    warn_of,
    write_json_report,
)
from labelgen.cli.printing import say
from labelgen.progress import progress_bar

if TYPE_CHECKING:
    from detector.inference import Detector
    from labelgen.datasets.scene import Scene
    from labelgen.media.frame_choice import FrameChoice
    from labelgen.staged_output import StagedOutput

__all__ = ["detect"]


def detect(
    checkpoint: Annotated[Path, typer.Argument(metavar="CHECKPOINT", help="Written by labelgen train.")],
    source: Annotated[
        Path, typer.Argument(metavar="VIDEO_OR_IMAGES_OR_SHARDS", help="Video, image or session folder, or shards.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Where detections.jsonl goes.")],
    calibration: CalibrationOption = None,
    road_mask: RoadMaskOption = None,
    score: Annotated[float, typer.Option("--score", min=0.0, max=1.0, help="Least score of a detection.")] = 0.5,
    every: Annotated[
        int,
        typer.Option("--every", min=1, metavar="N", help="Take every N-th frame; with --keyframes, N or more apart."),
    ] = 1,
    keyframes: KeyframesOption = False,
    limit: Annotated[int | None, typer.Option("--limit", min=1, metavar="N", help="Stop after N pictures.")] = None,
    fps: FpsOption = None,
    stream: StreamOption = None,
    deinterlace: DeinterlaceOption = False,
    render: Annotated[bool, typer.Option("--render", help="Write the rectified pictures with 3D boxes.")] = False,
    device: Annotated[str | None, typer.Option("--device", help="Torch device; the GPU when there is one.")] = None,
    overwrite: OverwriteOption = False,
    json_file: JsonOption = None,
) -> None:
    """Find vehicles: boxes with c_c, one line per frame.

    For videos and images the file is one that `labelgen speed --from detections:FILE` reads. For shards each line names
    the sample it belongs to.
    """
    check_torch_file(checkpoint, f"checkpoint {checkpoint}")
    check_device(device)
    from detector.inference import load_detector
    from labelgen.datasets.scene import find_scene
    from labelgen.errors import NoVehiclesError
    from labelgen.media.frame_choice import FrameChoice
    from labelgen.staged_output import StagedOutput

    check_report_path(json_file)
    target = out / "detections.jsonl"
    is_shards = source.suffix == ".h5" or (source.is_dir() and any(source.glob("shard-*.h5")))
    problems: list[str] = []
    with ExitStack() as stack:
        stack.callback(warn_of, problems)
        output = StagedOutput(out, "detect", [target.name], overwrite=overwrite, patterns=["pictures/[0-9]*.jpg"])
        stack.enter_context(output)
        detector = load_detector(checkpoint, score=score, device=device)
        if is_shards:
            lines = _of_shards(detector, source, limit)
        else:
            scene = find_scene(
                source, calibration=calibration, road_mask=road_mask, fps=fps, stream=stream, deinterlace=deinterlace
            ).open()
            lines = _of_frames(detector, scene, FrameChoice(every, keyframes, limit), problems)
        stack.enter_context(closing(lines))  # type: ignore[type-var]
        first = next(lines)  # finds out what is wrong before anything is written
        counts = _write(first, lines, output, target.name, render=render)
        output.publish()
    rows = [("pictures", counts[0]), ("detections", counts[1]), ("in", out)]
    say(f"Detections of {source.name} by {checkpoint.name}")
    print_table(rows)
    report = {"pictures": counts[0], "detections": counts[1], "file": str(target), "problems": problems}
    if not counts[1]:
        error = NoVehiclesError(
            f"no vehicles found in {source.name}: 0 detections of a score of at least {score:g} in {counts[0]} pictures"
            + (f" ({'; '.join(problems[:3])})" if problems else "")
        )
        write_json_report(json_file, {**report, "error": str(error)})
        raise error
    write_json_report(json_file, report)


_Line = tuple[str, int, Any]
"""A line of the file, its detections, and the picture with them (None for the head)."""


def _write(first: _Line, lines: Iterator[_Line], output: StagedOutput, name: str, *, render: bool) -> tuple[int, int]:
    from detector.speed.append_file import AppendFile
    from labelgen.media.image_file import write_image

    count = total = 0
    with AppendFile(output.stage(name), head=first[0]) as file, progress_bar(None, "img") as advance:
        for text, number, draw in lines:
            file.add(text)
            if render:
                write_image(output.stage(f"pictures/{count:06d}.jpg"), draw())
            count, total = count + 1, total + number
            advance(1)
    return count, total


def _of_frames(detector: Detector, scene: Scene, choice: FrameChoice, problems: list[str]) -> Iterator[_Line]:
    """Yield the lines of a video or folder; append what was assumed or skipped to `problems`, whatever ends it."""
    from detector.speed.annotate import draw_detections
    from detector.speed.detection_file import detections_head
    from detector.speed.model_detections import DetectorDetections, model_view
    from labelgen.media.prefetch import prefetch
    from labelgen.media.sparse_frames import sparse_frames

    untimed = f"{scene.frames.untimed}: the detections have no times" if scene.frames.untimed else ""
    view = model_view(detector.metadata, scene.camera, scene.road)
    model = DetectorDetections(detector, view)
    yield detections_head(view, scene.frames.fps or scene.fps), 0, None
    coming = prefetch(sparse_frames(scene.frames, choice), detector.batch_size)
    try:
        with closing(coming):  # type: ignore[type-var]
            for frame, detections in model.detections(coming):
                text = json.dumps(detections.to_dict()) + "\n"
                yield (
                    text,
                    len(detections),
                    lambda frame=frame, placed=detections: draw_detections(view, frame.image, placed),
                )
    finally:
        problems += [note for note in (untimed, *scene.frames.notes, *scene.notes) if note]
        problems += [*scene.frames.problems, *model.problems]


def _of_shards(detector: Detector, source: Path, limit: int | None) -> Iterator[_Line]:
    from detector.data.dataset import open_shards
    from detector.visualize import draw_sample

    samples = open_shards([source], detector.metadata.pair, detector.metadata.size_wh)
    head = {"format": "labelgen-shard-detections", "version": 1, "shards": str(source)}
    yield json.dumps(head) + "\n", 0, None
    for index in range(min(len(samples), limit or len(samples))):
        sample = samples[index]
        (labels,) = detector.detect([detector.input_of_sample(sample)])
        line = {
            "sample": index, "source": sample.source, "frame": sample.frame,
            "boxes": labels.boxes_xyxy.round(3).tolist(),
            "cc": labels.cc.round(5).tolist(), "scores": labels.scores.astype(float).round(4).tolist(),
        }  # fmt: skip
        yield json.dumps(line) + "\n", len(labels), lambda sample=sample, labels=labels: draw_sample(sample, labels)
