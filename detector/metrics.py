"""How good detections are: average precision, c_c, the measured point on the ground."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labelgen.errors import LabelgenError
from labelgen.geometry import decode_boxes, front_bottom_midpoints
from labelgen.geometry.homography import Array
from labelgen.labels import Flag, Labels, Sample

__all__ = ["Found", "average_precision", "evaluate", "match_boxes"]

_MATCH_IOU = 0.5


@dataclass(frozen=True, eq=False)
class Found:
    """Detections in one rectified image.

    Args:
        boxes_xyxy: (N, 4) px.
        cc: (N,) in [0, 1].
        scores: (N,) in [0, 1].
    """

    boxes_xyxy: Array
    cc: Array
    scores: Array

    def __len__(self) -> int:
        return len(self.scores)

    def __getitem__(self, index: Any) -> Found:
        """Some of the detections."""
        return Found(self.boxes_xyxy[index], self.cc[index], self.scores[index])


def average_precision(
    truth: Sequence[Array], ignored: Sequence[NDArray[np.bool_]], found: Sequence[Found]
) -> dict[str, float]:
    """AP over IoU 0.5 to 0.95, AP50, AP75, as COCO counts them.

    Args:
        truth: boxes (L, 4) per image.
        ignored: (L,) per image, labels that need not be found and cost nothing when they are.
        found: detections per image.

    Returns:
        "ap", "ap50", "ap75" in [0, 1]; NaN without labels.
    """
    from pycocotools.coco import COCO
    from pycocotools.cocoeval import COCOeval

    annotations: list[dict[str, Any]] = []
    for image, (boxes, skip) in enumerate(zip(truth, ignored, strict=True)):
        for box, crowd in zip(_xywh(boxes), skip.tolist(), strict=True):
            annotations.append(
                {
                    "id": len(annotations) + 1, "image_id": image, "category_id": 1, "bbox": box,
                    "area": box[2] * box[3], "iscrowd": int(crowd),
                }
            )  # fmt: skip
    if not any(not annotation["iscrowd"] for annotation in annotations):
        return {"ap": float("nan"), "ap50": float("nan"), "ap75": float("nan")}
    results = [
        {"image_id": image, "category_id": 1, "bbox": box, "score": score}
        for image, detections in enumerate(found)
        for box, score in zip(_xywh(detections.boxes_xyxy), detections.scores.tolist(), strict=True)
    ]
    if not results:
        return {"ap": 0.0, "ap50": 0.0, "ap75": 0.0}
    with contextlib.redirect_stdout(io.StringIO()):
        coco = COCO()
        coco.dataset = {
            "images": [{"id": i} for i in range(len(truth))],
            "annotations": annotations,
            "categories": [{"id": 1, "name": "vehicle"}],
        }
        coco.createIndex()
        scorer = COCOeval(coco, coco.loadRes(results), "bbox")
        scorer.params.maxDets = [1, 10, 300]
        scorer.evaluate()
        scorer.accumulate()
    # Axes: IoU threshold, recall, class, area, number of detections.
    precision = scorer.eval["precision"][:, :, 0, 0, -1]
    return {
        "ap": float(precision.mean()), "ap50": float(precision[0].mean()), "ap75": float(precision[5].mean())
    }  # fmt: skip


def _xywh(boxes: Array) -> list[list[float]]:
    return np.concatenate([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]], axis=1).tolist()  # type: ignore[no-any-return]


def match_boxes(truth_xyxy: Array, found_xyxy: Array, scores: Array, min_iou: float = _MATCH_IOU) -> NDArray[np.int64]:
    """(N,) which label (of L) each detection finds, -1 for none: best score first, each label once."""
    from labelgen.geometry.boxes import iou_matrix

    overlap = iou_matrix(found_xyxy, truth_xyxy)
    out = np.full(len(found_xyxy), -1, dtype=np.int64)
    for i in np.argsort(-scores, kind="stable").tolist():
        if overlap.shape[1] and (best := int(overlap[i].argmax())) >= 0 and overlap[i, best] >= min_iou:
            out[i] = best
            overlap[:, best] = 0
    return out


def _ground_errors(sample: Sample, labels: Labels, found: Found) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Errors of the measured points of matched pairs: frame px (N,), metres (N,), and validity of the detections."""
    vpu = sample.rectification.vpu
    truth, truth_valid = decode_boxes(labels.boxes_xyxy, labels.cc, vpu)
    seen, valid = decode_boxes(found.boxes_xyxy, found.cc, vpu)
    both = truth_valid & valid
    a, b = (sample.rectification.points_back(front_bottom_midpoints(v[both])) for v in (truth, seen))
    px, metres = np.full(len(labels), np.nan), np.full(len(labels), np.nan)
    px[both] = np.linalg.norm(a - b, axis=1)
    if sample.camera.scale is not None:
        road = [sample.camera.road_points(points, invalid="nan") for points in (a, b)]
        metres[both] = np.linalg.norm(road[0] - road[1], axis=1)
    return px, metres, valid


def evaluate(
    pairs: Iterable[tuple[Sample, Found]], *, score: float = 0.5, min_height_px: float = 0.0
) -> dict[str, Any]:
    """Judge detections against labels.

    Average precision counts all detections; the other figures those of at least `score` that find a label (IoU 0.5).
    Errors of c_c and of the ground point are taken over labels that are not truncated and lie in rectified pictures.

    Args:
        pairs: samples with their detections.
        score: least score for all but average precision.
        min_height_px: labels lower than this were never made, so detections lower than it are left out.

    Raises:
        LabelgenError: there are no samples.
    """
    truth, truncated, kept = [], [], []
    cc, px, metres, valid, counts = [], [], [], [], np.zeros(3, dtype=np.int64)
    for sample, everything in pairs:
        labels = sample.labels
        found = everything[everything.boxes_xyxy[:, 3] - everything.boxes_xyxy[:, 1] >= min_height_px]
        cut = labels.has(Flag.TRUNCATED)
        truth.append(labels.boxes_xyxy)
        truncated.append(cut)
        kept.append(found)
        strong = found[found.scores >= score]
        which = match_boxes(labels.boxes_xyxy, strong.boxes_xyxy, strong.scores)
        counts += np.array([len(labels), len(strong), np.count_nonzero(which >= 0)])
        flat = labels.has(Flag.FLAT)
        if not flat.any():
            valid.append(decode_boxes(strong.boxes_xyxy, strong.cc, sample.rectification.vpu)[1])
        right = which >= 0
        right[right] = ~(cut | flat)[which[right]]
        matched, strong = labels[which[right]], strong[right]
        cc.append(np.abs(matched.cc - strong.cc))
        a, b, _ = _ground_errors(sample, matched, strong)
        px.append(a)
        metres.append(b)
    if not truth:
        raise LabelgenError("no samples to evaluate")
    whole = average_precision(truth, truncated, kept)
    return {
        "images": len(truth),
        "labels": int(counts[0]),
        "truncated_labels": int(sum(np.count_nonzero(t) for t in truncated)),
        **average_precision(truth, [np.zeros_like(t) for t in truncated], kept),
        **{f"{key}_whole": value for key, value in whole.items()},
        "score": score,
        "min_height_px": min_height_px,
        "detections": int(counts[1]),
        "recall": _ratio(counts[2], counts[0]),
        "precision": _ratio(counts[2], counts[1]),
        "invalid_share": _ratio(sum(int(np.count_nonzero(~v)) for v in valid), sum(map(len, valid))),
        "cc_error": _spread(cc),
        "ground_px": _spread(px),
        "ground_m": _spread(metres),
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
