"""From frames to files, with a detector that detects colours."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from speed_scenes import Drive, exact_detections, frame_times, make_view, write_scene

from detector.speed.detections import Detections
from detector.speed.meter import SpeedMeter
from detector.speed.model_detections import DetectorDetections
from detector.speed.pipeline import detect, measure
from detector.speed.results import ResultFiles
from detector.speed.variant import Variant
from labelgen.errors import DataError, LabelgenError
from labelgen.geometry import Camera, Pair, Rectification, label_outlines, mask_outline
from labelgen.labels import Labels
from labelgen.media.open_frames import open_frames
from labelgen.media.timed_frames import TimedFrames


class ColourDetector:
    """Detects blue vehicles. Unlike a trained network it is given VPU."""

    batch_size = 7

    def __init__(self, vpu: NDArray[np.float64]) -> None:
        self.vpu, self.batches = vpu, list[int]()

    def rectifier(self, rectification: Rectification, _: Camera) -> Callable[[NDArray[np.uint8]], Any]:
        return rectification.warp_image

    def detect(self, images: Sequence[NDArray[np.uint8]]) -> list[Labels]:
        import cv2

        self.batches.append(len(images))
        out = []
        for image in images:
            blue = ((image[..., 0].astype(int) - image[..., 2]) > 80).astype(np.uint8)
            count, parts = cv2.connectedComponents(blue)
            masks = [mask for n in range(1, count) if (mask := parts == n).sum() > 30]
            outlines = [outline for mask in masks if (outline := mask_outline(mask)) is not None]
            found = label_outlines(outlines, self.vpu)
            out.append(Labels(found.boxes_xyxy, found.cc, scores=np.full(len(outlines), 0.9)))
        return out


@pytest.mark.parametrize("pair", list(Pair))
def test_a_detector_measures_speeds(tmp_path: Path, pair: Pair) -> None:
    drives = [Drive(60.0, 38.0, 2.0), Drive(72.0, 16.0, -3.0, 1)]
    video = write_scene(tmp_path, drives, frame_times(2.4, 25.0))
    view = make_view(Variant.TRANSFORM3D, pair, factor=1 / 3)
    assert view.rectification is not None
    detector = ColourDetector(view.rectification.vpu)
    source = DetectorDetections(detector, view)
    files = ResultFiles.within(tmp_path, "transform3d")
    frames = TimedFrames(open_frames(video), fps=25.0)
    summary = measure(detect(source, frames), view, SpeedMeter(view.camera, fps=25.0), files, fps=25.0)
    assert detector.batches == [7] * 8 + [4]
    assert (summary.frames, summary.vehicles) == (60, 2)
    assert sorted(summary.speeds_kmh) == pytest.approx([60.0, 72.0], abs=1.5)


def test_a_detector_needs_a_rectified_picture() -> None:
    with pytest.raises(LabelgenError, match="orig2d: it needs masks"):
        DetectorDetections(ColourDetector(np.zeros(2)), make_view(Variant.ORIG2D))


@pytest.mark.parametrize("error", [DataError("the cable is out"), KeyboardInterrupt()])
def test_vehicles_are_written_when_frames_break_off(tmp_path: Path, error: BaseException) -> None:
    """One vehicle has passed before the frames break off, and one is still in the frame."""
    view = make_view(Variant.TRANSFORM3D)
    drives = [Drive(90.0, 36.0, 2.0), Drive(40.0, 36.0, -3.0)]
    files = ResultFiles.within(tmp_path, "transform3d")
    on_disk: list[int] = []

    def breaking() -> object:
        for number in range(110):
            found: Detections = exact_detections(view, drives, number, number / 50)
            yield None, found
            on_disk.append(len(json.loads(files.tracks.read_text())["cars"]))
        raise error

    meter = SpeedMeter(view.camera, fps=50.0)
    if isinstance(error, KeyboardInterrupt):
        assert measure(breaking(), view, meter, files, fps=50.0).interrupted  # type: ignore[arg-type]
    else:
        with pytest.raises(DataError, match="cable"):
            measure(breaking(), view, meter, files, fps=50.0)  # type: ignore[arg-type]
    assert on_disk[-1] == 1  # before the end, and readable all the time
    cars = json.loads(files.tracks.read_text())["cars"]
    with files.vehicles.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [car["id"] for car in cars] == [int(row["id"]) for row in rows]
    assert [float(row["speed_kmh"]) for row in rows] == pytest.approx([90.0, 40.0], abs=0.02)
