"""Scale from known distances: between two points on the road, or across a lane."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from labelgen.calibration.road_units import unit_camera
from labelgen.calibration.scale.estimate import ScaleEstimate
from labelgen.errors import CalibrationError
from labelgen.geometry import Camera

__all__ = ["KnownDistance", "parse_distance", "scale_from_distances"]

_FORM = "write x1,y1,x2,y2,METRES, the two points in px of the frame"


@dataclass(frozen=True)
class KnownDistance:
    """A distance on the road.

    Args:
        ends_px: (2, 2) px of the frame.
        metres: between them.
        across: False: between the two points. True: a width, between two lines along the road through the points,
            which need not lie abreast.
    """

    ends_px: tuple[tuple[float, float], tuple[float, float]]
    metres: float
    across: bool = False


def parse_distance(text: str, *, across: bool = False) -> KnownDistance:
    """Parse a known distance.

    Args:
        text: "x1,y1,x2,y2,METRES", the points in px of the frame.
        across: see `KnownDistance`.

    Raises:
        CalibrationError: the text is not of this form.
    """
    try:
        x1, y1, x2, y2, metres = (float(part) for part in text.split(","))
    except ValueError:
        raise CalibrationError(f"known distance {text}: expected five numbers; {_FORM}") from None
    if not all(math.isfinite(v) for v in (x1, y1, x2, y2, metres)) or metres <= 0 or (x1, y1) == (x2, y2):
        raise CalibrationError(f"known distance {text}: expected two different points and metres > 0; {_FORM}")
    return KnownDistance(((x1, y1), (x2, y2)), metres, across)


def scale_from_distances(camera: Camera, distances: Sequence[KnownDistance]) -> ScaleEstimate:
    """Return the scale that fits known distances best in the least-squares sense: longer ones weigh more.

    Args:
        camera: its scale is not used.
        distances: at least one.

    Returns:
        the scale; its spread is the standard error of the weighted mean, NaN for a single distance.

    Raises:
        CalibrationError: none given, or a point above the horizon.
    """
    if not distances:
        raise CalibrationError(f"scale: no known distance given; {_FORM}")
    measured = np.array([_road_units(unit_camera(camera), d.ends_px, across=d.across) for d in distances])
    known = np.array([d.metres for d in distances])
    if (measured <= 0).any():
        ends = distances[int(measured.argmin())].ends_px
        raise CalibrationError(f"known distance between {ends[0]} and {ends[1]}: both lie on one line along the road")
    scale = float((known * measured).sum() / (measured**2).sum())
    spread = math.nan
    if len(known) > 1:
        errors = known - scale * measured
        spread = float(np.sqrt((errors**2).sum() / (len(known) - 1) / (measured**2).sum()) / scale)
    return ScaleEstimate(
        scale, len(known), spread, "distance", {"worst_m": float(np.abs(known - scale * measured).max())}
    )


def _road_units(unit: Camera, ends_px: ArrayLike, *, across: bool) -> float:
    """Return the distance of two points (2, 2) px in road units."""
    try:
        start, end = unit.road_points(ends_px)
    except CalibrationError as err:
        raise CalibrationError(f"known distance: {str(err).rpartition(': ')[2]}; give two points on the road") from None
    # Y of the road frame runs along VP2.
    return float(abs(end[1] - start[1]) if across else np.linalg.norm(end - start))
