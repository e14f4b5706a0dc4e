"""The types that flow from sources to shards: the labels of one image, and one image with its labels.

Convention:
    Boxes are (N, 4) float64 as x0, y0, x1, y1 in px of the rectified image, pixels being areas; c_c is (N,) float64 in
    [0, 1]; vertices are (N, 8, 2) as in `labelgen.geometry.box_codec`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from enum import IntEnum, IntFlag
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labelgen.errors import DataError
from labelgen.geometry.box_codec import decode_boxes, reorder_vertices
from labelgen.geometry.camera import Camera
from labelgen.geometry.homography import Array
from labelgen.geometry.rectification import Rectification
from labelgen.media.image_file import decode_image

__all__ = ["MIN_IGNORED_SHARE", "Flag", "IgnoreReason", "IgnoredBoxes", "Labels", "Sample", "Split", "VehicleClass"]


class VehicleClass(IntEnum):
    """The kind of vehicle of a label; values are part of the shard format."""

    VEHICLE = 0
    CAR = 1
    MOTORCYCLE = 2
    BUS = 3
    TRUCK = 4


class Split(IntEnum):
    """The part of its data set that a sample belongs to; values are part of the shard format."""

    NONE = 0
    TRAIN = 1
    VALIDATION = 2
    TEST = 3


class Flag(IntFlag):
    """Properties of a label, combined as bits; values are part of the shard format."""

    TRUNCATED = 1
    """The vehicle touches the border of the rectified image or of the frame: its box and c_c are cut."""
    MIRRORED = 2
    """In the source's 3D box vertices 0 and 1 are swapped compared with a decoded box."""
    REVERSED = 4
    """In the source's 3D box the edge 2, 3 is the near one."""
    MISALIGNED = 8
    """The source's 3D box does not follow the vanishing points, so that decoding does not restore it exactly."""
    CANDIDATES_DISAGREE = 16
    """The mask's two candidates for c_c differ by more than 0.1: its outline is not that of a box."""
    TOUCHING = 32
    """The mask touches another one: one of the two vehicles is likely to be partly hidden."""
    FLAT = 64
    """The image is not rectified: the label is a 2D box, and c_c is 0 without a meaning."""
    OCCLUDED = 128
    """Something hides a part of the vehicle."""


class IgnoreReason(IntEnum):
    """Why a vehicle in the image has no label; values are part of the shard format."""

    OTHER = 0
    OFF_ROAD = 1
    TOO_SMALL = 2
    IMPLAUSIBLE_SIZE = 3
    NO_3D_BOX = 4
    CUT = 5

    @property
    def text(self) -> str:
        """The reason in words; where a reject has the same reason, in the same ones."""
        return _REASON_TEXTS[self]

    @classmethod
    def of_reject(cls, reason: str) -> IgnoreReason:
        """Return the member for the reason of a reject, `OTHER` where there is none."""
        return _REASONS.get(reason, cls.OTHER)


_REASON_TEXTS = {
    IgnoreReason.OTHER: "other",
    IgnoreReason.OFF_ROAD: "off the road",
    IgnoreReason.TOO_SMALL: "too small",
    IgnoreReason.IMPLAUSIBLE_SIZE: "implausible size",
    IgnoreReason.NO_3D_BOX: "no valid 3D box",
    IgnoreReason.CUT: "cut by the border",
}
_REASONS = {text: reason for reason, text in _REASON_TEXTS.items()}


