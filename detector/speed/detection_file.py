"""Files of detections, as JSON lines.

    {"format": "labelgen-detections", "version": 1, "variant": "transform3d", "frame_wh": [1920, 1080], "fps": 50.0,
     "rectification": {"pair": "VP2-VP3", "size": [640, 360], "matrix": [[...], ...], "vpu": [x, y]},
     "outlines": "body"}
    {"frame": 0, "time_s": 0.0, "boxes": [[x0, y0, x1, y1], ...], "scores": [...], "classes": [...], "cc": [...]}
    ...

One line per frame, frames without detections included. `boxes` lie in the rectified picture, or in the frame where
`rectification` is null. `cc` is there for variants that decode it. `vertices` (eight points each, frame px) is there
for all variants with 3D boxes; a reader needs it only for `maskrcnn3d`, `dubska` and `sochor`. `scores` and `classes`
may be left out. `time_s` may be null or left out where `fps` is given. For `fitted3d` from masks each line has
`outlines`, for each box the corners of the outline's convex hull, frame px. `outlines` of the first line is the value
of a `detector.speed.contact_point.MaskExtent` where boxes end with the outline of a mask. It is null or left out where
boxes end at the edge of a 3D box on the road.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from detector.speed.contact_point import MaskExtent
from detector.speed.detections import Detections
from detector.speed.variant import Variant
from detector.speed.view import MeasurementView
from labelgen.errors import DataError, LabelgenError
from labelgen.geometry import Camera, Pair, Rectification
from labelgen.geometry.homography import Array
from labelgen.json_file import parse_json
from labelgen.printable import printable
from labelgen.staged_output import is_staged

__all__ = ["DetectionFile", "detections_head"]

_FORMAT, _VERSION = "labelgen-detections", 1


def detections_head(view: MeasurementView, fps: float | None) -> str:
    """Return the first line of the file.

    Args:
        view: of the detections.
        fps: frames per second; None where not known.
    """
    rectification = view.rectification
    head = {
        "format": _FORMAT,
        "version": _VERSION,
        "variant": str(view.variant),
        "frame_wh": list(view.frame_wh),
        "fps": fps,
        "rectification": None
        if rectification is None
        else {
            "pair": str(rectification.pair),
            "size": list(rectification.size_wh),
            "matrix": rectification.matrix.tolist(),
            "vpu": rectification.vpu.tolist(),
        },
        "outlines": None if view.mask_extent is None else view.mask_extent.value,
    }
    return json.dumps(head) + "\n"


@dataclass(frozen=True, eq=False)
class DetectionFile:
    """The head of a file of detections; its frames are read by `frames`.

    Args:
        path: of the file.
        variant: how the measured point is found.
        frame_wh: px; size of the frame.
        fps: frames per second; None where not known.
        rectification: in which the boxes lie; None where they lie in the frame.
        mask_extent: what the masks cover that boxes end with; None for boxes that end at the edge of a 3D box.
    """

    path: Path
    variant: Variant
    frame_wh: tuple[int, int]
    fps: float | None
    rectification: Rectification | None
    mask_extent: MaskExtent | None

    @classmethod
    def open(cls, path: Path) -> DetectionFile:
        """Read the head of a file.

        Args:
            path: of the file.

        Raises:
            DataError: no such file, not of this format, or of a run that has not ended.
        """
        if is_staged(path):
            raise DataError(f"detections {path}: of a run that has not ended; wait for it, or run it again")
        try:
            with path.open("rb") as file:
                head = _parse(path, 1, file.readline().decode("utf-8-sig"))
        except OSError as err:
            raise DataError(f"detections {path}: {err.strerror or err}") from None
        except UnicodeDecodeError:
            raise DataError(f"detections {path}: not a text file") from None
        if head.get("format") != _FORMAT or head.get("version") != _VERSION:
            raise DataError(
                f"detections {path}: its first line is not that of a {_FORMAT} file of version {_VERSION}; "
                "give one that `labelgen speed` wrote"
            )
        try:
            variant = Variant.parse(head["variant"])
            frame_wh = (int(head["frame_wh"][0]), int(head["frame_wh"][1]))
            if not all(1 <= side <= _MAX_SIDE_PX for side in frame_wh):
                raise ValueError(f"frame_wh {frame_wh}")
            fps = None if head.get("fps") is None else float(head["fps"])
            if fps is not None and not (math.isfinite(fps) and fps > 0):
                raise ValueError(f"fps {fps}")
            rectification = _rectification(head["rectification"], frame_wh)
            mask_extent = None if head.get("outlines") is None else MaskExtent(head["outlines"])
        except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, LabelgenError) as err:
            raise DataError(f"detections {path}: its first line is damaged ({_reason(err)})") from None
        if rectification is None and not variant.in_frame:
            raise DataError(f"detections {path}: variant {variant} and its rectification do not go together")
        return cls(path, variant, frame_wh, fps, rectification, mask_extent)

    def fitted(self) -> DetectionFile:
        """Return the same detections, measured by the variant `fitted3d`.

        Raises:
            LabelgenError: they are no 3D boxes of a detector, nor outlines.
        """
        if self.variant is Variant.FITTED3D:
            return self
        if self.rectification is None or not self.variant.is_3d or self.mask_extent is not None:
            raise LabelgenError(
                f"variant fitted3d: it needs a detector's boxes with c_c, or masks themselves; {self.path} has those "
                f"of {self.variant}; leave out the variant",
                parameter="variant",
            )
        return replace(self, variant=Variant.FITTED3D)

    def view(self, camera: Camera) -> MeasurementView:
        """Return the view in which the boxes lie.

        Args:
            camera: of the scene, with a scale.

        Raises:
            CalibrationError: the camera has no scale, or does not know the size of its frame.
        """
        return MeasurementView(self.variant, camera, self.rectification, self.mask_extent)

    def frames(self, view: MeasurementView) -> Iterator[Detections]:
        """Yield the detections of one frame after the other.

        Args:
            view: as `view` returns it.

        Raises:
            DataError: a line is damaged, or its frame does not follow the one before; names the line.
        """
        last = -1
        for number, text in self._lines():
            if number == 1 or not text.strip():
                continue
            line = _parse(self.path, number, text)
            detections = self._detections(view, line, number)
            frame = detections.frame
            if frame <= last:
                raise DataError(
                    f"detections {self.path}, line {number}: frame {frame} after frame {last}; sort the lines"
                )
            last = frame
            yield detections

    def _lines(self) -> Iterator[tuple[int, str]]:
        """Yield the lines with their numbers from 1.

        Raises:
            DataError: a line is no UTF-8, or the file cannot be read.
        """
        number = 0
        try:
            with self.path.open("rb") as file:
                for number, line in enumerate(file, start=1):
                    yield number, line.decode("utf-8-sig")
        except OSError as err:
            raise DataError(f"detections {self.path}: {err.strerror or err}") from None
        except UnicodeDecodeError:
            raise DataError(f"detections {self.path}, line {number}: not UTF-8 text") from None

    def _detections(self, view: MeasurementView, line: dict[str, Any], number: int) -> Detections:
        try:
            frame, time_s, boxes = line["frame"], line.get("time_s"), line["boxes"]
            if not isinstance(frame, int) or not 0 <= frame <= _MAX_FRAME:
                raise ValueError(f"frame {frame!r}")
            if time_s is None:
                time_s = frame / self.fps if self.fps else math.nan
            if abs(float(time_s)) > _MAX_TIME_S:  # NaN, where no rate is known, is no time
                raise ValueError(f"time_s {time_s!r}")
            count = len(boxes)
            arrays = {key: _array(line, key, count) for key in ("boxes", "cc", "scores", "classes", "vertices")}
            detections, _ = view.place(
                frame, float(time_s), arrays["boxes"], arrays["cc"], arrays["scores"], arrays["classes"],
                arrays["vertices"], _outlines(view, line, count),
            )  # fmt: skip
        except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, LabelgenError) as err:
            raise DataError(f"detections {self.path}, line {number}: damaged ({_reason(err)})") from None
        return detections


_MAX_SIDE_PX, _MAX_REASON, _FEWEST_CORNERS = 65_536, 200, 3
# No recording is longer: 30 years, at a thousand frames per second.
_MAX_TIME_S, _MAX_FRAME = 1e9, 10**12
_SHAPES: dict[str, tuple[int, ...]] = {"boxes": (4,), "cc": (), "scores": (), "classes": (), "vertices": (8, 2)}


def _reason(err: Exception) -> str:
    """Return the reason of an error, which may quote what the file holds, in a short line."""
    return printable(" ".join(str(err)[:_MAX_REASON].split()))


def _array(line: dict[str, Any], key: str, count: int) -> Any:
    if key not in line:
        return None
    array = np.array(line[key], dtype=np.float64)
    expected = (count, *_SHAPES[key])
    if array.shape != expected and not (array.size == 0 and count == 0):
        raise ValueError(f"{key}: expected shape {expected}, got {array.shape}")
    return array.reshape(expected)


def _outlines(view: MeasurementView, line: dict[str, Any], count: int) -> list[Array] | None:
    """Return the outlines that bodies are laid over; None where they are those of the 3D boxes."""
    if view.variant is not Variant.FITTED3D or view.rectification is not None:
        return None
    outlines = [np.array(outline, dtype=np.float64) for outline in line["outlines"]] if count else []
    if len(outlines) != count:
        raise ValueError(f"outlines: expected {count}, got {len(outlines)}")
    for outline in outlines:
        if outline.ndim != 2 or outline.shape[1] != 2 or len(outline) < _FEWEST_CORNERS:
            raise ValueError(f"outlines: expected points as x and y, got shape {outline.shape}")
        if not (abs(outline) <= _MAX_SIDE_PX).all():
            raise ValueError("outlines: a point is far outside the frame")
    return outlines


def _parse(path: Path, number: int, text: str) -> dict[str, Any]:
    try:
        data = parse_json(text)
    except ValueError as err:
        raise DataError(f"detections {path}, line {number}: not JSON ({err})") from None
    if not isinstance(data, dict):
        raise DataError(f"detections {path}, line {number}: expected a JSON object")
    return data


def _rectification(data: Any, frame_wh: tuple[int, int]) -> Rectification | None:
    if data is None:
        return None
    size = (int(data["size"][0]), int(data["size"][1]))
    return Rectification(Pair.parse(data["pair"]), size, np.array(data["matrix"]), np.array(data["vpu"]), frame_wh)
