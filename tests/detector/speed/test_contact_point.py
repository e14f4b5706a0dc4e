"""Contact points, from the lowest lines of masks."""

from __future__ import annotations

import numpy as np
import pytest
from speed_scenes import make_camera

from detector.speed.contact_point import MaskExtent, contact_distance_m, move_to_contact_point
from labelgen.geometry.vehicle_bodies import common_bodies


@pytest.mark.parametrize("height_m", [5.0, 8.0, 15.0])
@pytest.mark.parametrize("distance_m", [8.0, 20.0, 60.0])
def test_distances_of_common_bodies_follow_from_their_lowest_lines(height_m: float, distance_m: float) -> None:
    errors, uncorrected, shares = [], [], []
    for body in common_bodies():
        for sign in (1.0, -1.0):
            x, z = -sign * body.points[:, 0], body.points[:, 2]
            # The end is at the distance; a point above the road is seen on the road farther away.
            lowest = ((distance_m + x - x.min()) * height_m / (height_m - z)).min()
            errors.append(float(contact_distance_m(lowest, height_m)) - distance_m)
            uncorrected.append(lowest - distance_m)
            shares.append(body.share / 2)
    # Correct on average, and with a smaller spread than without.
    assert np.average(errors, weights=shares) == pytest.approx(0, abs=0.05)
    assert np.average(uncorrected, weights=shares) > 0.05
    assert np.sqrt(np.average(np.square(errors), weights=shares)) < 0.6 * np.sqrt(
        np.average(np.square(uncorrected), weights=shares)
    )


def test_masks_end_at_the_tyres_far_away_and_at_the_bumper_nearby() -> None:
    lowest = np.array([4.0, 8.0, 16.0, 32.0, 64.0, 200.0])
    behind = lowest - contact_distance_m(lowest, 7.0)
    assert (np.diff(behind) > -1e-9).all()
    assert behind[0] < 0.3
    assert 0.7 < behind[-1] < 1.1


def test_points_of_low_cameras_are_not_moved() -> None:
    np.testing.assert_array_equal(contact_distance_m([5.0, 50.0], 1.2), [5.0, 50.0])


def test_points_move_along_the_road_towards_the_camera() -> None:
    camera = make_camera()
    places = np.array([[20.0, -2.0], [45.0, 3.0]])
    moved = camera.road_points(move_to_contact_point(camera, camera.project(places)))
    np.testing.assert_allclose(moved[:, 1], places[:, 1], atol=1e-6)
    np.testing.assert_allclose(moved[:, 0], contact_distance_m(places[:, 0], camera.height_m), atol=1e-6)
    beyond = (camera.vp1 - [0.0, 500.0])[None]
    np.testing.assert_array_equal(move_to_contact_point(camera, beyond), beyond)


def test_background_masks_end_on_the_shade_and_half_a_pixel_too_high() -> None:
    camera = make_camera()
    edges = np.array([[12.0, -2.0, 0.0], [30.0, 1.0, 0.0], [60.0, 3.0, 0.0]])
    # A background mask ends 0.18 m farther away and half a pixel of its own resolution higher.
    lost = 0.5 * camera.image_wh[0] / 640
    lowest = camera.project(edges + np.array([0.18, 0.0, 0.0])) - np.array([0.0, lost])
    moved = move_to_contact_point(camera, lowest, MaskExtent.BODY_AND_SHADE)
    np.testing.assert_allclose(camera.road_points(moved), edges[:, :2], atol=1e-6)
    # Half a pixel is much road far away and little nearby, so no constant shift in metres is right for both.
    shifts = camera.road_points(lowest)[:, 0] - edges[:, 0]
    assert shifts[2] > 2 * shifts[0]
    beyond = (camera.vp1 - [0.0, 500.0])[None]
    np.testing.assert_array_equal(move_to_contact_point(camera, beyond, MaskExtent.BODY_AND_SHADE), beyond)
