"""The public evaluation protocols: BrnoCompSpeed and Luvizon."""

from detector.score.brnocompspeed import RecordingScore, score_recording
from detector.score.dataset import ScoredResult, missing_recordings, score_results, select_recordings
from detector.score.groundtruth import GroundTruth, read_ground_truth
from detector.score.summary import absolute_errors, common_only, pooled_row, recording_row, relative_errors
from detector.score.tables import TableFormat, format_table
from detector.score.tracks import ResultFile, Tracks, read_results

__all__ = [
    "GroundTruth",
    "RecordingScore",
    "ResultFile",
    "ScoredResult",
    "TableFormat",
    "Tracks",
    "absolute_errors",
    "common_only",
    "format_table",
    "missing_recordings",
    "pooled_row",
    "read_ground_truth",
    "read_results",
    "recording_row",
    "relative_errors",
    "score_recording",
    "score_results",
    "select_recordings",
]
