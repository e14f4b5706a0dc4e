"""A pass over a recording that was interrupted for a while."""

from __future__ import annotations

from pathlib import Path

import av
import pytest
from speed_scenes import Drive, frame_times, write_scene, write_video

from labelgen.calibration.observation.collect import observe
from labelgen.media.open_frames import open_frames

DRIVES = [Drive(60.0, 38.0, 2.0), Drive(72.0, 16.0, -3.0, 1), Drive(48.0, 60.0, 2.2), Drive(50.0, 65.0, -1.0)]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same frames, once in a row and once with an hour between two of them."""
    folder = tmp_path_factory.mktemp("gap")
    times = frame_times(6.0, 25.0)
    whole = write_scene(folder, DRIVES, times)
    with av.open(str(whole)) as container:
        pictures = [frame.to_ndarray(format="bgr24") for frame in container.decode(video=0)]
    write_video(folder / "gap.mkv", pictures, [t if t < 3 else t + 3600 for t in times])
    return whole, folder / "gap.mkv"


def test_a_gap_hides_nothing(recordings: tuple[Path, Path]) -> None:
    whole, gap = (observe(open_frames(path)) for path in recordings)
    assert gap.duration_s == pytest.approx(whole.duration_s, abs=0.1)
    after = [track for track in gap.tracks if track.times_s[0] > 3600]
    assert len(after) >= 0.3 * len([track for track in whole.tracks if track.times_s[0] > 3])
    assert not any(track.times_s[0] < 3 and track.times_s[-1] > 3600 for track in gap.tracks)


def test_a_duration_does_not_count_a_gap(recordings: tuple[Path, Path]) -> None:
    assert observe(open_frames(recordings[1]), duration_s=4.0).duration_s == pytest.approx(4.0, abs=0.1)
