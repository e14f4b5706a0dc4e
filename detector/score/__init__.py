"""The public evaluation protocols: BrnoCompSpeed and Luvizon."""

from detector.score.brnocompspeed import RecordingScore, score_recording
from detector.score.dataset import ScoredResult, score_results, select_recordings, split_c_test
from detector.score.groundtruth import GroundTruth, read_ground_truth
from detector.score.luvizon import LuvizonScore, fit_lane_scales, luvizon_row, score_luvizon
from detector.score.luvizon_data import LuvizonVideo, is_luvizon, read_luvizon_video, select_videos
from detector.score.summary import absolute_errors, common_only, pooled_row, recording_row, relative_errors
from detector.score.tables import CALIBRATION_COLUMNS, LUVIZON_COLUMNS, SPEED_COLUMNS, TableFormat, format_table
from detector.score.tracks import ResultFile, Tracks, read_results

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
