"""Lanes, measured stretch, crossings: each part of the protocol on cases small enough to do by hand."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from score_scenes import Traffic

from detector.evaluation.brnocompspeed import line_crossings, prefilter
from detector.tracking.tracks import Tracks
from labelgen.geometry.lanes import lanes_of

NAN = float("nan")


def track(xs: Any, ys: Any, frames: Any = None) -> Tracks:
    frames = list(range(len(xs))) if frames is None else list(frames)
    return Tracks.from_cars([{"id": 1, "posX": list(xs), "posY": list(ys), "frames": frames}])


UP_Y = [100.0 + 10 * i for i in range(40)]
RIGHT_X = [300.0 + 5 * i for i in range(40)]


@pytest.mark.parametrize(
    ("line", "place", "frame"),
    [
        # The track is y = 2 x - 500, at frame i in (300 + 5 i, 100 + 10 i).
        ([0.0, 1.0, -355.0], [427.5, 355.0], 25.5),
        ([0.0, -4.0, 4 * 355.0], [427.5, 355.0], 25.5),
        ([1.0, 0.0, -401.0], [401.0, 302.0], 20.2),
        # y = -x + 700 meets y = 2 x - 500 where x = 400: frame 20.
        ([1.0, 1.0, -700.0], [400.0, 300.0], 20.0),
        # Before the first and after the last point: the fit goes on.
        ([0.0, 1.0, -50.0], [275.0, 50.0], -5.0),
        ([0.0, 1.0, -600.0], [550.0, 600.0], 50.0),
    ],
)
def test_uniform_motion_is_crossed_where_and_when_it_must(line: list[float], place: list[float], frame: float) -> None:
    got = line_crossings(track(RIGHT_X, UP_Y), np.array(line))
    np.testing.assert_allclose(got.points_px, [place], rtol=1e-9)
    np.testing.assert_allclose(got.frames, [frame], rtol=1e-9)


def test_distances_along_the_track_are_unsigned() -> None:
    # The track y = x - 500 crosses y = 0 at x = 500. Of its six points nearest to the line x = 500 three lie on
    # either side, at distances sqrt(2) * (30, 20, 10, 10, 20, 30) for frames 7 to 12 with frame 10 missing:
    # by hand the regression of (7, 8, 9, 11, 12, 13) on these distances has slope 0, so the time is their mean.
    frames = [7, 8, 9, 11, 12, 13]
    xs = [500.0 + 10 * (frame - 10) for frame in frames]
    got = line_crossings(track(xs, [x - 500.0 for x in xs], frames), np.array([1.0, 0.0, -500.0]))
    np.testing.assert_allclose(got.frames, [10.0])


@pytest.mark.parametrize(
    ("xs", "ys"),
    [
        ([400.0] * 40, UP_Y),  # vertical: no slope
        (RIGHT_X, [400.0] * 40),  # horizontal: it never meets y = 0
        ([400.0] * 40, [400.0] * 40),  # standing
        (RIGHT_X, [y - 100 for y in np.array(RIGHT_X) * 2]),  # parallel to the line
    ],
    ids=["vertical", "horizontal", "standing", "parallel"],
)
def test_a_fit_without_a_crossing_is_not_finite_and_does_not_crash(xs: Any, ys: Any) -> None:
    line = np.array([2.0, -1.0, 400.0]) if ys[0] != ys[1] and xs[0] != xs[1] else np.array([0.1, 1.0, -440.0])
    assert not line_crossings(track(xs, ys), line).finite.any()


def test_only_the_six_nearest_points_count_and_equal_ones_in_track_order() -> None:
    # Points 12 px from the line y = 300 on both sides; the seventh nearest lies far off the straight line.
    ys = [294.0, 296.0, 298.0, 302.0, 304.0, 306.0, 306.0]
    xs = [394.0, 396.0, 398.0, 402.0, 404.0, 406.0, 999.0]
    first = line_crossings(track(xs, ys), np.array([0.0, 1.0, -300.0]))
    np.testing.assert_allclose(first.points_px, [[400.0, 300.0]])
    swapped = line_crossings(track(xs[:5] + xs[:4:-1], ys), np.array([0.0, 1.0, -300.0]))
    assert abs(swapped.points_px[0, 0] - 400.0) > 1


@pytest.mark.parametrize(
    ("x", "lane"),
    [(99.9, -1), (100.0, 0), (150.0, 0), (200.0, 0), (200.1, 1), (300.0, 1), (300.1, -1), (NAN, -1)],
)
@pytest.mark.parametrize("signs", [(1, 1, 1), (-1, 1, -1), (2, -3, 5)])
def test_lanes_hold_their_borders_and_the_first_one_wins(x: float, lane: int, signs: tuple[int, ...]) -> None:
    lines = np.array([[1.0, 0.0, -border] for border in (100, 200, 300)]) * np.array(signs)[:, None]
    assert lanes_of(np.array([[x, 500.0]]), lines).tolist() == [lane]


def long_track(scene: Traffic, **changes: Any) -> dict[str, Any]:
    return scene.track(10.0, 20.0, 1) | changes


@pytest.mark.parametrize(
    ("car", "reason"),
    [
        (lambda s: "car", "not an object"),
        (lambda s: None, "not an object"),
        (lambda s: long_track(s, posX=512.0, posY=300.0), "without lists"),
        (lambda s: long_track(s, posX=512.0, posY=300.0, frames=7), "without lists"),
        (lambda s: {"id": 3}, "without lists"),
        (lambda s: long_track(s, posX=[], posY=[], frames=[]), "without points"),
        (lambda s: long_track(s, frames=[1, 2, 3]), "lists of different lengths"),
        (lambda s: long_track(s, posX=["a"] * 3, posY=[1] * 3, frames=[1] * 3), "not numbers"),
        (lambda s: long_track(s, posX=[[1], [2]], posY=[1, 2], frames=[1, 2]), "not numbers"),
        (lambda s: long_track(s, posX=[1, None], posY=[1, 2], frames=[1, 2]), "not numbers"),
        (lambda s: long_track(s, posX=[1.0, 2.0], posY=[1.0, 2.0], frames=[NAN, 2.0]), "not numbers"),
        (lambda s: s.track(30.0, 20.0, 1), "after the ground truth"),
        (lambda s: {k: v[:5] for k, v in long_track(s).items() if k != "id"}, "too few points"),
        (lambda s: long_track(s, posX=[5.0] * len(long_track(s)["posX"])), "too few points"),
        (lambda s: long_track(s, posX=[x + 2000 for x in long_track(s)["posX"]]), "too few points"),
        (lambda s: s.track(10.0, 20.0, 3), "outside the lanes"),
        (lambda s: s.track(10.0, 20.0, 2), "in an invalid lane"),
        (lambda s: {k: v[-10:] for k, v in long_track(s).items() if k != "id"}, "not between the measurement lines"),
    ],
)
def test_cars_that_do_not_count_are_counted_with_the_reason(scene: Traffic, car: Any, reason: str) -> None:
    scene.add_both(10.0, 20.0, 0)
    scene.invalid_lanes = {2}
    scene.cars.append(car(scene))
    kept = prefilter(scene.tracks(), scene.truth())
    assert kept.ids == (0,)
    assert kept.dropped == Counter({reason: 1})


def test_points_within_ten_pixels_of_the_border_are_left_out(scene: Traffic) -> None:
    scene.add_both(10.0, 20.0, 0)
    truth = replace(scene.truth(), lane_lines=np.array([[1.0, 0.0, 0.0], [1.0, 0.0, -1920.0]]))
    xs = [10.0, 10.5, 1909.5, 1910.0, *([500.0] * 20)]
    ys = [500.0] * 4 + [10.0, 10.5, 1069.5, 1070.0] + [300.0 + i for i in range(16)]
    truth = replace(truth, measurement_lines=np.array([[0.0, 1.0, -1000.0], [0.0, 1.0, -11.0]]))
    kept = prefilter(track(xs, ys), truth)
    assert kept.points_px[:4].tolist() == [[10.5, 500.0], [1909.5, 500.0], [500.0, 10.5], [500.0, 1069.5]]
    assert len(kept.frames) == 20


def test_the_first_time_seen_counts_before_points_are_left_out(scene: Traffic) -> None:
    # Seen at the border long before the last ground-truth car, and in the picture only after it.
    scene.add_both(10.0, 20.0, 0)
    late = scene.track(30.0, 20.0, 1)
    late = {"id": 9, "frames": [0, *late["frames"]], "posX": [1.0, *late["posX"]], "posY": [1.0, *late["posY"]]}
    scene.cars.append(late)
    assert prefilter(scene.tracks(), scene.truth()).ids == (0, 9)


@pytest.mark.parametrize(("first_frame", "kept"), [(499, True), (500, False)])
def test_a_car_first_seen_at_the_last_true_crossing_is_too_late(scene: Traffic, first_frame: int, kept: bool) -> None:
    scene.add_truth(10.0, 20.0, 0)  # frame 500 at 50 frames per second
    model = scene.track(12.0, 20.0, 1)
    scene.cars.append(model | {"frames": [first_frame + i for i in range(len(model["frames"]))]})
    assert (len(prefilter(scene.tracks(), scene.truth())) == 1) == kept


@pytest.mark.parametrize(("points", "kept"), [(5, False), (6, True)])
def test_six_points_are_enough(scene: Traffic, points: int, kept: bool) -> None:
    scene.add_truth(10.0, 20.0, 0)
    model = scene.track(10.0, 20.0, 0)
    middle = slice(20, 20 + points)
    scene.cars.append({key: model[key][middle] for key in ("frames", "posX", "posY")})
    assert (len(prefilter(scene.tracks(), scene.truth())) == 1) == kept
