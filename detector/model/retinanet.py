"""torchvision's RetinaNet with a second regression output: c_c, one value per anchor.

The loss of a batch with N positive anchors (at least 1) is

    L = (L_conf + L_loc + w L_c + w L_s) / N

L_conf is the focal loss (alpha 0.25, gamma 2) over all positive and negative anchors. L_loc and L_c are the smooth L1
losses (published: beta 1/9) of the box and of c_c over the positive anchors. L_s is the same for the vehicle's height
and length, in models that predict them; the published ones do not. A label whose c_c is not known (`cc_known` False)
is left out of L_c and L_s. An anchor that is not positive, and half of which one of the `ignored` boxes covers, is left
out of L_conf: a vehicle without a label is there. COCO counts detections in crowds by the same share of their area.

Convention: images are (3, H, W) RGB in [0, 1], boxes x0, y0, x1, y1 in their px; images are never resized. Anchors,
boxes, scores and values are float32 in any precision of the network: bfloat16 resolves only every other px beyond 256.

Source: Lin et al. 2017 (RetinaNet); Kocur & Ftacnik 2020, section 3.4 (c_c and the loss).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812
from torchvision.models.detection import RetinaNet
from torchvision.models.detection._utils import Matcher
from torchvision.models.detection.retinanet import RetinaNetHead, RetinaNetRegressionHead
from torchvision.ops import batched_nms, sigmoid_focal_loss

from detector.model.backbone import NORMS, build_backbone
from detector.model.torchvision_overrides import CachedAnchorGenerator, IdentityTransform
from detector.model.vehicle_size import sizes_from_cc
from labelgen.labels import MIN_IGNORED_SHARE

__all__ = ["CcHead", "CcRetinaNet", "ModelConfig", "build_model"]


@dataclass(frozen=True)
class ModelConfig:
    """Shape and loss of a model, as plain numbers and text. Field names are part of the checkpoint format.

    Args:
        backbone: name of the torchvision network.
        levels: pyramid levels; level k has stride 2^k px.
        channels: number of channels of the pyramid and the heads.
        head_convs: number of convolutions in each head's tower, 1 to 4.
        head_norm: normalisation in the towers: a key of `detector.model.backbone.NORMS`.
        trunk_norm: normalisation in the trunk, "batch" or "frozen".
        anchor_sizes: per level, sides px of square anchors.
        anchor_ratios: heights over widths of the anchors, the same on every level.
        cc_weight: weight w of the c_c term; 0 for the 2D variants.
        beta: error at which the smooth L1 terms turn from quadratic to linear: in box deltas, c_c, logarithms of sizes.
        size_weight: weight in [0, 1] of the c_c that follows from the predicted sizes, see
            `detector.model.vehicle_size`; 0 for a model that predicts no sizes.
        low_quality_matches: whether a label without an anchor of IoU 0.5 is assigned its best one, as in torchvision;
            the paper does not do so.
    """

    backbone: str = "resnet50"
    levels: tuple[int, ...] = (3, 4, 5, 6, 7)
    channels: int = 256
    head_convs: int = 4
    head_norm: str = "none"
    trunk_norm: str = "batch"
    anchor_sizes: tuple[tuple[float, ...], ...] = tuple(
        tuple(float(int(side * 2 ** (k / 3))) for k in range(3)) for side in (32, 64, 128, 256, 512)
    )
    anchor_ratios: tuple[float, ...] = (0.5, 1.0, 2.0)
    cc_weight: float = 1.0
    beta: float = 1 / 9
    size_weight: float = 0.0
    low_quality_matches: bool = False


class _CcRegressionHead(RetinaNetRegressionHead):  # type: ignore[misc]
    """torchvision's box head with one more convolution on the same tower: for c_c and the vehicle's sizes."""

    def __init__(self, in_channels: int, num_anchors: int, norm_layer: Any, with_sizes: bool) -> None:
        super().__init__(in_channels, num_anchors, norm_layer=norm_layer)
        self.values = 3 if with_sizes else 1
        self.cc = nn.Conv2d(in_channels, num_anchors * self.values, kernel_size=3, padding=1)
        nn.init.normal_(self.cc.weight, std=0.01)
        # c_c is in [0, 1], the logarithms of sizes over typical ones are around 0: start in the middle.
        assert self.cc.bias is not None
        with torch.no_grad():
            self.cc.bias.view(num_anchors, self.values).copy_(torch.tensor([0.5, 0.0, 0.0][: self.values]))

    def forward(self, x: list[Tensor]) -> Any:
        """Map features per level to boxes (N, A, 4) and values (N, A, 1 or 3), in torchvision's order of anchors."""
        # One convolution for both: a separate one with c_c's few channels would cost as much as one with sixteen.
        assert self.cc.bias is not None
        weight = torch.cat([self.bbox_reg.weight, self.cc.weight])
        bias = torch.cat([self.bbox_reg.bias, self.cc.bias])
        boxes: list[Tensor] = []
        values: list[Tensor] = []
        for features in x:
            raw = F.conv2d(self.conv(features), weight, bias, padding=1)
            n, _, h, w = raw.shape
            for out, part, width in (
                (boxes, raw[:, : -self.cc.out_channels], 4),
                (values, raw[:, -self.cc.out_channels :], self.values),
            ):
                out.append(part.reshape(n, -1, width, h, w).permute(0, 3, 4, 1, 2).reshape(n, -1, width))
        return torch.cat(boxes, dim=1), torch.cat(values, dim=1)


