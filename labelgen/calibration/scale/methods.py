"""The methods for the scale, by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from labelgen.calibration.observation.silhouettes import VehicleSilhouette
from labelgen.calibration.scale.estimate import ScaleEstimate
from labelgen.calibration.scale.from_dimensions import MEAN_VEHICLE_M, scale_from_dimensions
from labelgen.calibration.scale.from_distances import parse_distance, scale_from_distances
from labelgen.calibration.scale.from_models import scale_from_models
from labelgen.errors import CalibrationError
from labelgen.geometry import Camera

__all__ = ["SCALE_METHODS", "ScaleMethod", "parse_scale_method"]

SCALE_METHODS = (
    "auto-models, auto-dimensions[:LENGTH,WIDTH,HEIGHT], distance:x1,y1,x2,y2,METRES or lane:x1,y1,x2,y2,METRES"
)
"""The forms that `parse_scale_method` takes."""


@dataclass(frozen=True, eq=False)
class ScaleMethod:
    """A method for the scale of a camera; call it with the camera and the silhouettes of vehicles.

    Args:
        name: as asked for.
        estimate: from the camera, whose scale is not used, and the silhouettes to the scale; raises CalibrationError
            when the video carries none.
    """

    name: str
    estimate: Callable[[Camera, Sequence[VehicleSilhouette]], ScaleEstimate]

    def __call__(self, camera: Camera, silhouettes: Sequence[VehicleSilhouette]) -> ScaleEstimate:
        """Estimate the scale of a camera."""
        return self.estimate(camera, silhouettes)


def parse_scale_method(scale: Sequence[str]) -> ScaleMethod:
    """Return the method of a name.

    Args:
        scale: one automatic method; or any number of known distances, along or across the road (`SCALE_METHODS`).

    Raises:
        CalibrationError: an unknown method, a distance of the wrong form, or methods that exclude each other.
    """
    kinds = [text.partition(":")[::2] for text in scale]
    if kinds and all(kind in ("distance", "lane") for kind, _ in kinds):
        known = [parse_distance(rest, across=kind == "lane") for kind, rest in kinds]
        return ScaleMethod("distance", lambda camera, _: scale_from_distances(camera, known))
    if len(kinds) != 1:
        raise CalibrationError(
            f"scale {' '.join(scale)}: give one method, or known distances; {SCALE_METHODS}", parameter="scale"
        )
    kind, rest = kinds[0]
    if kind == "auto-models" and not rest:
        return ScaleMethod(kind, scale_from_models)
    if kind == "auto-dimensions":
        mean = _parse_sizes(rest) if rest else MEAN_VEHICLE_M
        return ScaleMethod(kind, lambda camera, silhouettes: scale_from_dimensions(camera, silhouettes, mean_m=mean))
    raise CalibrationError(f"scale {scale[0]}: unknown method; use {SCALE_METHODS}", parameter="scale")


def _parse_sizes(text: str) -> tuple[float, ...]:
    try:
        sizes = tuple(float(part) for part in text.split(","))
    except ValueError:
        sizes = ()
    if len(sizes) != 3 or not all(0.1 < size < 100 for size in sizes):
        raise CalibrationError(
            f"scale auto-dimensions:{text}: expected the mean vehicle's LENGTH,WIDTH,HEIGHT in metres, as "
            "4.27,1.74,1.51",
            parameter="scale",
        )
    return sizes
