"""Checkpoints of detectors: reading them, what they say of themselves, and the network they hold.

A checkpoint is a dict of tensors, numbers and text, as `torch.load(weights_only=True)` reads it. It has Lightning's own
fields (weights, optimiser, progress) and, under "labelgen", the metadata of the network.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from detector.metadata_schema import metadata_problems
from detector.model.retinanet import CcRetinaNet, ModelConfig, build_model
from labelgen.errors import DataError, LabelgenError
from labelgen.geometry import Pair, Region
from labelgen.torch_file import first_not_finite, load_torch_file
from labelgen.version import __version__

__all__ = ["METADATA_KEY", "ModelMetadata", "check_weights", "load_model", "read_checkpoint"]

METADATA_KEY, WEIGHTS_PREFIX = "labelgen", "model."
_FORMAT, _VERSION = "labelgen-detector", 1


@dataclass(frozen=True)
class ModelMetadata:
    """What a detector is for and where it comes from. Field names are part of the checkpoint format.

    Args:
        preset: name of the settings it was trained with.
        pair: vanishing points made axis-parallel in the pictures it takes.
        size_wh: width, height px of these pictures.
        config: shape of the network.
        min_height_px: height px of the lowest labels it was trained on.
        labels: one dict per set of shards, see `detector.data.dataset.label_provenance`.
        training: settings that decide the result: seed, batch, steps and so on.
        producer: version that trained it.
    """

    preset: str
    pair: Pair
    size_wh: tuple[int, int]
    config: ModelConfig
    min_height_px: float
    labels: list[dict[str, Any]]
    training: dict[str, Any]
    producer: str = f"labelgen {__version__}"

    @property
    def region(self) -> Region:
        """What is rectified in the whole pictures it was trained on; the road where they disagree or do not say."""
        regions = {s["region"] for labels in self.labels for s in labels["settings"] if "region" in s}
        return Region(regions.pop()) if len(regions) == 1 else Region.ROAD

    def to_dict(self) -> dict[str, Any]:
        """Return the metadata as plain values, as they stand in a checkpoint."""
        return {**asdict(self), "pair": str(self.pair), "format": _FORMAT, "version": _VERSION}

    @classmethod
    def from_dict(cls, data: Any, where: str) -> ModelMetadata:
        """Make metadata of plain values.

        Args:
            data: of `to_dict`.
            where: they come from, for messages.

        Raises:
            DataError: not a detector's metadata, damaged, or of another version.
        """
        if not isinstance(data, dict) or data.get("format") != _FORMAT:
            raise DataError(f"{where}: not a checkpoint of a labelgen detector; give one that `labelgen train` wrote")
        if data.get("version") != _VERSION:
            raise DataError(
                f"{where}: checkpoint format {data.get('version')}, this labelgen reads {_VERSION}; take the other one"
            )
        problems = metadata_problems(data)
        if problems:
            raise DataError(f"{where}: damaged metadata ({'; '.join(problems)}); train again")
        config = {key: _as_tuples(value) for key, value in data["config"].items()}
        width, height = data["size_wh"]
        return cls(
            data["preset"], Pair.parse(data["pair"]), (width, height), ModelConfig(**config),
            float(data["min_height_px"]), list(data["labels"]), dict(data["training"]), data["producer"],
        )  # fmt: skip


def _as_tuples(value: Any) -> Any:
    return tuple(_as_tuples(v) for v in value) if isinstance(value, list | tuple) else value


def read_checkpoint(path: str | Path, label: str = "") -> dict[str, Any]:
    """Read the content of a checkpoint: tensors and plain values, no code.

    Args:
        path: checkpoint.
        label: what it is and its path, for errors; "checkpoint PATH" by default.

    Raises:
        DataError: no such file, damaged, or with anything else inside.
    """
    label = label or f"checkpoint {path}"
    data = load_torch_file(path, label)
    if not isinstance(data, dict):
        raise DataError(f"{label}: not a checkpoint of a labelgen detector")
    return data


def load_model(path: str | Path, **options: Any) -> tuple[CcRetinaNet, ModelMetadata]:
    """Load the network of a checkpoint, in evaluation mode, on the CPU.

    Args:
        path: checkpoint.
        options: of `detector.model.retinanet.build_model`, for instance `score_thresh`.

    Raises:
        DataError: not a checkpoint of a detector.
    """
    data = read_checkpoint(path)
    metadata = ModelMetadata.from_dict(data.get(METADATA_KEY), f"checkpoint {path}")
    state = check_weights(data.get("state_dict", {}), metadata, f"checkpoint {path}")
    model = build_model(metadata.config, **options)
    model.load_state_dict(state)
    return model.eval(), metadata


def check_weights(state: Any, metadata: ModelMetadata, where: str) -> dict[str, Any]:
    """Return a checkpoint's weights by their names in the network.

    Names and shapes are compared with a network without memory: a file cannot ask for one that it does not fill.

    Args:
        state: "state_dict" of the checkpoint, or a bare state dict.
        metadata: says which network they are of.
        where: they come from, for messages.

    Raises:
        DataError: they do not fit, or are not finite.
    """
    if not isinstance(state, dict) or not all(isinstance(value, torch.Tensor) for value in state.values()):
        raise DataError(f"{where}: it has no weights")
    own = {str(key).removeprefix(WEIGHTS_PREFIX): value for key, value in state.items()}
    try:
        with torch.device("meta"):
            expected = build_model(metadata.config).state_dict()
    except (RuntimeError, ValueError, TypeError, AttributeError, NotImplementedError, LabelgenError) as err:
        reason = " ".join(str(err).split())[:120]
        raise DataError(
            f"{where}: damaged metadata (no network of its kind can be built: {reason}); train again"
        ) from None
    differing = [key for key in expected if key not in own or own[key].shape != expected[key].shape]
    differing += [key for key in own if key not in expected]
    if differing:
        shown = ", ".join(differing[:3]) + (f" and {len(differing) - 3} more" if len(differing) > 3 else "")
        raise DataError(f"{where}: its weights are of another network ({shown} differ)")
    if any(own[key].is_floating_point() != expected[key].is_floating_point() for key in expected):
        raise DataError(f"{where}: its weights are of another type")
    broken = first_not_finite(own)
    if broken is not None:
        raise DataError(
            f"{where}: its weights are not finite ({broken}), so it detects nothing; take an earlier checkpoint, or "
            "train again with a lower learning rate"
        )
    return own
