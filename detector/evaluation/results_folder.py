"""Recordings and result files in the folders of BrnoCompSpeed, and their scores.

Layout: DATASET/sessionN_{left,center,right}/gt_data.pkl and RESULTS/sessionN_.../system_NAME.json.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from detector.evaluation.brnocompspeed import RecordingScore, score_recording
from detector.tracking.tracks import read_results
from labelgen.datasets.brnocompspeed import read_ground_truth
from labelgen.datasets.manifest import load_manifest
from labelgen.errors import DataError
from labelgen.geometry import Camera

__all__ = [
    "OWN_CALIBRATION",
    "ScoredResult",
    "result_file_name",
    "score_results",
    "select_recordings",
    "split_c_test",
]

OWN_CALIBRATION = "own"
"""Calibration of the result file itself, in place of the name of a system."""

_SIDES = ("left", "center", "right")
_GROUND_TRUTH = "gt_data.pkl"


@dataclass(frozen=True, eq=False)
class ScoredResult:
    """Score of one result file.

    Args:
        recording, system: names.
        tracks: name of the result file.
        calibration: name of the file whose calibration was used; `OWN_CALIBRATION` for that of the result file.
        score: of its tracks.
    """

    recording: str
    system: str
    tracks: str
    calibration: str
    score: RecordingScore


def result_file_name(system: str) -> str:
    """Return system_NAME.json for NAME, or for the name of the file itself."""
    name = system.removesuffix(".json").removeprefix("system_")
    return f"system_{name}.json"


def _recordings(dataset: Path) -> list[str]:
    """Return the names of all recordings in natural order: by session, then left, center, right."""
    if not dataset.is_dir():
        raise DataError(
            f"data set {dataset}: no such folder; give the one with sessionN_left and so on", parameter="dataset"
        )
    names = sorted(path.parent.name for path in dataset.glob(f"*/{_GROUND_TRUTH}"))
    if not names:
        inner = dataset / "dataset"
        hint = f"; did you mean {inner}?" if any(inner.glob(f"*/{_GROUND_TRUTH}")) else ""
        raise DataError(f"data set {dataset}: no folder with a {_GROUND_TRUTH} in it{hint}", parameter="dataset")
    return sorted(names, key=_natural)


def _natural(name: str) -> tuple[int, int, str]:
    match = re.fullmatch(r"session(\d+)_(left|center|right)", name)
    return (int(match[1]), _SIDES.index(match[2]), name) if match else (10**6, 0, name)


def select_recordings(dataset: str | Path, recordings: str) -> list[str]:
    """Return the names of the recordings to score.

    Args:
        dataset: folder with one folder per recording.
        recordings: "all", "split-C" (those test recordings of the split that are there), or names with commas between.

    Raises:
        DataError: no such folder, unknown recording, or nothing left to score.
    """
    dataset = Path(dataset)
    present = _recordings(dataset)
    if recordings == "all":
        return present
    if recordings.lower() == "split-c":
        test = split_c_test()
        selected = [name for name in present if name in test]
        if not selected:
            raise DataError(
                f"data set {dataset}: none of split C's test recordings in it; try all", parameter="recordings"
            )
        return selected
    selected = [name.strip() for name in recordings.split(",") if name.strip()]
    unknown = [name for name in selected if name not in present]
    if unknown or not selected:
        raise DataError(
            f"data set {dataset}: no recording {', '.join(unknown) or repr(recordings)} with a {_GROUND_TRUTH}; "
            f"there are {', '.join(present)}",
            parameter="recordings",
        )
    return list(dict.fromkeys(selected))


def split_c_test() -> list[str]:
    """Return the names of the nine test recordings of the published split C."""
    sessions = load_manifest("brnocompspeed")["splits"]["C"]["test"]
    return [f"{session}_{side}" for session in sessions for side in _SIDES]


def _check_files(results: Path, recordings: Sequence[str], names: Sequence[str]) -> None:
    """Look for all result files before the first one is scored."""
    if not results.is_dir():
        raise DataError(
            f"results {results}: no such folder; give the one with sessionN_left and so on", parameter="results"
        )
    missing = [results / recording / name for recording in recordings for name in names]
    missing = [path for path in missing if not path.is_file()]
    if missing:
        whole = [r for r in recordings if all((results / r / name).is_file() for name in names)]
        advice = f"all are there for the recordings {','.join(whole)}" if whole else "check the names of the systems"
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise DataError(f"results {missing[0]}: no such file{more}; {advice}", parameter=("results", "system"))


def score_results(
    dataset: str | Path,
    results: str | Path,
    recordings: Sequence[str],
    systems: Sequence[str],
    calibration: str = OWN_CALIBRATION,
) -> Iterator[ScoredResult]:
    """Score systems on recordings, one after the other; a recording's systems follow each other.

    Args:
        dataset: folder of the recordings.
        results: folder of the result files.
        recordings: names, as `select_recordings` returns them.
        systems: names of the systems.
        calibration: name of the system whose calibration measures all tracks; "own" measures the tracks of each file
            with the calibration in it.

    Raises:
        DataError: a file is missing or not of its format.
        CalibrationError: a calibration is missing or describes no camera.
    """
    results = Path(results)
    names = [result_file_name(system) for system in systems]
    own = calibration == OWN_CALIBRATION
    other = OWN_CALIBRATION if own else result_file_name(calibration)
    _check_files(results, recordings, names if own else [*names, other])
    for recording in recordings:
        truth = read_ground_truth(Path(dataset) / recording / _GROUND_TRUTH)
        camera = None if own else Camera.load(results / recording / other)
        for system, name in zip(systems, names, strict=True):
            result = read_results(results / recording / name)
            yield ScoredResult(
                recording, system, name, other, score_recording(truth, result.tracks, camera or result.camera())
            )
