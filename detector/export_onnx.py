"""Export of a detector to ONNX, for other runtimes.

The input `image` is a rectified picture (3, H, W) float32 RGB in [0, 1] of the size in the metadata. The outputs are
`boxes` (N, 4) px, `scores` (N,) and `cc` (N,), highest score first, after non-maximum suppression. Models that predict
sizes also have `sizes` (N, 2), which `detector.model.vehicle_size.merge_sizes` combines with c_c and boxes. The
detector's metadata is stored as JSON in the metadata of the file, under "labelgen".
"""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torchvision.models.detection.image_list import ImageList
from torchvision.ops import clip_boxes_to_image, nms

from detector.checkpoint import METADATA_KEY, ModelMetadata, load_model
from detector.inference import fold_batch_norm
from detector.model.retinanet import CcRetinaNet
from labelgen.atomic_files import write_atomic
from labelgen.errors import LabelgenError

__all__ = ["FixedSizeDetector", "Parity", "check_onnx", "export_onnx"]

_INSTALL_HINT = "exporting needs ONNX: pip install 'labelgen[export]'"


class FixedSizeDetector(nn.Module):
    """A model for one picture of one size, which can be traced.

    The numbers of candidates are fixed: only non-maximum suppression depends on the data.

    Args:
        model: trained.
        size_wh: width, height px of the pictures.
    """

    anchors: Tensor
    mean: Tensor
    std: Tensor

    def __init__(self, model: CcRetinaNet, size_wh: tuple[int, int]) -> None:
        super().__init__()
        self.model, self._size_hw = model.eval(), (size_wh[1], size_wh[0])
        with torch.no_grad():
            images, _ = model.transform([torch.zeros(3, *self._size_hw)])
            features = list(model.backbone(images.tensors).values())
            (anchors,) = model.anchor_generator(ImageList(images.tensors, [self._size_hw]), features)
        per_cell = model.anchor_generator.num_anchors_per_location()[0]
        self._levels = [f.shape[-1] * f.shape[-2] * per_cell for f in features]
        self._padding = (images.tensors.shape[-1] - size_wh[0], images.tensors.shape[-2] - size_wh[1])
        self.register_buffer("anchors", anchors)
        mean, std = model.transform.image_mean, model.transform.image_std
        self.register_buffer("mean", torch.tensor(mean)[:, None, None])
        self.register_buffer("std", torch.tensor(std)[:, None, None])

    @property
    def output_names(self) -> list[str]:
        """Names of what `forward` returns."""
        return ["boxes", "scores", "cc", *(["sizes"] if self.model.head.regression_head.values > 1 else [])]

    def forward(self, image: Tensor) -> tuple[Tensor, ...]:
        """Detect vehicles in a picture (3, H, W).

        Returns:
            boxes (N, 4) px, scores (N,), c_c (N,) and, where predicted, sizes (N, 2).
        """
        model = self.model
        padded = nn.functional.pad((image - self.mean) / self.std, (0, self._padding[0], 0, self._padding[1]))
        outputs = model.head(list(model.backbone(padded[None]).values()))
        parts = []
        start = 0
        for count in self._levels:
            stop = start + count
            scores, index = torch.sigmoid(outputs["cls_logits"][0, start:stop, 0]).topk(
                min(model.topk_candidates, count)
            )
            index = index + start
            boxes = model.box_coder.decode_single(outputs["bbox_regression"][0][index], self.anchors[index])
            values = [outputs["cc"][0][index].clamp(0, 1)]
            values += [outputs["sizes"][0][index]] if "sizes" in outputs else []
            parts.append((clip_boxes_to_image(boxes, self._size_hw), scores, *values))
            start = stop
        boxes, scores, *rest = (torch.cat(part) for part in zip(*parts, strict=True))
        # A box suppresses only boxes of lower scores, so the threshold can be applied afterwards.
        keep = nms(boxes, scores, model.nms_thresh)
        keep = keep[scores[keep] > model.score_thresh][: model.detections_per_img]
        return boxes[keep], scores[keep], *(value[keep] for value in rest)


def export_onnx(checkpoint: Path, out: Path, *, score: float = 0.3) -> ModelMetadata:
    """Write a detector as ONNX.

    Args:
        checkpoint: written by training.
        out: file to write.
        score: lowest score of a detection, in [0, 1].

    Returns:
        the detector's metadata.

    Raises:
        LabelgenError: ONNX is not installed.
        DataError: not a checkpoint of a detector.
        OutputError: the file cannot be written.
    """
    try:
        import onnx
        import onnxscript  # noqa: F401  torch's exporter needs it
    except ModuleNotFoundError as err:
        raise LabelgenError(f"{err.name} is not installed; {_INSTALL_HINT}") from None
    model, metadata = load_model(checkpoint, score_thresh=score)
    fold_batch_norm(model)
    wrapped = FixedSizeDetector(model, metadata.size_wh).eval()
    image = torch.rand(3, metadata.size_wh[1], metadata.size_wh[0])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        program = torch.onnx.export(
            wrapped, (image,), dynamo=True, input_names=["image"], output_names=wrapped.output_names, verbose=False
        )
    assert program is not None
    proto: Any = program.model_proto
    proto.metadata_props.append(onnx.StringStringEntryProto(key=METADATA_KEY, value=json.dumps(metadata.to_dict())))
    write_atomic(out, proto.SerializeToString())
    return metadata


@dataclass(frozen=True)
class Parity:
    """Largest differences between an exported detector and its checkpoint.

    Args:
        boxes: number of boxes compared.
        px: of box sides, px.
        score: of scores.
        cc: of c_c.
        sizes: of the sizes' logarithms; 0 for models that predict none.
    """

    boxes: int
    px: float
    score: float
    cc: float
    sizes: float


def check_onnx(
    checkpoint: Path, exported: Path, images: Sequence[NDArray[np.float32]], *, score: float = 0.3
) -> Parity:
    """Compare an exported detector, on onnxruntime, with its checkpoint, on PyTorch.

    Args:
        checkpoint: written by training.
        exported: file of `export_onnx`.
        images: rectified pictures (3, H, W) float32 RGB in [0, 1].
        score: lowest score with which it was exported.

    Raises:
        LabelgenError: onnxruntime is not installed, or the two detect different numbers of vehicles.
    """
    try:
        import onnxruntime
    except ModuleNotFoundError as err:
        raise LabelgenError(f"{err.name} is not installed; {_INSTALL_HINT}") from None
    model, _ = load_model(checkpoint, score_thresh=score)
    session = onnxruntime.InferenceSession(exported.read_bytes(), providers=["CPUExecutionProvider"])
    count, largest = 0, [0.0, 0.0, 0.0, 0.0]
    for image in images:
        with torch.inference_mode():
            (expected,) = model([torch.from_numpy(image)])
        outputs = session.run(None, {"image": image})
        if len(outputs[0]) != len(expected["boxes"]):
            raise LabelgenError(
                f"{exported}: it detects {len(outputs[0])} boxes, the checkpoint {len(expected['boxes'])}"
            )
        count += len(outputs[0])
        for k, (key, value) in enumerate(zip(("boxes", "scores", "cc", "sizes"), outputs, strict=False)):
            largest[k] = max(largest[k], float(np.abs(value - expected[key].numpy()).max(initial=0.0)))
    return Parity(count, *largest)
