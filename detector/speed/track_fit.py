"""Bodies laid over the outlines of a finished track: one size and form per vehicle, one place per sighting."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from detector.speed.contact_point import MaskExtent
from detector.speed.steady_path import SmoothingRules, smooth_path
from detector.speed.track_speed import TrackPoints
from detector.speed.variant import Variant
from detector.speed.view import MeasurementView
from labelgen.geometry import road_cuboids
from labelgen.geometry.body_forms import BodyForms, cuboid_forms, load_body_forms
from labelgen.labeling.fitted.classes import possible_classes
from labelgen.labeling.fitted.fit import fit_bodies
from labelgen.labeling.fitted.outlines import measure_outlines
from labelgen.labeling.fitted.settings import (
    BODY_FIT_SETTINGS,
    DRAWN_MASKS,
    NETWORK_MASKS,
    SILHOUETTE_MASKS,
    BodyFitSettings,
    MaskErrors,
)
from labelgen.labels import VehicleClass
from labelgen.masks.background.source import WORKING_WIDTH

__all__ = ["TrackFitRules", "TrackFitter"]


_BODY = replace(BODY_FIT_SETTINGS, path_sd_m=(30.0, 3.0))


@dataclass(frozen=True)
class TrackFitRules:
    """How tracks are fitted.

    Args:
        max_sightings: sightings, spread evenly over the track, that size and form are found from. More cost time.
        max_places: sightings that get a place of their own; those between have it by interpolation.
        min_sd_m: metres; no place is known better.
        body: settings of the fit; places are left free there, as a straight path would take away changes of speed.
        path: settings of the steady path that is laid through the places afterwards.
    """

    max_sightings: int = 40
    max_places: int = 400
    min_sd_m: float = 0.03
    body: BodyFitSettings = _BODY
    path: SmoothingRules = field(default_factory=SmoothingRules)


class TrackFitter:
    """Lay bodies over the outlines of finished tracks.

    Args:
        view: of the detections, of the variant `fitted3d`.
        rules: thresholds.
    """

    def __init__(self, view: MeasurementView, rules: TrackFitRules | None = None) -> None:
        assert view.variant is Variant.FITTED3D
        self.rules = rules or TrackFitRules()
        self._camera, self._view = view.camera, view
        self._forms: BodyForms = load_body_forms() if view.rectification is None else cuboid_forms()
        self._class_of = np.array([form.vehicle_class for form in self._forms.forms])

    def fit(self, points: TrackPoints) -> TrackPoints:
        """Return the track with measured points and 3D boxes of the fitted body, without sightings it cannot explain.

        Args:
            points: at least one, with outlines.
        """
        rules, camera = self.rules, self._camera
        points = points.take(_spread(len(points.times_s), rules.max_places))
        times = np.array(points.times_s)
        errors, margin_px = self._errors(points)
        outlines = measure_outlines(points.outlines_px, camera, self._view.frame_wh, rules.body, margin_px=margin_px)
        moved = camera.road_points(outlines.bottoms_px[[0, -1]], invalid="nan")[:, 0]
        travelled = float(moved[1] - moved[0])
        sign = int(np.sign(travelled)) if abs(travelled) >= rules.body.moved_m else None
        chosen = np.zeros(len(times), dtype=np.bool_)
        chosen[_spread(len(times), rules.max_sightings)] = True
        bodies = fit_bodies(
            outlines, np.zeros(len(times), dtype=np.int64), times, camera, errors,
            signs=[sign], classes=[possible_classes(points.class_ids)], settings=rules.body, forms=self._forms,
            fitted=None if chosen.all() else chosen,
        )  # fmt: skip
        near = bodies.near_xy
        size = np.asarray(self._view.frame_wh)
        edges = camera.project(road_cuboids(near, bodies.size_lwh)[:, 4:6])
        # Where the border cuts off the contact with the road, the place rests on the upper end of the vehicle alone.
        keep = bodies.found & (bodies.cost <= rules.body.max_cost) & ((edges > 0) & (edges < size)).all(axis=(1, 2))
        rows = np.flatnonzero(keep)
        fitted = points.take(rows)
        if not len(rows):
            return fitted
        sd = np.sqrt(bodies.covariance[rows][:, range(2), range(2)].clip(rules.min_sd_m**2))
        near = smooth_path(near[rows], times[rows], sd, rules.path)
        fitted.along_sd_m = sd[:, 0].tolist()
        fitted.contact_points_px = list(camera.project(near))
        fitted.vertices_px = list(camera.project(road_cuboids(near, bodies.size_lwh[rows])))
        if set(points.class_ids) == {int(VehicleClass.VEHICLE)}:
            fitted.class_ids = self._class_of[bodies.family[rows]].tolist()
        return fitted

    def _errors(self, points: TrackPoints) -> tuple[MaskErrors, float]:
        """Return the errors of a track's outlines, and how near to the border they may be cut by it, px."""
        if self._view.rectification is not None:
            px = self._view.frame_wh[0] / self._view.size_wh[0]
            return MaskErrors(0.5 * px, 0.01, (0.0, 0.5 * px, 0.0), (0.0, 0.005)), 1.5 * px
        width = self._view.frame_wh[0]
        if self._view.mask_extent is MaskExtent.BODY_AND_SHADE:
            return SILHOUETTE_MASKS, max(1.5, 2 * width / WORKING_WIDTH)
        # A network is never sure of its masks.
        return (DRAWN_MASKS, 1.5) if min(points.scores) == 1.0 else (NETWORK_MASKS, 0.01 * width)


def _spread(count: int, at_most: int) -> np.ndarray:
    return np.unique(np.linspace(0, count - 1, min(count, at_most)).round().astype(np.int64))