class CcHead(RetinaNetHead):  # type: ignore[misc]
    """torchvision's RetinaNet head of one class, with outputs for c_c and sizes, and towers of any length.

    Args:
        in_channels: channels of the features.
        num_anchors: anchors per cell.
        norm_layer: makes a normalisation for a number of channels; None for none.
        convs: number of convolutions in each tower, 1 to 4.
        cc_weight: weight of the terms of c_c and sizes.
        beta: of the smooth L1 terms, see `ModelConfig`.
        with_sizes: whether there is an output for the vehicle's height and length.
    """

    def __init__(
        self, in_channels: int, num_anchors: int, norm_layer: Any = None, *,
        convs: int = 4, cc_weight: float = 1.0, beta: float = 1 / 9, with_sizes: bool = False,
    ) -> None:  # fmt: skip
        super().__init__(in_channels, num_anchors, num_classes=1, norm_layer=norm_layer)
        self.regression_head = _CcRegressionHead(in_channels, num_anchors, norm_layer, with_sizes)
        for head in (self.classification_head, self.regression_head):
            head.conv = head.conv[:convs]
        self.cc_weight, self.beta = cc_weight, beta

    def forward(self, x: list[Tensor]) -> dict[str, Tensor]:
        """Compute the outputs of all A anchors from features (N, C, h, w) per level.

        Returns:
            `cls_logits` (N, A, 1), `bbox_regression` (N, A, 4), `cc` (N, A) and, with sizes, `sizes` (N, A, 2).
        """
        boxes, values = self.regression_head(x)
        sizes = {"sizes": values[..., 1:]} if self.regression_head.values > 1 else {}
        return {"cls_logits": self.classification_head(x), "bbox_regression": boxes, "cc": values[..., 0], **sizes}

    def compute_loss(self, targets: Any, head_outputs: Any, anchors: Any, matched_idxs: Any) -> dict[str, Tensor]:
        """Compute the terms of the loss, each divided by the batch's number of positive anchors.

        Args:
            targets: per image `boxes` (L, 4) px, `cc` (L,), `cc_known` (L,) bool; for sizes `scene` (4,) as well;
                `ignored` (K, 4) px where there are such boxes.
            head_outputs: of `forward`.
            anchors: per image (A, 4) px.
            matched_idxs: per image (A,) index of the label, -1 for negative anchors, -2 for those not counted.

        Returns:
            `conf`, `loc`, `cc` and, with sizes, `sizes`: scalars.
        """
        matched = torch.stack(list(matched_idxs))
        positive, counted = matched >= 0, matched != Matcher.BETWEEN_THRESHOLDS
        in_ignored = [_is_in_ignored(t, a) for t, a in zip(targets, anchors, strict=True)]
        counted &= positive | ~torch.stack(in_ignored)
        count = positive.sum().clamp(min=1)
        logits = head_outputs["cls_logits"].squeeze(-1).float()
        conf = sigmoid_focal_loss(logits[counted], positive[counted].to(logits.dtype), reduction="sum")

        coder = self.regression_head.box_coder
        label_indices = [index[index >= 0] for index in matched_idxs]
        deltas = torch.cat(
            [
                coder.encode_single(t["boxes"][index], a[mask])
                for t, index, a, mask in zip(targets, label_indices, anchors, positive, strict=True)
            ]
        )
        loc = F.smooth_l1_loss(head_outputs["bbox_regression"][positive], deltas, beta=self.beta, reduction="sum")

        true_cc = torch.cat([t["cc"][index] for t, index in zip(targets, label_indices, strict=True)])
        known = torch.cat([t["cc_known"][index] for t, index in zip(targets, label_indices, strict=True)])
        cc = F.smooth_l1_loss(head_outputs["cc"][positive][known], true_cc[known], beta=self.beta, reduction="sum")
        terms = {"conf": conf / count, "loc": loc / count, "cc": self.cc_weight * cc / count}
        if "sizes" in head_outputs:
            true_sizes = torch.cat([_true_sizes(t)[index] for t, index in zip(targets, label_indices, strict=True)])
            known = known & true_sizes.isfinite().all(dim=1)
            sizes = head_outputs["sizes"][positive][known]
            terms["sizes"] = (
                self.cc_weight * F.smooth_l1_loss(sizes, true_sizes[known], beta=self.beta, reduction="sum") / count
            )
        return terms


