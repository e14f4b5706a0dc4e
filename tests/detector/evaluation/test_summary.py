"""Rows of figures, tables and plots, from recordings with known errors."""

from __future__ import annotations

import csv
import io

import numpy as np
import pytest
from score_scenes import Traffic, make_scene

from detector.evaluation.brnocompspeed import RecordingScore, score_recording
from detector.evaluation.plots import plot_cumulative_errors
from detector.evaluation.summary import absolute_errors, common_only, pooled_row, recording_row, relative_errors
from detector.evaluation.tables import SPEED_COLUMNS, TableFormat, format_table
from labelgen.errors import DataError, OutputError


def score_of(errors_kmh: list[float | None]) -> RecordingScore:
    """A recording whose cars have these errors; None for a car that was missed. True speed: 50 km/h each."""
    scene = make_scene()
    for number, error in enumerate(errors_kmh):
        scene.add_truth(10.0 + number, 50 / 3.6, 0)
        if error is not None:
            scene.add_track(10.0 + number, (50 + error) / 3.6, 0)
    return score_recording(scene.truth(), scene.tracks(), scene.camera)


def test_pooled_figures_are_over_vehicles_not_over_recordings() -> None:
    many, few = score_of([1.0] * 8 + [None] * 2), score_of([5.0, None])
    row = pooled_row([many, few])
    assert (row["recordings"], row["n"], row["matched"]) == (2, 9, 9)
    assert row["mean"] == pytest.approx((8 * 1 + 5) / 9)
    assert row["median"] == pytest.approx(1)
    assert row["worst"] == pytest.approx(5)
    assert row["mean_relative"] == pytest.approx((8 * 2 + 10) / 9)
    assert row["recall"] == 9 / 12
    assert row["recall_recording_mean"] == pytest.approx((0.8 + 0.5) / 2)


def test_common_vehicles_are_those_all_systems_found() -> None:
    scores = {"a": score_of([1.0, 2.0, None, 4.0]), "b": score_of([5.0, None, 7.0, 8.0])}
    common = common_only(scores)
    np.testing.assert_allclose(absolute_errors(common["a"]), [1.0, 4.0])
    np.testing.assert_allclose(absolute_errors(common["b"]), [5.0, 8.0])
    np.testing.assert_allclose(relative_errors(common["b"]), [10.0, 16.0])
    for name in scores:
        before, after = (recording_row("r", "t", "own", part) for part in (scores[name], common[name]))
        assert after["n"] == 2
        assert {key: after[key] for key in ("recall", "precision", "false_positives", "matched")} == {
            key: before[key] for key in ("recall", "precision", "false_positives", "matched")
        }


def test_scores_of_different_recordings_have_nothing_in_common() -> None:
    with pytest.raises(DataError, match="different recordings"):
        common_only({"a": score_of([1.0]), "b": score_of([1.0, 2.0])})


def rows() -> list[dict[str, object]]:
    return [
        {"system": "a|b", "recording": "session1_left", **recording_row("session1_left", "t", "own", score_of([1.0]))},
        {"system": "c", "recording": "pooled", **recording_row("pooled", "t", "own", score_of([None]))},
    ]


def test_text_table_is_aligned_and_shows_what_is_not_known() -> None:
    lines = format_table(rows(), SPEED_COLUMNS).splitlines()
    assert lines[0].startswith("system  recording")
    assert len({len(line) for line in lines}) == 1
    assert lines[-1].split()[:5] == ["c", "pooled", "0", "-", "-"]


def test_markdown_table_has_as_many_cells_in_every_line() -> None:
    lines = format_table(rows(), SPEED_COLUMNS, TableFormat.MARKDOWN).splitlines()
    assert len({line.replace("\\|", "").count("|") for line in lines}) == 1
    assert set(lines[1]) == set("|-: ")


def test_csv_holds_every_key_and_digit() -> None:
    table = format_table(rows(), {}, TableFormat.CSV)
    first, second = csv.DictReader(io.StringIO(table))
    assert set(first) == set(rows()[0])
    assert float(first["mean"]) == rows()[0]["mean"]
    assert (second["mean"], second["recall"]) == ("", "0.0")


@pytest.mark.parametrize("style", list(TableFormat))
def test_no_rows_no_table(style: TableFormat) -> None:
    assert format_table([], SPEED_COLUMNS, style) == ""


@pytest.mark.parametrize("errors", [{}, {"none": np.empty(0)}, {"one": np.array([0.0]), "none": np.empty(0)}])
def test_plots_of_hardly_anything(tmp_path, errors) -> None:
    plot_cumulative_errors(errors, tmp_path / "plot.svg")
    assert (tmp_path / "plot.svg").read_text().count("<svg") == 1


def test_a_plot_that_cannot_be_written_is_one_line(tmp_path) -> None:
    with pytest.raises(OutputError, match="cannot write"):
        plot_cumulative_errors({"a": np.array([1.0])}, tmp_path / "missing" / "plot.png")


def test_scene_of_the_tests_sees_every_lane(scene: Traffic) -> None:
    for lane in range(3):
        scene.add_both(10.0 + lane, 20.0, lane)
    assert score_recording(scene.truth(), scene.tracks(), scene.camera).matched.all()
