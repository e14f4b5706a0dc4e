"""Masks from torchvision's Mask R-CNN with COCO classes.

Source: He et al., "Mask R-CNN", ICCV 2017; weights and classes: torchvision.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torchvision.models.detection import (
    MaskRCNN_ResNet50_FPN_V2_Weights,
    maskrcnn_resnet50_fpn,
    maskrcnn_resnet50_fpn_v2,
)
from torchvision.models.detection.transform import GeneralizedRCNNTransform

from labelgen.errors import DataError, NoWeightsError
from labelgen.masks.class_names import CLASS_BY_COCO_ID
from labelgen.masks.instances import Crop, InstanceMasks, crop_mask
from labelgen.torch_device import choose_device
from labelgen.torch_file import first_not_finite, load_torch_file

__all__ = ["MaskRcnnMasks"]

_MASK_THRESHOLD = 0.5
_COCO_CLASSES = 91
# The example is what Ultralytics' own export writes.
_OTHER_MASKS = ("onnx:yolo11n-seg.onnx", "background")
# The region proposal head has two convolutions in the second version only.
_V2_KEY = "rpn.head.conv.1.0.weight"


class MaskRcnnMasks:
    """A `labelgen.masks.source.MaskSource`: instance masks of cars, motorcycles, buses and trucks.

    Args:
        weights: state dict of torchvision's maskrcnn_resnet50_fpn_v2 or maskrcnn_resnet50_fpn with COCO's 91 classes;
            its keys show which of the two. None downloads the COCO weights of v2 once.
        score_threshold: masks with a lower score are left out.
        device: torch device; None takes a GPU if there is one.

    Raises:
        DataError: the file of the weights is missing or holds something else.
        LabelgenError: the weights cannot be downloaded, or there is no such device.
    """

    every_frame = 0
    prime_frames = 0
    batch_size = 4

    def __init__(
        self, *, weights: str | Path | None = None, score_threshold: float = 0.5, device: str | None = None
    ) -> None:
        self.problems: list[str] = []
        self._score_threshold = score_threshold
        self._device = choose_device(device)
        state = _download() if weights is None else _load(Path(weights))
        build = maskrcnn_resnet50_fpn_v2 if _V2_KEY in state else maskrcnn_resnet50_fpn
        model = build(weights=None, weights_backbone=None, num_classes=_COCO_CLASSES)
        _fill(model, state, "the downloaded weights" if weights is None else str(weights))
        model.roi_heads.score_thresh = score_threshold
        model.transform = _SmallMasks(model.transform)
        self._model = model.to(self._device).eval()

    def prime(self, frames: Iterable[NDArray[np.uint8]]) -> None:
        """Do nothing: frames are segmented one by one."""

    def observe(self, image: NDArray[np.uint8]) -> None:
        """Do nothing: frames are segmented one by one."""

    def masks(
        self,
        images: Sequence[NDArray[np.uint8]],
        frame_numbers: Sequence[int] | None = None,
        file_names: Sequence[str] | None = None,
    ) -> list[InstanceMasks]:
        """Return the vehicles' masks in each image; see `MaskSource.masks`."""
        if not images:
            return []
        # The copy is needed because torch does not accept views with negative strides.
        batch = [
            torch.from_numpy(image[..., ::-1].transpose(2, 0, 1).copy()).to(self._device).float() / 255
            for image in images
        ]
        with torch.inference_mode():
            detections = self._model(batch)
        return [
            self._vehicles({k: v.cpu().numpy() for k, v in one.items()}, (image.shape[1], image.shape[0]))
            for one, image in zip(detections, images, strict=True)
        ]

    def _vehicles(self, detections: Mapping[str, NDArray[Any]], frame_wh: tuple[int, int]) -> InstanceMasks:
        """Return the vehicles among the detections of one image."""
        crops, class_ids, scores = [], [], []
        for box, label, score, small in zip(
            *(detections[key] for key in ("boxes", "labels", "scores", "masks")), strict=True
        ):
            vehicle_class = CLASS_BY_COCO_ID.get(int(label))
            if vehicle_class is None or score < self._score_threshold:
                continue
            crop = _place(small[0], box, frame_wh)
            if crop is None:
                continue
            crops.append(crop)
            class_ids.append(vehicle_class)
            scores.append(min(float(score), 1.0))
        return InstanceMasks.from_crops(frame_wh, crops, class_ids, scores, are_predicted=True)


