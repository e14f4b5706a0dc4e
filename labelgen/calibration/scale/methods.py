"""The ways to a scale by name, as the command line asks for them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from labelgen.calibration.observation.silhouettes import Blob
from labelgen.calibration.scale.estimate import ScaleEstimate
from labelgen.calibration.scale.from_dimensions import MEAN_VEHICLE_M, scale_from_dimensions
from labelgen.calibration.scale.from_distances import parse_distance, scale_from_distances
from labelgen.calibration.scale.from_models import scale_from_models
from labelgen.errors import CalibrationError
from labelgen.geometry import Camera

__all__ = ["SCALE_WAYS", "ScaleWay", "scale_way"]

SCALE_WAYS = (
    "auto-models, auto-dimensions[:LENGTH,WIDTH,HEIGHT], distance:x1,y1,x2,y2,METRES or lane:x1,y1,x2,y2,METRES"
)


@dataclass(frozen=True, eq=False)
class ScaleWay:
    """A way to a scale; called when the camera is known (`labelgen.calibration.pipeline.EstimateScale`).

    Args:
        name: as asked for.
        estimate: from the camera and the silhouettes of vehicles to the scale; CalibrationError when the video cannot
            carry it.
    """

    name: str
    estimate: Callable[[Camera, Sequence[Blob]], ScaleEstimate]

    def __call__(self, camera: Camera, blobs: Sequence[Blob]) -> ScaleEstimate:
        """The scale of a camera."""
        return self.estimate(camera, blobs)


def scale_way(texts: Sequence[str]) -> ScaleWay:
    """The way that `--scale` names.

    Args:
        texts: one automatic way; or any number of known distances, along or across the road.

    Raises:
        CalibrationError: an unknown way, a distance that is none, or ways that do not go together.
    """
    kinds = [text.partition(":")[::2] for text in texts]
    if kinds and all(kind in ("distance", "lane") for kind, _ in kinds):
        known = [parse_distance(rest, across=kind == "lane") for kind, rest in kinds]
        return ScaleWay("distance", lambda camera, _: scale_from_distances(camera, known))
    if len(kinds) != 1:
        raise CalibrationError(f"--scale {' --scale '.join(texts)}: give one way, or known distances; {SCALE_WAYS}")
    kind, rest = kinds[0]
    if kind == "auto-models" and not rest:
        return ScaleWay(kind, scale_from_models)
    if kind == "auto-dimensions":
        mean = _sizes(rest) if rest else MEAN_VEHICLE_M
        return ScaleWay(kind, lambda camera, blobs: scale_from_dimensions(camera, blobs, mean_m=mean))
    raise CalibrationError(f"--scale {texts[0]}: unknown way; use {SCALE_WAYS}")


def _sizes(text: str) -> tuple[float, ...]:
    try:
        sizes = tuple(float(part) for part in text.split(","))
    except ValueError:
        sizes = ()
    if len(sizes) != 3 or not all(0.1 < size < 100 for size in sizes):
        raise CalibrationError(
            f"--scale auto-dimensions:{text}: expected the mean vehicle's LENGTH,WIDTH,HEIGHT in metres, as "
            "4.27,1.74,1.51"
        )
    return sizes