@dataclass(frozen=True, eq=False)
class Labels:
    """The labels of one image, as a structure of arrays of equal length N.

    Args:
        boxes_xyxy: (N, 4) float64, rectified px, x0 < x1 and y0 < y1; may extend beyond the image.
        cc: (N,) float64 in [0, 1].
        class_ids: (N,) uint8, `VehicleClass`.
        scores: (N,) float32 in [0, 1].
        flags: (N,) uint16, `Flag`.
        candidates: (N, 2) float64, both c_c candidates of a mask label; NaN where the label is not from a mask.
        sigmas: (N, 5) float32, standard deviations of x0, y0, x1, y1, px, and of c_c; NaN where unknown.
        hidden: (N,) float32 in [0, 1], the share of the vehicle that something hides; NaN where unknown.

    Raises:
        DataError: one message with all wrong fields, the expected value beside the actual one.
    """

    boxes_xyxy: Array
    cc: Array
    class_ids: NDArray[np.uint8] = None  # type: ignore[assignment]
    scores: NDArray[np.float32] = None  # type: ignore[assignment]
    flags: NDArray[np.uint16] = None  # type: ignore[assignment]
    candidates: Array = None  # type: ignore[assignment]
    sigmas: NDArray[np.float32] = None  # type: ignore[assignment]
    hidden: NDArray[np.float32] = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        problems: list[str] = []
        boxes = _numbers("boxes_xyxy", self.boxes_xyxy, problems)
        n = len(boxes) if boxes.ndim else 1
        neutral = {
            "class_ids": np.zeros(n),
            "scores": np.ones(n),
            "flags": np.zeros(n),
            "candidates": np.full((n, 2), np.nan),
            "sigmas": np.full((n, 5), np.nan),
            "hidden": np.full(n, np.nan),
        }
        arrays = {"boxes_xyxy": boxes, "cc": _numbers("cc", self.cc, problems)}
        for name, default in neutral.items():
            value = getattr(self, name)
            arrays[name] = default if value is None else _numbers(name, value, problems)
        shapes = {"boxes_xyxy": (n, 4), "candidates": (n, 2), "sigmas": (n, 5)}
        if not problems:
            problems = [
                f"{name}: expected shape {shapes.get(name, (n,))}, got {array.shape}"
                for name, array in arrays.items()
                if array.shape != shapes.get(name, (n,))
            ]
        if not problems:
            problems = _wrong_values(arrays)
        if problems:
            raise DataError("labels: " + "; ".join(problems))
        for name, array in arrays.items():
            object.__setattr__(self, name, array.astype(_DTYPES[name], copy=False))

    def __len__(self) -> int:
        return len(self.cc)

    def __getitem__(self, index: Any) -> Labels:
        """Return the labels at a slice, a bool mask (N,) or an index array."""
        return Labels._of_checked({f.name: getattr(self, f.name)[index] for f in fields(self)})

    @classmethod
    def _of_checked(cls, arrays: dict[str, NDArray[Any]]) -> Labels:
        """Return labels of arrays that were validated before: a second validation costs more than all else."""
        labels = object.__new__(cls)
        for name, array in arrays.items():
            object.__setattr__(labels, name, array)
        return labels

    @classmethod
    def empty(cls) -> Labels:
        """Return labels of length 0."""
        return cls(np.empty((0, 4)), np.empty(0))

    @classmethod
    def concatenate(cls, parts: Sequence[Labels]) -> Labels:
        """Return all labels of several images, in order."""
        if not parts:
            return cls.empty()
        return cls._of_checked({f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)})

    def has(self, flag: Flag) -> NDArray[np.bool_]:
        """Return which labels carry a flag, (N,) bool."""
        return np.asarray((self.flags & flag.value) != 0)

    def vertices(self, vpu: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
        """Decode the labels into 3D boxes of the rectified image.

        Args:
            vpu: (2,) rectified px, `Rectification.vpu`.

        Returns:
            Vertices (N, 8, 2), rectified px, in the source's vertex order, and valid (N,) bool: False where the label
            has no 3D box.
        """
        vertices, valid = decode_boxes(self.boxes_xyxy, self.cc, vpu)
        valid &= ~self.has(Flag.FLAT)
        return reorder_vertices(vertices, self.has(Flag.MIRRORED), self.has(Flag.REVERSED)), valid


_DTYPES: dict[str, Any] = {
    "boxes_xyxy": np.float64,
    "cc": np.float64,
    "class_ids": np.uint8,
    "scores": np.float32,
    "flags": np.uint16,
    "candidates": np.float64,
    "sigmas": np.float32,
    "hidden": np.float32,
}


def _numbers(name: str, value: Any, problems: list[str]) -> NDArray[Any]:
    """Return the value as an array of numbers of its own type: the field's type would hide values out of range."""
    try:
        array = np.asarray(value)
        return array if array.dtype.kind in "biuf" else array.astype(np.float64)
    except (TypeError, ValueError, OverflowError):
        problems.append(f"{name}: expected numbers, got {type(value).__name__}")
        return np.empty(0)


def _wrong_values(arrays: dict[str, NDArray[Any]]) -> list[str]:
    problems = []
    if not _are_boxes(arrays["boxes_xyxy"]):
        problems.append(_NO_BOXES)
    for name in ("cc", "scores"):
        if not ((arrays[name] >= 0) & (arrays[name] <= 1)).all():
            problems.append(f"{name}: expected values in [0, 1]")
    for name in ("class_ids", "flags"):
        values, top = arrays[name], np.iinfo(_DTYPES[name]).max
        wrong = ~((values >= 0) & (values <= top) & (values == np.floor(values)))
        if wrong.any():
            problems.append(f"{name}: expected whole numbers from 0 to {top}, got {values[wrong][0]}")
    for name in ("candidates", "hidden"):
        if ((arrays[name] < 0) | (arrays[name] > 1)).any():
            problems.append(f"{name}: expected values in [0, 1] or NaN")
    if ((arrays["sigmas"] < 0) | np.isinf(arrays["sigmas"])).any():
        problems.append("sigmas: expected finite numbers from 0, or NaN")
    return problems


MIN_IGNORED_SHARE = 0.5
"""Least share of its area in an ignored box from which an anchor or a detection counts neither way, as COCO's lowest
threshold for detections in crowds."""
_NO_BOXES = "boxes_xyxy: expected finite x0 < x1 and y0 < y1"


def _are_boxes(boxes: NDArray[Any]) -> bool:
    return bool(np.isfinite(boxes).all() and (boxes[:, :2] < boxes[:, 2:]).all())


@dataclass(frozen=True, eq=False)
class IgnoredBoxes:
    """Boxes of one image that hold a vehicle without a label, as a structure of arrays of equal length K.

    A detector neither learns from them nor is judged there: what lies in one by `MIN_IGNORED_SHARE` of its area counts
    neither as a vehicle nor as background.

    Args:
        boxes_xyxy: (K, 4) float64, rectified px, x0 < x1 and y0 < y1.
        reasons: (K,) uint8, `IgnoreReason`; OTHER by default.

    Raises:
        DataError: one message with all wrong fields, the expected value beside the actual one.
    """

    boxes_xyxy: Array
    reasons: NDArray[np.uint8] = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        problems: list[str] = []
        boxes = _numbers("boxes_xyxy", self.boxes_xyxy, problems)
        k = len(boxes) if boxes.ndim else 1
        reasons = np.zeros(k) if self.reasons is None else _numbers("reasons", self.reasons, problems)
        if not problems:
            shaped = {"boxes_xyxy": (boxes, (k, 4)), "reasons": (reasons, (k,))}
            problems = [f"{n}: expected shape {s}, got {a.shape}" for n, (a, s) in shaped.items() if a.shape != s]
        if not problems:
            problems = [] if _are_boxes(boxes) else [_NO_BOXES]
            unknown = ~np.isin(reasons, [int(reason) for reason in IgnoreReason])
            if unknown.any():
                problems.append(f"reasons: expected values of IgnoreReason, got {reasons[unknown][0]}")
        if problems:
            raise DataError("ignored boxes: " + "; ".join(problems))
        object.__setattr__(self, "boxes_xyxy", boxes.astype(np.float64, copy=False))
        object.__setattr__(self, "reasons", reasons.astype(np.uint8, copy=False))

    def __len__(self) -> int:
        return len(self.reasons)

    def __getitem__(self, index: Any) -> IgnoredBoxes:
        """Return the boxes at a slice, a bool mask (K,) or an index array."""
        some = object.__new__(IgnoredBoxes)  # validated before
        object.__setattr__(some, "boxes_xyxy", self.boxes_xyxy[index])
        object.__setattr__(some, "reasons", self.reasons[index])
        return some

    @classmethod
    def empty(cls) -> IgnoredBoxes:
        """Return boxes of length 0."""
        return cls(np.empty((0, 4)))

    @classmethod
    def concatenate(cls, parts: Sequence[IgnoredBoxes]) -> IgnoredBoxes:
        """Return all ignored boxes of several images, in order."""
        if not parts:
            return cls.empty()
        return cls(np.concatenate([p.boxes_xyxy for p in parts]), np.concatenate([p.reasons for p in parts]))


@dataclass(frozen=True, eq=False)
class Sample:
    """One rectified image with its labels.

    Args:
        encoded: JPEG or PNG bytes of the rectified image.
        labels: the labels, in the rectified image.
        rectification: frame px -> rectified px; of the whole frame, also where the source is a crop of it.
        camera: the calibration used.
        source: name of the file or of the item of the data set.
        frame: frame number in a video, instance number in BoxCars116k; -1 where there is none.
        time_s: time of the frame in its video, seconds; NaN where there is none.
        split: part of the data set.
        window_xyxy: (4,) frame px, the part of the frame that the source shows; NaN where unknown.
        ignored: boxes of vehicles that have no label.
    """

    encoded: bytes
    labels: Labels
    rectification: Rectification
    camera: Camera
    source: str = ""
    frame: int = -1
    time_s: float = float("nan")
    split: Split = Split.NONE
    window_xyxy: Array = field(default_factory=lambda: np.full(4, np.nan))
    ignored: IgnoredBoxes = field(default_factory=IgnoredBoxes.empty)

    @property
    def image(self) -> NDArray[np.uint8]:
        """The rectified image, (H, W, 3) uint8 BGR, decoded at each access.

        Raises:
            DataError: the bytes are no image, or one of another size than the rectification's.
        """
        return decode_image(
            np.frombuffer(self.encoded, dtype=np.uint8),
            f"sample {self.source} frame {self.frame}",
            expected_wh=self.rectification.size_wh,
        )

    def vertices_px(self) -> tuple[Array, NDArray[np.bool_]]:
        """Return the 3D boxes in the original frame.

        Returns:
            Vertices (N, 8, 2), frame px, in the source's vertex order, and valid (N,) bool: False where the label has
            no 3D box.
        """
        vertices, valid = self.labels.vertices(self.rectification.vpu)
        return self.rectification.points_back(vertices), valid
