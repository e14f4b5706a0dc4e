"""An ONNX network on this machine: opened, described, and run on a batch of pictures."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.before_torch import device_parts
from labelgen.errors import DataError, LabelgenError

__all__ = ["InputLayout", "NetworkSession"]

_TYPES: dict[str, np.dtype[Any]] = {
    "tensor(float)": np.dtype(np.float32),
    "tensor(float16)": np.dtype(np.float16),
}
_MAX_SIDE = 8192
_MAX_METADATA = 1 << 20
# What is tried without a wish for a device, best first.
_PROVIDERS = (
    "CUDAExecutionProvider",
    "ROCMExecutionProvider",
    "MIGraphXExecutionProvider",
    "CoreMLExecutionProvider",
    "DmlExecutionProvider",
    "CPUExecutionProvider",
)
_CPU = "CPUExecutionProvider"
_OF_DEVICE = {
    "cuda": ("CUDAExecutionProvider", "ROCMExecutionProvider"),
    "mps": ("CoreMLExecutionProvider",),
    "gpu": tuple(name for name in _PROVIDERS if name != _CPU),
}


@dataclass(frozen=True)
class InputLayout:
    """The picture that a network takes.

    Args:
        name: of the input.
        dtype: float32 or float16.
        batch: fixed number of pictures in a batch; 0 for any number.
        height: fixed height, px; 0 for any.
        width: fixed width, px; 0 for any.
        has_batch: whether there is an axis of the batch at all.
    """

    name: str
    dtype: np.dtype[Any]
    batch: int
    height: int
    width: int
    has_batch: bool = True


class NetworkSession:
    """An ONNX network, ready to run.

    Args:
        path: the file.
        device: "cpu", "cuda:1" and so on, see `labelgen.before_torch.device_parts`; None for the best there is.

    Attributes:
        layout: of its only input.
        metadata: the texts that the file carries.
        output_names: in order.
        providers: what runs it, as onnxruntime names it.
        on_gpu: whether it runs on something else than the CPU.

    Raises:
        LabelgenError: onnxruntime is not installed, or there is no such device.
        DataError: the file is missing, no ONNX network, or takes something else than pictures.
    """

    def __init__(self, path: Path, *, device: str | None = None) -> None:
        self.path = path
        runtime = _runtime()
        options = runtime.SessionOptions()
        options.intra_op_num_threads = _threads()
        options.inter_op_num_threads = 1
        options.log_severity_level = 4
        try:
            self._session = runtime.InferenceSession(str(path), options, providers=_providers(runtime, device))
        except Exception as err:  # onnxruntime has a class of errors for each kind of failure
            if not path.is_file():
                raise DataError(f"{path}: no such file", parameter="masks") from None
            raise DataError(
                f"{path}: not an ONNX network that onnxruntime {runtime.__version__} can open ({_reason(err)}); "
                "export it again",
                parameter="masks",
            ) from None
        self.providers: list[str] = self._session.get_providers()
        self.on_gpu = self.providers[0] != _CPU
        found: Mapping[str, str] = self._session.get_modelmeta().custom_metadata_map
        self.metadata = {key: value for key, value in found.items() if len(value) <= _MAX_METADATA}
        self.output_names = [output.name for output in self._session.get_outputs()]
        self.layout = self._layout(self._session.get_inputs())

    def _layout(self, inputs: Sequence[Any]) -> InputLayout:
        described = ", ".join(f"{one.name} {one.type} {one.shape}" for one in inputs[:4])
        shape = list(inputs[0].shape) if inputs else []
        sides = [side if isinstance(side, int) and side > 0 else 0 for side in shape]
        if len(inputs) != 1 or len(sides) not in (3, 4) or sides[-3] not in (0, 3) or inputs[0].type not in _TYPES:
            raise DataError(
                f"{self.path}: expected a network with one input of pictures, float or float16 of shape (batch, 3, "
                f"height, width), found {described or 'none'}",
                parameter="masks",
            )
        if max(sides) > _MAX_SIDE:
            raise DataError(
                f"{self.path}: its input {described} is larger than {_MAX_SIDE} px; export it smaller",
                parameter="masks",
            )
        has_batch = len(sides) == 4
        return InputLayout(
            inputs[0].name, _TYPES[inputs[0].type], sides[0] if has_batch else 1, sides[-2], sides[-1], has_batch
        )

    def run(self, pictures: NDArray[np.float32]) -> list[NDArray[Any]]:
        """Run the network.

        Args:
            pictures: (B, 3, H, W); B is the layout's where that is fixed.

        Returns:
            All outputs, numbers of half precision as float32.

        Raises:
            DataError: the network fails.
        """
        batch = np.ascontiguousarray(pictures if self.layout.has_batch else pictures[0], dtype=self.layout.dtype)
        try:
            outputs = self._session.run(None, {self.layout.name: batch})
        except Exception as err:  # as above
            shape = "x".join(map(str, batch.shape))
            raise DataError(
                f"{self.path}: the network fails on pictures of shape {shape} ({_reason(err)}); export it again, or "
                "for another size",
                parameter="masks",
            ) from None
        arrays = [np.asarray(output) for output in outputs]
        return [array.astype(np.float32) if array.dtype == np.float16 else array for array in arrays]


def _runtime() -> Any:
    try:
        import onnxruntime
    except ImportError:
        raise LabelgenError(
            "masks onnx:FILE needs onnxruntime; install it with pip install 'labelgen[onnx]'", parameter="masks"
        ) from None
    return onnxruntime


def _threads() -> int:
    """Return how many threads this process may use: workers of a job have one each."""
    allowed = cv2.getNumThreads()
    stated = os.environ.get("OMP_NUM_THREADS", "")
    return max(1, min(allowed, int(stated)) if stated.isdecimal() and int(stated) > 0 else allowed)


def _providers(runtime: Any, device: str | None) -> list[Any]:
    available = runtime.get_available_providers()
    kind, number = device_parts(device)
    if kind == "auto":
        return [name for name in _PROVIDERS if name in available]
    if kind == "cpu":
        return [_CPU]
    for name in _OF_DEVICE[kind]:
        if name in available:
            return [(name, {"device_id": int(number[1:])}) if number else name, _CPU]
    raise LabelgenError(
        f"device {device}: onnxruntime as installed here cannot use it (it has {', '.join(available)}); install "
        "onnxruntime-gpu, or use cpu",
        parameter="device",
    )


def _reason(err: Exception) -> str:
    return " ".join(str(err).split())[:200] or type(err).__name__
