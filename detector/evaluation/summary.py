"""Scores of recordings as rows of figures: per recording, pooled, and restricted to common vehicles.

Published figures are pooled over all test vehicles, not averaged over recordings. `pooled_row` follows them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from detector.evaluation.brnocompspeed import RecordingScore
from labelgen.errors import DataError
from labelgen.geometry.homography import Array

__all__ = ["Value", "absolute_errors", "common_only", "pooled_row", "recording_row", "relative_errors"]

Value = str | int | float | None
"""One figure of a row; None where it is not known."""


def absolute_errors(score: RecordingScore) -> Array:
    """Return (n,) |measured - true| in km/h, of the cars whose speed error counts."""
    return np.abs(score.speeds_kmh - score.truth_kmh)[score.counted]


def relative_errors(score: RecordingScore) -> Array:
    """Return (n,) |measured - true| in percent of the true speed, of the cars whose speed error counts."""
    return absolute_errors(score) / score.truth_kmh[score.counted] * 100


def common_only(scores: Mapping[str, RecordingScore]) -> dict[str, RecordingScore]:
    """Restrict the speed errors of several systems on one recording to the cars that all systems matched.

    Recall, precision and the errors of the calibration are not changed.

    Args:
        scores: by system, of the same recording.

    Raises:
        DataError: the scores belong to different ground truths.
    """
    parts = list(scores.values())
    if len({len(part.matched) for part in parts}) > 1:
        raise DataError("scores of different recordings cannot be restricted to common vehicles")
    common = np.logical_and.reduce([part.matched for part in parts])
    return {name: replace(part, counted=part.counted & common) for name, part in scores.items()}


def _figures(scores: Sequence[RecordingScore]) -> dict[str, Value]:
    """Return the figures that recording rows and pooled rows share; None where there is nothing to average."""
    absolute = np.concatenate([absolute_errors(score) for score in scores])
    relative = np.concatenate([relative_errors(score) for score in scores])
    matched = sum(int(np.count_nonzero(score.matched)) for score in scores)
    false_positives = sum(score.false_positives for score in scores)
    figures: dict[str, float] = {
        "mean": _mean(absolute),
        "median": _percentile(absolute, 50),
        "p95": _percentile(absolute, 95),
        "worst": _percentile(absolute, 100),
        "mean_relative": _mean(relative),
        "median_relative": _percentile(relative, 50),
        "p95_relative": _percentile(relative, 95),
        "recall": _recall(scores),
        "precision": _ratio(matched, matched + false_positives),
    }
    calibration = {
        "calibration_ratio_error_relative_mean": _mean(np.concatenate([s.ratio_errors_relative for s in scores])),
        "calibration_ratio_error_absolute_mean": _mean(np.concatenate([s.ratio_errors for s in scores])),
        "distance_error_m_mean": _mean(np.concatenate([s.distance_errors_m for s in scores])),
        "distance_error_relative_mean": _mean(np.concatenate([s.distance_errors_relative for s in scores])),
    }
    counts: dict[str, Value] = {
        "false_positives": false_positives,
        "matched": matched,
        "intersection_failures": sum(score.intersection_failures for score in scores),
    }
    return (
        {"n": len(absolute)}
        | {key: _known(value) for key, value in figures.items()}
        | counts
        | {key: _known(value) for key, value in calibration.items()}
    )


def recording_row(recording: str, tracks: str, calibration: str, score: RecordingScore) -> dict[str, Value]:
    """Return the figures of one recording.

    Args:
        recording: its name.
        tracks: name of the result file.
        calibration: "own", or name of the file whose calibration was used.
        score: of the recording.

    Returns:
        `recording`, `tracks`, `calibration`. `n`: number of cars whose speed error counts. Their errors: `mean`,
        `median`, `p95`, `worst` in km/h; `mean_relative`, `median_relative`, `p95_relative` in percent. `recall`:
        matched valid cars of all valid cars. `precision`: matched / (matched + false_positives), which the public
        script does not have. `false_positives`, `matched`, `intersection_failures`. Errors of the calibration:
        `calibration_ratio_error_relative_mean` in percent, `calibration_ratio_error_absolute_mean`,
        `distance_error_m_mean`, `distance_error_relative_mean` in percent.
    """
    return {"recording": recording, "tracks": tracks, "calibration": calibration} | _figures([score])


def pooled_row(scores: Sequence[RecordingScore]) -> dict[str, Value]:
    """Return the figures of `recording_row` over all vehicles and surveyed segments of several recordings.

    `recall_recording_mean`, the mean of the recalls of the recordings, is what the public script prints.
    """
    recalls = np.array([_recall([score]) for score in scores])
    known = recalls[np.isfinite(recalls)]
    return {"recordings": len(scores)} | _figures(scores) | {"recall_recording_mean": _known(_mean(known))}


def _mean(values: Array) -> float:
    return float(values.mean()) if len(values) else math.nan


def _percentile(values: Array, percent: float) -> float:
    return float(np.percentile(values, percent)) if len(values) else math.nan


def _recall(scores: Sequence[RecordingScore]) -> float:
    matched = sum(int(np.count_nonzero(score.matched & score.valid)) for score in scores)
    return _ratio(matched, sum(int(np.count_nonzero(score.valid)) for score in scores))


def _ratio(part: int, whole: int) -> float:
    return part / whole if whole else math.nan


def _known(value: float) -> float | None:
    """Return None for NaN and infinity, which JSON does not have."""
    return value if math.isfinite(value) else None
