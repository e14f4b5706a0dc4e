"""The public script's own numbers on the real recordings."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from detector.evaluation.results_folder import score_results
from detector.evaluation.summary import recording_row

REAL = os.environ.get("LABELGEN_REAL_DATA")

pytestmark = pytest.mark.skipif(REAL is None, reason="LABELGEN_REAL_DATA is not set: no real recordings")


def expected_rows() -> list[dict[str, object]]:
    if REAL is None:
        return []
    return json.loads((Path(REAL) / "expected" / "brnocompspeed_scores.json").read_text())["rows"]


def test_there_are_rows_to_reproduce() -> None:
    assert len(expected_rows()) >= 27


@pytest.mark.parametrize(
    "row", expected_rows(), ids=lambda row: "-".join(str(row[key]) for key in ("recording", "tracks", "calibration"))
)
def test_reproduces_the_public_script(row: dict[str, object]) -> None:
    folder = Path(REAL or "") / "brnocompspeed"
    (scored,) = score_results(
        folder / "dataset", folder / "results", [row["recording"]], [row["tracks"]], str(row["calibration"])
    )
    got = recording_row(scored.recording, scored.tracks, scored.calibration, scored.score)
    counts = {key: value for key, value in row.items() if not isinstance(value, float)}
    assert {key: got[key] for key in counts} == counts
    figures = {key: value for key, value in row.items() if isinstance(value, float)}
    assert {key: got[key] for key in figures} == pytest.approx(figures, rel=1e-6)
    assert set(got) == {*row, "precision"}
    assert got["precision"] == row["matched"] / (row["matched"] + row["false_positives"])