def _is_in_ignored(target: dict[str, Tensor], anchors: Tensor) -> Tensor:
    """Return (A,) bool which anchors (A, 4) px lie in an ignored box of the image by `MIN_IGNORED_SHARE`."""
    ignored = target.get("ignored")
    if ignored is None or not len(ignored):
        return torch.zeros(len(anchors), dtype=torch.bool, device=anchors.device)
    low = torch.maximum(anchors[:, None, :2], ignored[None, :, :2])
    high = torch.minimum(anchors[:, None, 2:], ignored[None, :, 2:])
    common = (high - low).clamp(min=0).prod(dim=2)
    area = (anchors[:, 2:] - anchors[:, :2]).prod(dim=1)
    return (common >= MIN_IGNORED_SHARE * area[:, None]).any(dim=1)


def _true_sizes(target: dict[str, Tensor]) -> Tensor:
    """Return what the model should predict of the labels' sizes, (L, 2); NaN for a camera of unknown height."""
    if target["scene"][1] == 0:
        return torch.full((len(target["cc"]), 2), torch.nan, device=target["cc"].device)
    return sizes_from_cc(target["cc"], target["boxes"], target["scene"])


class CcRetinaNet(RetinaNet):  # type: ignore[misc]
    """RetinaNet of one class with c_c.

    In training it returns the losses of `CcHead.compute_loss`. In evaluation it returns, per image, `boxes` (N, 4) px,
    `scores` (N,), `labels` (N,) zeros, `cc` (N,) in [0, 1] and, of models that predict them, `sizes` (N, 2), which
    `detector.model.vehicle_size.merge_sizes` combines with c_c.

    Args:
        backbone: trunk with pyramid, see `detector.model.backbone.build_backbone`.
        anchor_generator: of anchors in px.
        head: outputs and loss.
        options: of torchvision's RetinaNet: thresholds, numbers of detections, matcher.
    """

    def __init__(
        self, backbone: nn.Module, anchor_generator: CachedAnchorGenerator, head: CcHead, **options: Any
    ) -> None:
        super().__init__(backbone, num_classes=1, anchor_generator=anchor_generator, head=head, **options)
        self.transform = IdentityTransform()

    def postprocess_detections(self, head_outputs: Any, anchors: Any, image_shapes: Any) -> list[dict[str, Tensor]]:
        """Select the best detections of each image, as torchvision does; c_c, clamped to [0, 1], and sizes follow.

        All images and levels of a batch go through each step at once: on a GPU a small step costs as much as a large
        one.
        """
        # One image at a time: on a CPU the last bit of a sigmoid depends on how many are computed at once.
        logits = [level.squeeze(-1).float() for level in head_outputs["cls_logits"]]
        scores = torch.stack([torch.cat([torch.sigmoid(level[i]) for level in logits]) for i in range(len(logits[0]))])
        outputs = {name: torch.cat(list(parts), dim=1) for name, parts in head_outputs.items() if name != "cls_logits"}
        # Images of one batch are padded to one size, so they share their anchors.
        levels = [len(a) for a in anchors[0]]
        image, anchor = self._candidates(scores, levels)
        counts = torch.bincount(image, minlength=len(image_shapes)).tolist()
        best = scores[image, anchor]
        boxes = self.box_coder.decode_single(
            outputs["bbox_regression"][image, anchor].float(), torch.cat(list(anchors[0]))[anchor]
        )
        border = torch.tensor([(w, h, w, h) for h, w in image_shapes], dtype=boxes.dtype, device=boxes.device)
        values = {"boxes": torch.minimum(boxes.clamp(min=0), border[image]), "scores": best}
        values["labels"] = torch.zeros_like(anchor)
        values["cc"] = outputs["cc"][image, anchor].float().clamp(0, 1)
        if "sizes" in outputs:
            values["sizes"] = outputs["sizes"][image, anchor].float()
        detections = []
        for parts in zip(*(torch.split(value, counts) for value in values.values()), strict=True):
            candidates = dict(zip(values, parts, strict=True))
            keep = batched_nms(candidates["boxes"], candidates["scores"], candidates["labels"], self.nms_thresh)
            keep = keep[: self.detections_per_img]
            detections.append({name: value[keep] for name, value in candidates.items()})
        return detections

    def _candidates(self, scores: Tensor, levels: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Select anchors above the score threshold, at most `topk_candidates` per image and level.

        Args:
            scores: (N, A).
            levels: numbers of anchors per level, which sum to A.

        Returns:
            indices of image and anchor, each (K,), in the order of image, level and descending score.
        """
        image, anchor = torch.where(scores > self.score_thresh)
        ends = torch.tensor(levels, device=scores.device).cumsum(0)
        group = image * len(levels) + torch.searchsorted(ends, anchor, right=True)
        counts: list[int] = torch.bincount(group, minlength=len(scores) * len(levels)).tolist()
        best = scores[image, anchor]
        starts = [0, *accumulate(counts)]
        order = [
            start + best[start : start + count].topk(min(count, self.topk_candidates)).indices
            for start, count in zip(starts, counts, strict=False)
            if count
        ]
        selected = torch.cat(order) if order else torch.empty_like(anchor)
        return image[selected], anchor[selected]


def build_model(config: ModelConfig, *, weights: str = "none", **options: Any) -> CcRetinaNet:
    """Build a model.

    Args:
        config: its shape and loss.
        weights: of the trunk, "imagenet" or "none".
        options: further ones of torchvision's RetinaNet, for instance `score_thresh`.

    Raises:
        LabelgenError: the backbone or its weights are not available.
    """
    backbone = build_backbone(config.backbone, config.levels, config.channels, weights=weights, norm=config.trunk_norm)
    sizes: Sequence[Sequence[float]] = config.anchor_sizes
    anchors = CachedAnchorGenerator(tuple(map(tuple, sizes)), (tuple(config.anchor_ratios),) * len(sizes))
    head = CcHead(
        config.channels, anchors.num_anchors_per_location()[0], NORMS[config.head_norm], convs=config.head_convs,
        cc_weight=config.cc_weight, beta=config.beta, with_sizes=config.size_weight > 0,
    )  # fmt: skip
    matcher = Matcher(0.5, 0.4, allow_low_quality_matches=config.low_quality_matches)
    return CcRetinaNet(backbone, anchors, head, proposal_matcher=matcher, **options)
