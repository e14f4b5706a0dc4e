"""The public evaluation protocols: BrnoCompSpeed and Luvizon."""

from detector.evaluation.brnocompspeed import RecordingScore, score_recording
from detector.evaluation.luvizon import LuvizonScore, fit_lane_scales, luvizon_row, score_luvizon
from detector.evaluation.results_folder import ScoredResult, score_results, select_recordings, split_c_test
from detector.evaluation.summary import absolute_errors, common_only, pooled_row, recording_row, relative_errors
from detector.evaluation.tables import CALIBRATION_COLUMNS, LUVIZON_COLUMNS, SPEED_COLUMNS, TableFormat, format_table
from detector.tracking.tracks import ResultFile, Tracks, read_results
from labelgen.datasets.brnocompspeed import GroundTruth, read_ground_truth
from labelgen.datasets.luvizon import LuvizonVideo, is_luvizon, read_luvizon_video, select_videos

__all__ = [
    "CALIBRATION_COLUMNS",
    "LUVIZON_COLUMNS",
    "SPEED_COLUMNS",
    "GroundTruth",
    "LuvizonScore",
    "LuvizonVideo",
    "RecordingScore",
    "ResultFile",
    "ScoredResult",
    "TableFormat",
    "Tracks",
    "absolute_errors",
    "common_only",
    "fit_lane_scales",
    "format_table",
    "is_luvizon",
    "luvizon_row",
    "pooled_row",
    "read_ground_truth",
    "read_luvizon_video",
    "read_results",
    "recording_row",
    "relative_errors",
    "score_luvizon",
    "score_recording",
    "score_results",
    "select_recordings",
    "select_videos",
    "split_c_test",
]
