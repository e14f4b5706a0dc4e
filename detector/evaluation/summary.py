"""Scores of recordings as rows, pooled over vehicles, and restricted to vehicles that all systems found.

Published figures are pooled over all test vehicles, not averaged over recordings; so is `pooled_row`.
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


def absolute_errors(score: RecordingScore) -> Array:
    """(n,) |measured - true| in km/h of the cars that count."""
    return np.abs(score.speeds_kmh - score.truth_kmh)[score.counted]


def relative_errors(score: RecordingScore) -> Array:
    """(n,) the same in percent of the true speed."""
    return absolute_errors(score) / score.truth_kmh[score.counted] * 100


def common_only(scores: Mapping[str, RecordingScore]) -> dict[str, RecordingScore]:
    """One recording's scores of several systems, with the speed errors of only the cars that all of them found.

    Recall, precision and the calibration's errors stay each system's own.

    Raises:
        DataError: the scores belong to different ground truths.
    """
    parts = list(scores.values())
    if len({len(part.matched) for part in parts}) > 1:
        raise DataError("scores of different recordings cannot be restricted to common vehicles")
    found = np.logical_and.reduce([part.matched for part in parts])
    return {name: replace(part, counted=part.counted & found) for name, part in scores.items()}


def _figures(scores: Sequence[RecordingScore]) -> dict[str, Value]:
    """What rows and pooled results have in common; None where there is nothing to average."""
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
    """One recording's figures.

    Returns:
        recording, tracks (file), calibration ("own" or file); n, the cars whose speed counts; their errors mean,
        median, p95, worst in km/h and mean_relative, median_relative, p95_relative in percent; recall, matched valid
        of valid cars; precision, matched / (matched + false_positives), which the public script does not have;
        false_positives, matched, intersection_failures; calibration_ratio_error_relative_mean in percent,
        calibration_ratio_error_absolute_mean, distance_error_m_mean, distance_error_relative_mean in percent.
    """
    return {"recording": recording, "tracks": tracks, "calibration": calibration} | _figures([score])


def pooled_row(scores: Sequence[RecordingScore]) -> dict[str, Value]:
    """The same figures over all vehicles and segments of several recordings.

    `recall_recording_mean` beside them is the public script's: the mean of the recordings' recalls.
    """
    recalls = np.array([_recall([score]) for score in scores])
    known = recalls[np.isfinite(recalls)]
    return {"recordings": len(scores)} | _figures(scores) | {"recall_recording_mean": _known(_mean(known))}


def _mean(values: Array) -> float:
    return float(values.mean()) if len(values) else math.nan


def _percentile(values: Array, percent: float) -> float:
    return float(np.percentile(values, percent)) if len(values) else math.nan


def _recall(scores: Sequence[RecordingScore]) -> float:
    found = sum(int(np.count_nonzero(score.matched & score.valid)) for score in scores)
    return _ratio(found, sum(int(np.count_nonzero(score.valid)) for score in scores))


def _ratio(part: int, whole: int) -> float:
    return part / whole if whole else math.nan


def _known(value: float) -> float | None:
    """JSON has no NaN and no infinity; what cannot be said is null."""
    return value if math.isfinite(value) else None
