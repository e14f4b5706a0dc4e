"""Contact points, from the lowest lines of masks."""

from __future__ import annotations

import numpy as np
import pytest
from speed_scenes import make_camera

from detector.speed.contact_point import MaskExtent, contact_distance_m, move_to_contact_point
from labelgen.geometry.vehicle_bodies import common_bodies


@pytest.mark.parametrize("height_m", [5.0, 8.0, 15.0])
@pytest.mark.parametrize("distance_m", [8.0, 20.0, 60.0])
def test_the_lowest_line_of_common_bodies_leads_back_to_their_ends(height_m: float, distance_m: float) -> None:
    misses, raw, shares = [], [], []
    for body in common_bodies():
        for sign in (1.0, -1.0):
            x, z = -sign * body.points[:, 0], body.points[:, 2]
            # The end stands at the distance; what is farther up is seen on the road farther away.
            seen = ((distance_m + x - x.min()) * height_m / (height_m - z)).min()
            misses.append(float(contact_distance_m(seen, height_m)) - distance_m)
            raw.append(seen - distance_m)
            shares.append(body.share / 2)
    # Right on average, and nearer than before for each.
    assert np.average(misses, weights=shares) == pytest.approx(0, abs=0.05)
    assert np.average(raw, weights=shares) > 0.05
    assert np.sqrt(np.average(np.square(misses), weights=shares)) < 0.6 * np.sqrt(
        np.average(np.square(raw), weights=shares)
    )


def test_from_far_it_is_where_the_tyres_stand_and_from_near_the_bumper() -> None:
    seen = np.array([4.0, 8.0, 16.0, 32.0, 64.0, 200.0])
    behind = seen - contact_distance_m(seen, 7.0)
    assert (np.diff(behind) > -1e-9).all()
    assert behind[0] < 0.3
    assert 0.7 < behind[-1] < 1.1


def test_low_cameras_leave_points_alone() -> None:
    np.testing.assert_array_equal(contact_distance_m([5.0, 50.0], 1.2), [5.0, 50.0])


def test_points_move_along_the_road_towards_the_camera() -> None:
    camera = make_camera()
    places = np.array([[20.0, -2.0], [45.0, 3.0]])
    moved = camera.road_points(move_to_contact_point(camera, camera.project(places)))
    np.testing.assert_allclose(moved[:, 1], places[:, 1], atol=1e-6)
    np.testing.assert_allclose(moved[:, 0], contact_distance_m(places[:, 0], camera.height_m), atol=1e-6)
    beyond = (camera.vp1 - [0.0, 500.0])[None]
    np.testing.assert_array_equal(move_to_contact_point(camera, beyond), beyond)


def test_masks_with_the_shade_end_nearly_at_the_edge_and_a_part_of_a_pixel_too_high() -> None:
    camera = make_camera()
    edges = np.array([[12.0, -2.0, 0.0], [30.0, 1.0, 0.0], [60.0, 3.0, 0.0]])
    # What a background model sees of them: a hand's breadth farther away, and half a working pixel higher.
    lost = 0.5 * camera.image_wh[0] / 640
    seen = camera.project(edges + np.array([0.18, 0.0, 0.0])) - np.array([0.0, lost])
    moved = move_to_contact_point(camera, seen, MaskExtent.BODY_AND_SHADE)
    np.testing.assert_allclose(camera.road_points(moved), edges[:, :2], atol=1e-6)
    # Far away half a pixel is as much as a body's overhang, nearby it is nothing: no shift of one length does both.
    shifts = camera.road_points(seen)[:, 0] - edges[:, 0]
    assert shifts[2] > 2 * shifts[0]
    beyond = (camera.vp1 - [0.0, 500.0])[None]
    np.testing.assert_array_equal(move_to_contact_point(camera, beyond, MaskExtent.BODY_AND_SHADE), beyond)
