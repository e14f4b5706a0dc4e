"""How good detections are: average precision, c_c, the measured point on the ground."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labelgen.errors import LabelgenError
from labelgen.geometry import decode_boxes, front_bottom_midpoints
from labelgen.geometry.boxes import covered_share, iou_matrix
from labelgen.geometry.homography import Array
from labelgen.labels import MIN_IGNORED_SHARE, Flag, Labels, Sample

__all__ = ["average_precision", "evaluate_detections", "match_boxes"]


def average_precision(
    truth_xyxy: Sequence[Array],
    ignored: Sequence[NDArray[np.bool_]],
    detections: Sequence[Labels],
    ignored_xyxy: Sequence[Array] | None = None,
) -> dict[str, float]:
    """Compute AP over IoU 0.5 to 0.95, AP50 and AP75 as COCO does, over all box sizes.

    Args:
        truth_xyxy: boxes (L, 4) px per image.
        ignored: (L,) per image, labels that need not be detected and cost nothing when they are.
        detections: per image, with scores.
        ignored_xyxy: ignored boxes (K, 4) px per image; a detection without a label counts neither way where one of
            them covers `MIN_IGNORED_SHARE` of it. None for none.

    Returns:
        "ap", "ap50", "ap75" in [0, 1]; NaN without labels.

    Source: pycocotools; at most 300 detections per image.
    """
    from pycocotools.coco import COCO

    from detector.coco_scorer import RegionScorer

    annotations: list[dict[str, Any]] = []
    regions = [np.empty((0, 4))] * len(truth_xyxy) if ignored_xyxy is None else ignored_xyxy
    for image, (boxes, skip, around) in enumerate(zip(truth_xyxy, ignored, regions, strict=True)):
        marks = [*((crowd, False) for crowd in skip.tolist()), *((True, True) for _ in around)]
        for box, (crowd, region) in zip([*_xywh(boxes), *_xywh(around)], marks, strict=True):
            annotations.append(
                {
                    "id": len(annotations) + 1, "image_id": image, "category_id": 1, "bbox": box,
                    "area": box[2] * box[3], "iscrowd": int(crowd), RegionScorer.KEY: region,
                }
            )  # fmt: skip
    if not any(not annotation["iscrowd"] for annotation in annotations):
        return {"ap": float("nan"), "ap50": float("nan"), "ap75": float("nan")}
    results = [
        {"image_id": image, "category_id": 1, "bbox": box, "score": score}
        for image, labels in enumerate(detections)
        for box, score in zip(_xywh(labels.boxes_xyxy), labels.scores.tolist(), strict=True)
    ]
    if not results:
        return {"ap": 0.0, "ap50": 0.0, "ap75": 0.0}
    with contextlib.redirect_stdout(io.StringIO()):
        coco = COCO()
        coco.dataset = {
            "images": [{"id": i} for i in range(len(truth_xyxy))],
            "annotations": annotations,
            "categories": [{"id": 1, "name": "vehicle"}],
        }
        coco.createIndex()
        scorer = RegionScorer(coco, coco.loadRes(results), "bbox")
        scorer.params.maxDets = [1, 10, 300]
        scorer.evaluate()
        scorer.accumulate()
    # Axes: IoU threshold, recall, class, area, number of detections.
    precision = scorer.eval["precision"][:, :, 0, 0, -1]
    return {
        "ap": float(precision.mean()), "ap50": float(precision[0].mean()), "ap75": float(precision[5].mean())
    }  # fmt: skip


def _xywh(boxes_xyxy: Array) -> list[list[float]]:
    boxes: list[list[float]] = np.concatenate(
        [boxes_xyxy[:, :2], boxes_xyxy[:, 2:] - boxes_xyxy[:, :2]], axis=1
    ).tolist()
    return boxes


def match_boxes(
    truth_xyxy: Array, detections_xyxy: Array, scores: NDArray[np.floating], min_iou: float = 0.5
) -> NDArray[np.int64]:
    """Assign detections to labels: the highest score first, each label at most once.

    Args:
        truth_xyxy: (L, 4) px.
        detections_xyxy: (N, 4) px.
        scores: (N,).
        min_iou: lowest intersection over union of a pair.

    Returns:
        (N,) index of each detection's label, -1 for none.
    """
    overlap = iou_matrix(detections_xyxy, truth_xyxy)
    matches = np.full(len(detections_xyxy), -1, dtype=np.int64)
    for i in np.argsort(-scores, kind="stable").tolist():
        if overlap.shape[1] and (best := int(overlap[i].argmax())) >= 0 and overlap[i, best] >= min_iou:
            matches[i] = best
            overlap[:, best] = 0
    return matches


@dataclass
class _Tally:
    """What `evaluate_detections` collects, one entry per image.

    Args:
        truth_xyxy, truncated, detections: labels' boxes, which of them are truncated, and all detections.
        ignored_xyxy: ignored boxes.
        labels, strong, matched: numbers of labels, of detections above the score, and of matched ones among these.
        in_ignored: number of unmatched ones among these that lie in ignored boxes; they are not among the strong.
        valid: which detections above the score have a valid 3D box.
        cc, px, m: errors of matched pairs: c_c, ground point in frame px and in metres.
    """

    truth_xyxy: list[Array] = field(default_factory=list)
    truncated: list[NDArray[np.bool_]] = field(default_factory=list)
    detections: list[Labels] = field(default_factory=list)
    ignored_xyxy: list[Array] = field(default_factory=list)
    labels: int = 0
    strong: int = 0
    matched: int = 0
    in_ignored: int = 0
    valid: list[NDArray[np.bool_]] = field(default_factory=list)
    cc: list[Array] = field(default_factory=list)
    px: list[Array] = field(default_factory=list)
    m: list[Array] = field(default_factory=list)

    def add(self, sample: Sample, detections: Labels, score: float) -> None:
        """Count one image."""
        labels = sample.labels
        truncated, flat = labels.has(Flag.TRUNCATED), labels.has(Flag.FLAT)
        self.truth_xyxy.append(labels.boxes_xyxy)
        self.truncated.append(truncated)
        self.detections.append(detections)
        self.ignored_xyxy.append(sample.ignored.boxes_xyxy)
        strong = detections[detections.scores >= np.float64(score)]
        matches = match_boxes(labels.boxes_xyxy, strong.boxes_xyxy, strong.scores)
        share = covered_share(strong.boxes_xyxy, sample.ignored.boxes_xyxy).max(axis=1, initial=0)
        counts = (matches >= 0) | (share < MIN_IGNORED_SHARE)
        self.in_ignored += int(np.count_nonzero(~counts))
        strong, matches = strong[counts], matches[counts]
        self.labels += len(labels)
        self.strong += len(strong)
        self.matched += int(np.count_nonzero(matches >= 0))
        if not flat.any():
            self.valid.append(decode_boxes(strong.boxes_xyxy, strong.cc, sample.rectification.vpu)[1])
        compared = matches >= 0
        compared[compared] = ~(truncated | flat)[matches[compared]]
        truth, strong = labels[matches[compared]], strong[compared]
        px, metres = _ground_errors(sample, truth, strong)
        self.cc.append(np.abs(truth.cc - strong.cc))
        self.px.append(px)
        self.m.append(metres)


def _ground_errors(sample: Sample, truth: Labels, detections: Labels) -> tuple[Array, Array]:
    """Errors (N,) of the measured points of matched pairs in frame px and in metres; NaN where there is no point."""
    vpu = sample.rectification.vpu
    truth_vertices, truth_valid = decode_boxes(truth.boxes_xyxy, truth.cc, vpu)
    vertices, valid = decode_boxes(detections.boxes_xyxy, detections.cc, vpu)
    both = truth_valid & valid
    a, b = (sample.rectification.points_back(front_bottom_midpoints(v[both])) for v in (truth_vertices, vertices))
    px, metres = np.full(len(truth), np.nan), np.full(len(truth), np.nan)
    px[both] = np.linalg.norm(a - b, axis=1)
    if sample.camera.scale is not None:
        road = [sample.camera.road_points(points, invalid="nan") for points in (a, b)]
        metres[both] = np.linalg.norm(road[0] - road[1], axis=1)
    return px, metres


def evaluate_detections(
    pairs: Iterable[tuple[Sample, Labels]], *, score: float = 0.5, min_height_px: float = 0.0
) -> dict[str, Any]:
    """Compare detections with labels.

    Average precision counts all detections. The other figures count those of at least `score` that match a label with
    IoU 0.5. Errors of c_c and of the ground point are those of labels that are not truncated and lie in rectified
    pictures. Detections that match no label and lie in an ignored box count nowhere.

    Args:
        pairs: samples with the detections in their image.
        score: lowest score for all but average precision.
        min_height_px: labels lower than this were never made, so lower detections are left out.

    Returns:
        plain values: counts ("detections_ignored" are those in ignored boxes), "ap", "ap50", "ap75" and the same
        without truncated labels ("_whole"), "recall", "precision", "invalid_share" (detections without a valid 3D
        box), and "cc_error", "ground_px", "ground_m",
        each with "n", "median", "mean", "p95". None where there is nothing to measure.

    Raises:
        LabelgenError: there are no samples.
    """
    tally = _Tally()
    for sample, labels in pairs:
        heights = labels.boxes_xyxy[:, 3] - labels.boxes_xyxy[:, 1]
        tally.add(sample, labels[heights >= min_height_px], score)
    if not tally.truth_xyxy:
        raise LabelgenError("no samples to evaluate")
    whole = average_precision(tally.truth_xyxy, tally.truncated, tally.detections, tally.ignored_xyxy)
    nothing_ignored = [np.zeros_like(t) for t in tally.truncated]
    return {
        "images": len(tally.truth_xyxy),
        "labels": tally.labels,
        "truncated_labels": int(sum(np.count_nonzero(t) for t in tally.truncated)),
        "ignored_boxes": sum(map(len, tally.ignored_xyxy)),
        **average_precision(tally.truth_xyxy, nothing_ignored, tally.detections, tally.ignored_xyxy),
        **{f"{key}_whole": value for key, value in whole.items()},
        "score": score,
        "min_height_px": min_height_px,
        "detections": tally.strong,
        "detections_ignored": tally.in_ignored,
        "recall": _ratio(tally.matched, tally.labels),
        "precision": _ratio(tally.matched, tally.strong),
        "invalid_share": _ratio(sum(int(np.count_nonzero(~v)) for v in tally.valid), sum(map(len, tally.valid))),
        "cc_error": _spread(tally.cc),
        "ground_px": _spread(tally.px),
        "ground_m": _spread(tally.m),
    }


def _ratio(part: float, whole: float) -> float | None:
    return float(part / whole) if whole else None


def _spread(parts: Sequence[Array]) -> dict[str, float | int | None]:
    values = np.concatenate(parts) if parts else np.empty(0)
    values = values[np.isfinite(values)]
    names = ("median", "mean", "p95")
    if not len(values):
        return {"n": 0, **dict.fromkeys(names)}
    return {
        "n": len(values), "median": float(np.median(values)), "mean": float(values.mean()),
        "p95": float(np.quantile(values, 0.95)),
    }  # fmt: skip
