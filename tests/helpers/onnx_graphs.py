"""Tiny ONNX networks that find the same vehicles in any picture, with the outputs of each family."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

COCO_NAMES = {0: "person", 2: "car", 3: "motorcycle", 5: "bus", 7: "truck"}
_LOGIT = 8.0


@dataclass(frozen=True)
class Found:
    """A vehicle that the network finds: box in px of the picture, class number, score."""

    box_xyxy: tuple[float, float, float, float]
    number: int
    score: float


def write_network(
    path: Path,
    outputs: Mapping[str, NDArray[Any]],
    input_shape: Sequence[int | str],
    *,
    dtype: Any = np.float32,
    metadata: Mapping[str, Any] | None = None,
    per_picture: bool = True,
) -> Path:
    """Write a network that gives constant outputs, for each picture of the batch where `per_picture`."""
    nodes, infos, constants = [], [], []
    rank = len(input_shape)
    axes = numpy_helper.from_array(np.arange(1, rank), "axes")
    nodes.append(helper.make_node("ReduceMean", ["images", "axes"], ["mean"], keepdims=0))
    nodes.append(helper.make_node("Mul", ["mean", "zero"], ["nothing"]))
    constants += [axes, numpy_helper.from_array(np.zeros(1, dtype), "zero")]
    for name, array in outputs.items():
        kind = np.dtype(dtype) if array.dtype.kind == "f" else array.dtype
        shape = ["B", *array.shape] if per_picture else list(array.shape)
        infos.append(helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(kind), shape))
        values = array.astype(kind)
        if per_picture:
            constants.append(numpy_helper.from_array(values[None], f"{name}_value"))
            target = np.array([-1, *[1] * array.ndim], dtype=np.int64)
            constants.append(numpy_helper.from_array(target, f"{name}_shape"))
            nodes.append(helper.make_node("Reshape", ["nothing", f"{name}_shape"], [f"{name}_zero"]))
            nodes.append(helper.make_node("Add", [f"{name}_value", f"{name}_zero"], [name]))
        else:
            constants.append(numpy_helper.from_array(values, f"{name}_value"))
            nodes.append(helper.make_node("Identity", [f"{name}_value"], [name]))
    kind = TensorProto.FLOAT16 if np.dtype(dtype) == np.float16 else TensorProto.FLOAT
    picture = helper.make_tensor_value_info("images", kind, list(input_shape))
    graph = helper.make_graph(nodes, "tiny", [picture], infos, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=8)
    helper.set_model_props(model, {key: str(value) for key, value in (metadata or {}).items()})
    onnx.save(model, path)
    return path


def mask_grid(box_xyxy: Sequence[float], picture_wh: tuple[int, int], grid_wh: tuple[int, int]) -> NDArray[np.float32]:
    """Return logits (h, w) over a picture, high in the box."""
    x, y = ((np.arange(n) + 0.5) * side / n for n, side in zip(grid_wh, picture_wh, strict=True))
    inside = ((x > box_xyxy[0]) & (x < box_xyxy[2]))[None] & ((y > box_xyxy[1]) & (y < box_xyxy[3]))[:, None]
    return np.where(inside, _LOGIT, -_LOGIT).astype(np.float32)


def yolo_raw(
    found: Sequence[Found], picture_wh: tuple[int, int], *, classes: int = 80, channels_last: bool = False
) -> dict[str, NDArray[Any]]:
    """Return head and prototypes of a raw head: one prototype for each vehicle, the last anchors hold them."""
    count = sum((picture_wh[0] // s) * (picture_wh[1] // s) for s in (8, 16, 32))
    head = np.zeros((4 + classes + len(found), count), dtype=np.float32)
    for i, one in enumerate(found):
        x0, y0, x1, y1 = one.box_xyxy
        head[:4, -1 - i] = (x0 + x1) / 2, (y0 + y1) / 2, x1 - x0, y1 - y0
        head[4 + one.number, -1 - i] = one.score
        head[4 + classes + i, -1 - i] = 1
    return {"output0": head.T if channels_last else head, "output1": _prototypes(found, picture_wh)}


def yolo_end_to_end(found: Sequence[Found], picture_wh: tuple[int, int]) -> dict[str, NDArray[Any]]:
    """Return head and prototypes of an end-to-end head with room for 20 vehicles."""
    head = np.zeros((20, 6 + len(found)), dtype=np.float32)
    for i, one in enumerate(found):
        head[i, :6] = *one.box_xyxy, one.score, one.number
        head[i, 6 + i] = 1
    return {"output0": head, "output1": _prototypes(found, picture_wh)}


def rf_detr(found: Sequence[Found], picture_wh: tuple[int, int], *, classes: int = 91) -> dict[str, NDArray[Any]]:
    """Return boxes, logits and masks of RF-DETR with 20 queries."""
    boxes, logits = np.full((20, 4), 0.5, dtype=np.float32), np.full((20, classes), -_LOGIT, dtype=np.float32)
    masks = np.full((20, picture_wh[1] // 4, picture_wh[0] // 4), -_LOGIT, dtype=np.float32)
    for i, one in enumerate(found):
        x0, y0, x1, y1 = np.array(one.box_xyxy) / (*picture_wh, *picture_wh)
        boxes[i] = (x0 + x1) / 2, (y0 + y1) / 2, x1 - x0, y1 - y0
        logits[i, one.number] = np.log(one.score / (1 - one.score))
        masks[i] = mask_grid(one.box_xyxy, picture_wh, masks.shape[:0:-1])
    return {"dets": boxes, "labels": logits, "masks": masks}


def torchvision_mask_rcnn(
    found: Sequence[Found], picture_wh: tuple[int, int], *, pasted: bool = True
) -> dict[str, NDArray[Any]]:
    """Return boxes, labels, scores and masks as torchvision does: over the picture, or 28 x 28 over the box."""
    masks = np.ones((len(found), 1, 28, 28), dtype=np.float32)
    if pasted:
        grids = [mask_grid(one.box_xyxy, picture_wh, picture_wh) > 0 for one in found]
        masks = np.array(grids, dtype=np.float32).reshape(-1, 1, *picture_wh[::-1])
    return {
        "boxes": np.array([one.box_xyxy for one in found], dtype=np.float32).reshape(-1, 4),
        "labels": np.array([one.number for one in found], dtype=np.int64),
        "scores": np.array([one.score for one in found], dtype=np.float32),
        "masks": masks,
    }


def _prototypes(found: Sequence[Found], picture_wh: tuple[int, int]) -> NDArray[np.float32]:
    grid = (picture_wh[0] // 4, picture_wh[1] // 4)
    return np.array([mask_grid(one.box_xyxy, picture_wh, grid) for one in found], dtype=np.float32)


def write_seeing_network(path: Path, input_shape: Sequence[int | str]) -> Path:
    """Write a network that finds what is brighter than half, as one car with score 0.9, end to end."""
    bright, name = "bright", helper.make_node
    # Slice's third and fourth inputs are the ends and the axes: the first of the three channels.
    nodes = [
        name("Slice", ["images", "zero", "one", "one"], ["red"]),
        name("Greater", ["red", "half"], ["is_bright"]),
        name("Cast", ["is_bright"], [bright], to=TensorProto.FLOAT),
        name("Mul", [bright, "sixteen"], ["scaled"]),
        name("Sub", ["scaled", "eight"], ["output1"]),
        name("ReduceMax", [bright, "everything"], ["any"], keepdims=0),
        name("Mul", ["any", "score"], ["scores"]),
        name("Squeeze", [bright, "one"], ["flat"]),
    ]
    for axis in "xy":
        nodes += [
            name("ReduceMax", ["flat", f"{axis}_axis"], [f"{axis}_profile"], keepdims=0),
            name("ArgMax", [f"{axis}_profile"], [f"{axis}_low"], axis=1, keepdims=0),
            name("ArgMax", [f"{axis}_profile"], [f"{axis}_last"], axis=1, keepdims=0, select_last_index=1),
            name("Add", [f"{axis}_last", "one_scalar"], [f"{axis}_high"]),
        ]
    columns = []
    for value in ("x_low", "y_low", "x_high", "y_high"):
        nodes.append(name("Cast", [value], [f"{value}_float"], to=TensorProto.FLOAT))
        columns.append(f"{value}_float")
    nodes += [
        name("Mul", ["scores", "zero_float"], ["zeros"]),
        name("Add", ["zeros", "car"], ["classes"]),
        name("Add", ["zeros", "one_float"], ["coefficients"]),
    ]
    for value in (*columns, "scores", "classes", "coefficients"):
        nodes.append(name("Reshape", [value, "column"], [f"{value}_column"]))
    parts = [f"{value}_column" for value in (*columns, "scores", "classes", "coefficients")]
    nodes.append(name("Concat", parts, ["output0"], axis=2))
    constants = [
        numpy_helper.from_array(np.asarray(value), key)
        for key, value in {
            "zero": np.array([0]), "one": np.array([1]), "one_scalar": np.array(1), "everything": np.array([1, 2, 3]),
            "x_axis": np.array([1]), "y_axis": np.array([2]), "column": np.array([-1, 1, 1]),
            "half": np.float32(0.5), "sixteen": np.float32(16), "eight": np.float32(8), "score": np.float32(0.9),
            "zero_float": np.float32(0), "one_float": np.float32(1), "car": np.float32(2),
        }.items()
    ]  # fmt: skip
    outputs = [
        helper.make_tensor_value_info("output0", TensorProto.FLOAT, ["B", 1, 7]),
        helper.make_tensor_value_info("output1", TensorProto.FLOAT, ["B", 1, "h", "w"]),
    ]
    picture = helper.make_tensor_value_info("images", TensorProto.FLOAT, list(input_shape))
    graph = helper.make_graph(nodes, "seeing", [picture], outputs, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=8)
    helper.set_model_props(model, {"names": str(COCO_NAMES), "imgsz": "[128, 128]", "end2end": "True"})
    onnx.save(model, path)
    return path
