"""Passages of simulated and of real traffic."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from real_traffic import gather, read_tracks
from road_traffic import Traffic, count_pairs, random_sightings

from labelgen.errors import DataError
from labelgen.labeling.fitted.passages import PassageJoiner, join_passages


@pytest.mark.parametrize(
    ("traffic", "found"),
    [
        (Traffic(duration_s=60), 0.9),
        (Traffic(duration_s=60, headway_s=1.5), 0.9),
        (Traffic(duration_s=60, speed_ms=33, headway_s=1.3, range_m=(15, 120)), 0.9),
        (Traffic(duration_s=60, speed_ms=12, headway_s=2, stops=True), 0.9),
        (Traffic(duration_s=20, headway_s=1.5, step_s=0.08), 0.95),
        (Traffic(duration_s=10, headway_s=1.5, step_s=0.02), 0.95),
    ],
)
def test_vehicles_are_joined_and_kept_apart(traffic: Traffic, found: float) -> None:
    sightings, vehicles = random_sightings(traffic, seed=0)
    counts = count_pairs(sightings, vehicles, join_passages(sightings))
    assert counts.found > found
    assert counts.wrong <= max(0.002 * counts.joins, 2)


@pytest.mark.parametrize(("every_frame", "found"), [(4, 0.95), (25, 0.85)])
def test_real_vehicles_are_joined_and_kept_apart(real_data: Path, every_frame: int, found: float) -> None:
    file = real_data / "brnocompspeed" / "results" / "session3_left" / "system_dubska_bmvc14.json"
    sightings, vehicles = gather(read_tracks(file), 50, every_frame, 200, 1.0, seed=0)
    counts = count_pairs(sightings, vehicles, join_passages(sightings))
    assert counts.found > found
    assert counts.wrong <= 0.002 * counts.joins


def test_frames_one_by_one_give_the_same_passages() -> None:
    sightings, _ = random_sightings(Traffic(duration_s=40), seed=1)
    joiner, passages = PassageJoiner(), []
    for frame in np.unique(sightings.frames):
        passages += joiner.add(sightings.take(sightings.frames == frame))
    passages += joiner.finish()
    numbers = np.full(len(sightings), -1)
    for number, members in enumerate(sorted(passages, key=lambda members: int(members[0]))):
        numbers[members] = number
    assert (numbers == join_passages(sightings)).all()


def test_a_part_of_a_video_gives_the_same_links() -> None:
    sightings, _ = random_sightings(Traffic(duration_s=80), seed=2)
    part = (sightings.times_s >= 20) & (sightings.times_s < 60)
    middle = (sightings.times_s >= 30) & (sightings.times_s < 50)
    whole, alone = join_passages(sightings)[middle], join_passages(sightings.take(part))[middle[part]]
    assert ((whole[:, None] == whole) == (alone[:, None] == alone)).all()


def test_frames_out_of_order_are_refused() -> None:
    sightings, _ = random_sightings(Traffic(duration_s=20), seed=1)
    joiner = PassageJoiner()
    joiner.add(sightings)
    with pytest.raises(DataError, match="in order"):
        joiner.add(sightings)
    with pytest.raises(DataError, match="ascending"):
        sightings.take(np.arange(len(sightings))[::-1])
