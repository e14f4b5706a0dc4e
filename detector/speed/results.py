"""The files that `labelgen speed` writes. Each vehicle is written as soon as it has passed.

While they grow they lie in a folder `DIR/NAME/.labelgen-speed-VARIANT`; they move up together when the run has ended.

DIR/NAME/system_VARIANT.json      the public result format: calibration and tracks; `labelgen evaluate` reads it
DIR/NAME/vehicles_VARIANT.csv     one row per vehicle
DIR/NAME/detections_VARIANT.jsonl one line per frame (see `detector.speed.detection_file`)
DIR/NAME/annotated_VARIANT.avi     the annotated video, if asked for
"""

from __future__ import annotations

import json
import math
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from detector.speed.append_file import AppendFile
from detector.speed.detection_file import detections_head
from detector.speed.detections import Detections
from detector.speed.track_speed import MeasuredVehicle
from detector.speed.view import MeasurementView
from labelgen.labels import VehicleClass
from labelgen.staged_output import StagedOutput

__all__ = ["CSV_COLUMNS", "ResultFiles", "ResultWriter"]

CSV_COLUMNS = (
    "id", "first_s", "last_s", "speed_kmh", "uncertainty_kmh", "length_m", "width_m", "height_m", "direction", "lane",
    "class", "points", "first_frame", "last_frame", "score",
)  # fmt: skip


@dataclass(frozen=True)
class ResultFiles:
    """Paths of the files of one run, all in one folder."""

    tracks: Path
    vehicles: Path
    detections: Path
    video: Path

    @classmethod
    def of(cls, out: Path, name: str, variant: str) -> ResultFiles:
        """Return the paths for a scene and a variant.

        Args:
            out: folder for all scenes.
            name: of the scene.
            variant: its name.
        """
        return cls.within(out / name, variant)

    @classmethod
    def within(cls, folder: Path, variant: str) -> ResultFiles:
        """Return the paths of a variant in a folder."""
        return cls(
            folder / f"system_{variant}.json",
            folder / f"vehicles_{variant}.csv",
            folder / f"detections_{variant}.jsonl",
            folder / f"annotated_{variant}.avi",
        )

    def staged(self, *, overwrite: bool, needs_overwrite: bool = False) -> StagedOutput:
        """Return what keeps the files of a run until they are whole; see `within` for their paths in it.

        Args:
            overwrite: whether files that are there may be replaced.
            needs_overwrite: whether what a killed run left is replaced with `overwrite` only, as it cannot be made
                again.
        """
        paths = (self.tracks, self.vehicles, self.detections, self.video)
        return StagedOutput(
            self.tracks.parent, f"speed-{self.tracks.stem.removeprefix('system_')}", [path.name for path in paths],
            overwrite=overwrite, keep=True, needs_overwrite=needs_overwrite,
        )  # fmt: skip


class ResultWriter:
    """Context manager that writes tracks, vehicles and detections one by one.

    Args:
        files: paths.
        view: of the detections; its camera is the calibration in the file of tracks.
        fps: frames per second; None where not known.
        keep_detections: whether to write the detections too.

    Raises:
        OutputError: a file cannot be written; the records written before are in it.
    """

    def __init__(
        self, files: ResultFiles, view: MeasurementView, fps: float | None, *, keep_detections: bool = True
    ) -> None:
        public = view.camera.to_dict()
        head = "".join(f'"{key}": {json.dumps(value)}, ' for key, value in public.items() if key != "cars")
        with ExitStack() as stack:
            self._tracks = stack.enter_context(
                AppendFile(
                    files.tracks, head=f'{{{head}"cars": [\n', separator=",\n",
                    tail="\n]}\n",
                )
            )  # fmt: skip
            self._vehicles = stack.enter_context(AppendFile(files.vehicles, head=",".join(CSV_COLUMNS) + "\n"))
            self._detections = (
                stack.enter_context(AppendFile(files.detections, head=detections_head(view, fps)))
                if keep_detections
                else None
            )
            self._stack = stack.pop_all()

    def add_detections(self, detections: Detections) -> None:
        """Write the detections of one frame."""
        if self._detections is not None:
            self._detections.add(json.dumps(detections.to_dict()) + "\n")

    def add_vehicle(self, vehicle: MeasuredVehicle) -> None:
        """Write one vehicle."""
        self._tracks.add(json.dumps(vehicle.to_car()))
        self._vehicles.add(",".join(_row(vehicle)) + "\n")

    def __enter__(self) -> ResultWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, value, trace)


def _row(vehicle: MeasuredVehicle) -> list[str]:
    length, width, height = (_number(v, 2) for v in vehicle.size_lwh_m)
    return [
        str(vehicle.track_id),
        _number(vehicle.times_s[0], 3),
        _number(vehicle.times_s[-1], 3),
        _number(vehicle.speed_kmh, 2),
        _number(vehicle.uncertainty_kmh, 2),
        length,
        width,
        height,
        vehicle.direction,
        "" if vehicle.lane is None else str(vehicle.lane),
        VehicleClass(vehicle.class_id).name.lower(),
        str(len(vehicle.frames)),
        str(vehicle.frames[0]),
        str(vehicle.frames[-1]),
        _number(vehicle.score, 3),
    ]


def _number(value: Any, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else ""