class _SmallMasks(GeneralizedRCNNTransform):  # type: ignore[misc]
    """The model's own transform, without pasting masks of 28 x 28 into whole frames, which would fill gigabytes."""

    def __init__(self, like: GeneralizedRCNNTransform) -> None:
        super().__init__(like.min_size, like.max_size, like.image_mean, like.image_std)

    def postprocess(
        self, result: list[dict[str, Any]], image_shapes: list[Any], original_image_sizes: list[Any]
    ) -> list[dict[str, Any]]:
        for one, (h, w), (frame_h, frame_w) in zip(result, image_shapes, original_image_sizes, strict=True):
            scale = torch.tensor([frame_w / w, frame_h / h] * 2, device=one["boxes"].device)
            one["boxes"] = one["boxes"] * scale
        return result


def _place(small: NDArray[np.float32], box_xyxy: NDArray[np.float32], frame_wh: tuple[int, int]) -> Crop | None:
    """Resample a mask (28, 28) of probabilities, which spans a box, to the frame."""
    x0, y0, x1, y1 = (float(v) for v in box_xyxy)
    low = max(0, int(np.floor(x0))), max(0, int(np.floor(y0)))
    high = min(frame_wh[0], int(np.ceil(x1))), min(frame_wh[1], int(np.ceil(y1)))
    if not (x1 > x0 and y1 > y0 and high[0] > low[0] and high[1] > low[1]):
        return None
    n = small.shape[0]
    fx, fy = n / (x1 - x0), n / (y1 - y0)
    matrix = np.array([[fx, 0, (low[0] + 0.5 - x0) * fx - 0.5], [0, fy, (low[1] + 0.5 - y0) * fy - 0.5]])
    size = (high[0] - low[0], high[1] - low[1])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return crop_mask(cv2.warpAffine(small, matrix, size, flags=flags) >= _MASK_THRESHOLD, low)


def _download() -> dict[str, Any]:
    weights = MaskRCNN_ResNet50_FPN_V2_Weights.COCO_V1
    try:
        state: dict[str, Any] = weights.get_state_dict(progress=False, check_hash=True, weights_only=True)
    except (OSError, RuntimeError, pickle.UnpicklingError) as error:
        raise NoWeightsError(
            f"Mask R-CNN's COCO weights cannot be downloaded ({_first_line(error)}); give a state dict as weights, or "
            f"use masks of a network of yours in an ONNX file, or of a background model ({', '.join(_OTHER_MASKS)})",
            other_masks=_OTHER_MASKS,
            parameter="weights",
        ) from None
    return state


def _load(path: Path) -> dict[str, Any]:
    state = load_torch_file(path, f"weights {path}", parameter="weights")
    for key in ("state_dict", "model"):
        if isinstance(state, dict) and isinstance(state.get(key), dict):
            state = state[key]
    if not isinstance(state, dict) or not all(isinstance(v, torch.Tensor) for v in state.values()):
        raise DataError(
            f"weights {path}: not a state dict; save it with torch.save(model.state_dict(), FILE)", parameter="weights"
        )
    broken = first_not_finite(state)
    if broken is not None:
        raise DataError(
            f"weights {path}: {broken} has values that are not finite; take another file", parameter="weights"
        )
    return {str(key).removeprefix("module."): value for key, value in state.items()}


def _fill(model: torch.nn.Module, state: Mapping[str, Any], label: str) -> None:
    """Load a state dict into the model; refuse one that does not fit, naming the first differences."""
    expected = model.state_dict()
    missing = [k for k in expected if k not in state and not k.endswith("num_batches_tracked")]
    unexpected = [k for k in state if k not in expected]
    other = [k for k in expected if k in state and expected[k].shape != state[k].shape]
    parts = [
        f"{len(keys)} {kind} (such as {keys[0]})"
        for kind, keys in (("keys missing", missing), ("unexpected", unexpected), ("of another shape", other))
        if keys
    ]
    if parts:
        raise DataError(
            f"weights {label}: not a Mask R-CNN of torchvision with {_COCO_CLASSES} classes: {', '.join(parts)}",
            parameter="weights",
        )
    model.load_state_dict(dict(state), strict=False)


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:120].rstrip(". ")
