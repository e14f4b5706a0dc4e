"""Checkpoints of detectors: reading them, what they say of themselves, and the network they hold.

A checkpoint is a dict of tensors, numbers and text, as `torch.load(weights_only=True)` reads it. It has Lightning's own
fields (weights, optimiser, progress) and, under "labelgen", the metadata of the network.
"""

from __future__ import annotations

import pickle
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from detector.model.retinanet import CcRetinaNet, ModelConfig, build_model
from labelgen.errors import DataError, LabelgenError
from labelgen.geometry import Pair, Region
from labelgen.version import __version__

__all__ = ["METADATA_KEY", "ModelMetadata", "load_model", "read_checkpoint"]

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
        try:
            config = {key: _as_tuples(value) for key, value in data["config"].items()}
            return cls(
                data["preset"], Pair.parse(data["pair"]), (int(data["size_wh"][0]), int(data["size_wh"][1])),
                ModelConfig(**config), float(data["min_height_px"]), list(data["labels"]), dict(data["training"]),
                str(data["producer"]),
            )  # fmt: skip
        except (KeyError, TypeError, ValueError, LabelgenError) as err:
            raise DataError(f"{where}: damaged metadata ({err}); train again") from None


def _as_tuples(value: Any) -> Any:
    return tuple(_as_tuples(v) for v in value) if isinstance(value, list | tuple) else value


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """Read the content of a checkpoint: tensors and plain values, no code.

    Raises:
        DataError: no such file, damaged, or with anything else inside.
    """
    try:
        data = torch.load(path, map_location="cpu", weights_only=True)
    except OSError as err:
        raise DataError(f"checkpoint {path}: {err.strerror or err}") from None
    except (pickle.UnpicklingError, RuntimeError, EOFError, ValueError) as err:
        reason = " ".join(str(err).split())[:120]
        raise DataError(f"checkpoint {path}: not a whole checkpoint of plain weights ({reason})") from None
    if not isinstance(data, dict):
        raise DataError(f"checkpoint {path}: not a checkpoint of a labelgen detector")
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
    model = build_model(metadata.config, **options)
    _load_weights(model, data.get("state_dict", {}), f"checkpoint {path}")
    return model.eval(), metadata


def _load_weights(model: CcRetinaNet, state: Any, where: str) -> None:
    """Load a checkpoint's "state_dict" or a bare state dict into a model.

    Raises:
        DataError: the weights do not fit.
    """
    own = {key.removeprefix(WEIGHTS_PREFIX): value for key, value in dict(state).items()}
    try:
        model.load_state_dict(own)
    except (RuntimeError, AttributeError) as err:
        reason = " ".join(str(err).split())[:160]
        raise DataError(f"{where}: its weights are of another network ({reason})") from None
