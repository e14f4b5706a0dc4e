"""Times from stamps that may be wrong, and from the moments of arrival."""

from __future__ import annotations

import math

import numpy as np
import pytest

from labelgen.media.container.frame_clock import ArrivalClock, FrameClock

NAN = math.nan


def times(stamps: list[float], period_s: float | None = 0.1) -> tuple[list[float], list[str]]:
    clock = FrameClock(period_s)
    items = list(clock.timed((number, stamp, None) for number, stamp in enumerate(stamps)))
    assert [item.number for item in items] == list(range(len(stamps)))
    return [item.time_s for item in items], clock.problems()


@pytest.mark.parametrize(
    ("stamps", "expected", "said"),
    [
        ([5.0, 5.1, 5.2, 5.3], [0, 0.1, 0.2, 0.3], []),
        ([0, 0.03, 0.4, 0.41, 1.9], [0, 0.03, 0.4, 0.41, 1.9], []),
        ([0, 0.1, 3600, 0.3, 0.4], [0, 0.1, 0.2, 0.3, 0.4], ["1 time stamp missing or out of line", "first: frame 2"]),
        ([0, 0.1, -50, 0.3, 0.4], [0, 0.1, 0.2, 0.3, 0.4], ["1 time stamp missing or out of line"]),
        ([0, 0.1, NAN, 0.3, NAN, NAN], [0, 0.1, 0.2, 0.3, 0.4, 0.5], ["3 time stamps missing"]),
        ([0, 0.1, 0.1, 0.3], [0, 0.1, 0.2, 0.3], ["first: frame 2"]),
        ([700, 0.1, 0.2, 0.3], [0, 0.1, 0.2, 0.3], ["1 time stamp missing or out of line", "first: frame 0"]),
        ([8, 8.1, 8.2, 0, 0.1], [0, 0.1, 0.2, 0.3, 0.4], ["jumped back 1 time", "by 8.2 s at frame 3"]),
        ([0, 0.1, 30.2, 30.3], [0, 0.1, 30.2, 30.3], ["1 gap in the recording (first: 30.0 s before frame 2)"]),
        ([NAN, NAN, NAN], [0, 0.1, 0.2], ["3 time stamps missing"]),
        ([], [], []),
    ],
)
def test_stamps_are_not_trusted_one_by_one(stamps: list[float], expected: list[float], said: list[str]) -> None:
    found, problems = times(stamps)
    assert found == pytest.approx(expected)
    assert len(problems) == (1 if said else 0)
    assert all(part in problems[0] for part in said)


def test_gaps_are_known_apart_from_the_time() -> None:
    clock = FrameClock(0.1)
    stamps = [0, 0.1, 60.2, 60.3, 100.4]
    items = list(clock.timed(enumerate_stamps(stamps)))
    assert [item.time_s - item.gaps_s for item in items] == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])
    assert clock.problems() == ["2 gaps in the recording, 100.0 s together (first: 60.0 s before frame 2)"]


def enumerate_stamps(stamps: list[float]) -> list[tuple[int, float, None]]:
    return [(number, stamp, None) for number, stamp in enumerate(stamps)]


def test_frames_left_out_are_no_gap() -> None:
    clock = FrameClock(0.1)
    items = list(clock.timed([(0, 0.0, None), (300, 30.0, None), (301, 30.1, None)]))
    assert [item.gaps_s for item in items] == [0, 0, 0]
    assert clock.problems() == []


@pytest.mark.parametrize("seed", range(5))
def test_times_always_increase(seed: int) -> None:
    rng = np.random.default_rng(seed)
    stamps = np.arange(200) * 0.04
    wrong = rng.random(200) < 0.3
    stamps[wrong] += rng.normal(0, 10, wrong.sum())
    stamps[rng.random(200) < 0.1] = NAN
    found, _ = times(stamps.tolist(), 0.04)
    assert np.isfinite(found).all()
    assert (np.diff(found) > 0).all()


def arrivals(clock: ArrivalClock, moments: np.ndarray) -> np.ndarray:
    return np.array([item.time_s for item in clock.timed((n, float(t), None) for n, t in enumerate(moments))])


@pytest.mark.parametrize("fps", [4.0, 10.0, 25.0, 60.0])
def test_arrivals_in_bursts_are_smoothed(fps: float) -> None:
    rng = np.random.default_rng(3)
    sent = np.arange(round(20 * fps)) / fps
    # The network keeps frames for up to 60 ms, and the first five wait until the stream is open.
    moments = np.maximum.accumulate(100 + sent + rng.uniform(0, 0.06, len(sent)))
    moments[:5] = moments[5] - 0.001
    clock = ArrivalClock()
    found = arrivals(clock, moments)
    assert clock.fps == pytest.approx(fps, rel=0.01)
    # Speeds come from the times of frames five apart.
    assert found[5:] - found[:-5] == pytest.approx(5 / fps, rel=0.03)
    assert found[-1] == pytest.approx(sent[-1], rel=0.015)
    assert clock.problems() == []


def test_a_pause_among_arrivals_is_a_gap() -> None:
    moments = np.arange(100) / 10 + 7.0
    moments[60:] += 4.0
    for clock in (ArrivalClock(), ArrivalClock(10.0)):
        found = arrivals(clock, moments)
        assert np.diff(found)[59] == pytest.approx(4.1, abs=0.05)
        assert np.delete(np.diff(found), 59) == pytest.approx(0.1, rel=0.01)
        [line] = clock.problems()
        assert "1 gap in the recording (first: 4.0 s before frame 60)" in line


def test_a_given_rate_comes_before_arrivals() -> None:
    found = arrivals(ArrivalClock(20.0), np.arange(50) / 21)
    assert found == pytest.approx(np.arange(50) / 20)


def test_a_rate_that_changes_is_followed() -> None:
    moments = np.concatenate([np.arange(200) / 20, 10 + np.arange(1, 301) / 10])
    clock = ArrivalClock()
    found = arrivals(clock, moments)
    assert clock.fps == pytest.approx(10, rel=0.01)
    assert np.diff(found)[-50:] == pytest.approx(0.1, rel=0.02)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_streams_of_few_frames(count: int) -> None:
    assert len(arrivals(ArrivalClock(), np.arange(count) / 10)) == count
