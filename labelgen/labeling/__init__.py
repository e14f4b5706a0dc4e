"""Labels of a frame or a crop from 3D boxes or instance masks; pure functions of arrays."""

from labelgen.labeling.fitted.label import SeenFrame, label_passages
from labelgen.labeling.from_boxes import BoxLimits, label_boxes
from labelgen.labeling.from_masks import FrameLabels, LabelLimits, MaskReject, flat_labels, label_masks

__all__ = [
    "BoxLimits",
    "FrameLabels",
    "LabelLimits",
    "MaskReject",
    "SeenFrame",
    "flat_labels",
    "label_boxes",
    "label_masks",
    "label_passages",
]
