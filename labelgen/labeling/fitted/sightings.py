"""Sightings: masks of vehicles as places and sizes on the road, and the thresholds by which they are joined.

Convention:
    Points are (N, 2) float64 metres on the road, X along VP1, Y to the left; sightings stand in the order of time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labelgen.errors import DataError
from labelgen.geometry.homography import Array, IntArray

__all__ = ["PASSAGE_SETTINGS", "BoolArray", "PassageSettings", "Sightings"]

BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class Sightings:
    """Masks of one video in the order of time; all arrays of one length N.

    Args:
        times_s: (N,) seconds, not descending; the same for all masks of a frame.
        frames: (N,) numbers of the frames, not descending.
        points_m: (N, 2) where the middle of the mask's lower side meets the road, metres; NaN is joined with nothing.
        widths_m: (N,) width of the lower side on the road, metres, roughly.
        heights_m: (N,) height or another measure of size, roughly.
        class_ids: (N,) 0 where the class is unknown.
        cut: (N,) bool, whether the frame's border cuts the mask.
        m_per_px: (N, 2) length on the road of one pixel of the frame at the point, along and across, metres; zeros
            where left out.
        every_frame: distance of the frames that were searched for masks: 1 if all were.

    Raises:
        DataError: lengths differ, the order is wrong, or `every_frame` is less than 1.
    """

    times_s: Array
    frames: IntArray
    points_m: Array
    widths_m: Array
    heights_m: Array
    class_ids: IntArray
    cut: BoolArray
    m_per_px: Array | None = None
    every_frame: int = 1

    def __post_init__(self) -> None:
        n = len(self.times_s)
        if self.m_per_px is None:
            object.__setattr__(self, "m_per_px", np.zeros((n, 2)))
        problems = [
            f"{name}: expected shape {shape}, got {value.shape}"
            for name, value in self._arrays().items()
            if value.shape != (shape := (n, 2) if name in ("points_m", "m_per_px") else (n,))
        ]
        if not problems:
            problems += [
                f"{name}: expected an ascending order"
                for name, value in (("times_s", self.times_s), ("frames", self.frames))
                if not (np.diff(value) >= 0).all()
            ]
        if self.every_frame < 1:
            problems.append(f"every_frame: expected 1 or more, got {self.every_frame}")
        if problems:
            raise DataError("sightings: " + "; ".join(problems))

    def __len__(self) -> int:
        return len(self.times_s)

    def _arrays(self) -> dict[str, NDArray[Any]]:
        return {field.name: getattr(self, field.name) for field in fields(self) if field.name != "every_frame"}

    def take(self, index: IntArray | BoolArray | slice) -> Sightings:
        """Return some of the sightings."""
        arrays: dict[str, Any] = {name: value[index] for name, value in self._arrays().items()}
        return replace(self, **arrays)

    @classmethod
    def joined(cls, parts: Sequence[Sightings]) -> Sightings:
        """Return the sightings of parts of one video that follow each other."""
        columns = [part._arrays() for part in parts]
        arrays: dict[str, Any] = {name: np.concatenate([part[name] for part in columns]) for name in columns[0]}
        return replace(parts[0], **arrays)


@dataclass(frozen=True)
class PassageSettings:
    """Thresholds of the joining."""

    block_s: float = 5.0
    """Time whose links are decided at once, seconds. Blocks begin at multiples of it."""
    margin_s: float = 5.0
    """Time before and after a block whose sightings decide its links, seconds."""
    max_missed: int = 2
    """Most frames without a sighting within a link."""
    max_gap_s: float = 1.6
    """Longest time without a sighting, seconds: after more, another vehicle may be there."""
    max_length_s: float = 60.0
    """Longest passage, seconds; a vehicle that stands longer gives several, so that memory stays flat."""
    turn_m: float = 4.0
    """Longest way in the other direction within a passage, metres: errors of points; vehicles do not turn round."""
    max_speed_ms: float = 60.0
    """Highest speed along the road, m/s."""
    usual_speed_ms: float = 45.0
    """Up to this speed no speed is less likely than another, m/s."""
    drift_ms: float = 0.5
    """Standard deviation of the speed across the road, m/s: a change of lanes is 1 m/s."""
    heading: float = 0.03
    """Standard deviation of the drift across the road per metre along it: bends and errors of VP1."""
    acceleration_ms2: float = 2.0
    """Standard deviation of the acceleration, m/s^2: braking in traffic; three times as much in an emergency."""
    noise_m: tuple[float, float] = (0.35, 0.2)
    """Standard deviation of a point along and across the road, metres, without what a pixel adds."""
    noise_px: float = 1.0
    """The same of the mask's lower side, px."""
    cut_noise_m: tuple[float, float] = (2.5, 0.7)
    """The same of a mask that the border cuts, metres: up to a vehicle's length is missing."""
    size_ratio: float = 0.2
    """Standard deviation of the logarithm of the ratio of two sizes of one vehicle."""
    class_cost: float = 1.5
    """Cost of two classes that differ: networks call one vehicle a car and a van."""
    missed_cost: float = 2.5
    """Cost of each frame without a sighting within a link: about one sighting in ten is missing."""
    link_gain: float = 6.0
    """Score of a link without costs: a vehicle is seen again far more often than it ends and another begins there."""
    false_length_m: float = 15.0
    """Range along the road over which the prediction of a false link errs, metres."""
    max_misfit: float = 6.0
    """Largest cost of a pair of successive links: more, 3.5 standard deviations, and the velocity is not constant."""
    rounds: int = 4
    """Links that a prediction looks ahead and back."""
    margins: tuple[float, ...] = (6.0, 4.5, 3.5)
    """By how much a link must be better than the others of its sightings, in one round after another."""
    min_score: float = 3.5
    """Least score of a link."""
    double_m: tuple[float, float] = (2.5, 1.2)
    """Masks of a frame closer than this along and across the road, metres, show one vehicle: the larger counts."""
    lane_m: float = 0.8
    """Standard deviation of the places across the road at which vehicles drive at the speed of a lane, metres."""
    lane_speed_ms: float = 3.0
    """Standard deviation of the speeds of a lane within a block and its margins, m/s."""
    lane_support: tuple[float, float] = (-3.0, 3.0)
    """Least and largest score that the speeds of a lane add to a link."""
    min_speed_dt_s: float = 0.15
    """Shortest link whose speed is compared with the lane's, seconds: shorter ones do not tell the speed."""
    baseline_s: float = 0.7
    """Time over which the speed of a row of links is measured, seconds."""


PASSAGE_SETTINGS = PassageSettings()
