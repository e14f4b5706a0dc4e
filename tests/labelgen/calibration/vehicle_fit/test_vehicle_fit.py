"""Vehicle bodies fitted to drawn silhouettes."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from labelgen.calibration.observation.silhouettes import VehicleSilhouette
from labelgen.calibration.road_units import unit_camera
from labelgen.calibration.vehicle_fit.measurements import measure_silhouettes
from labelgen.calibration.vehicle_fit.model_fit import BodyHypotheses, initial_fit
from labelgen.calibration.vehicle_fit.optimize import optimize_fit
from labelgen.calibration.vehicle_fit.residuals import fit_residuals
from labelgen.calibration.vehicle_fit.settings import VehicleFitSettings
from labelgen.geometry.camera import look_at_road
from labelgen.geometry.vehicle_bodies import common_bodies


def test_the_size_and_places_of_a_vehicle_come_back():
    camera = look_at_road(9.0, (35.0, 5.0), 2000, (1920, 1080), 0.5)
    unit = unit_camera(camera)
    bodies = common_bodies()
    outlines = []
    places = [(60.0, 2.0), (40.0, 1.5), (25.0, 1.0)]
    for k, (x, y) in enumerate(places):
        px = camera.project(bodies[1].points + np.array([x, y, 0]))
        outlines.append(VehicleSilhouette(k, float(k), cv2.convexHull(px.astype(np.float32))[:, 0].astype(np.float64)))
    settings = VehicleFitSettings()
    measured, numbers = measure_silhouettes(unit, outlines, np.array([7, 7, 7]), settings)
    assert numbers.tolist() == [0, 1, 2]
    hypotheses = BodyHypotheses.from_bodies(bodies)
    fit = optimize_fit(unit, measured, hypotheses, initial_fit(measured, hypotheses, settings), 12, settings)
    costs = fit.sum_over_pairs(fit_residuals(unit, measured, hypotheses, fit, settings).costs)
    # Pairs are in the order of the bodies, driving away before coming closer.
    assert int(costs.argmin()) == 2
    assert np.exp(-fit.shape[2, 0]) == pytest.approx(camera.scale, rel=0.02)
    assert camera.scale is not None
    fitted_m = fit.place[fit.pair == 2] * camera.scale
    assert np.abs(fitted_m - places).max() < 0.6
