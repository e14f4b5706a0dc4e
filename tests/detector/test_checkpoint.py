"""Checkpoints: the layout on disk stays readable, and everything else is refused."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from torchvision.models import resnet18

from detector.checkpoint import load_model, read_checkpoint
from detector.inference import load_detector
from labelgen.errors import DataError
from labelgen.geometry import Pair, Region


def metadata() -> dict[str, Any]:
    """What stands under "labelgen" in a checkpoint of format version 1, key by key."""
    ranges = {"translation": 0.15, "scale": (0.8, 1.5), "aspect": 1.2, "flip": 0.5, "light": 0.25}
    return {
        "format": "labelgen-detector",
        "version": 1,
        "producer": "labelgen 0.1.0",
        "preset": "small",
        "pair": "VP2-VP3",
        "size_wh": (96, 64),
        "min_height_px": 10.0,
        "config": {
            "backbone": "resnet18",
            "levels": (3, 4, 5),
            "channels": 16,
            "head_convs": 1,
            "head_norm": "group",
            "trunk_norm": "batch",
            "anchor_sizes": ((16.0,), (32.0,), (64.0,)),
            "anchor_ratios": (1.0,),
            "cc_weight": 3.0,
            "beta": 0.02,
            "size_weight": 1.0,
            "low_quality_matches": True,
        },
        "labels": [
            {
                "samples": 198, "weight": 198.0, "producers": ["labelgen 0.1.0"], "sha256": ["a61901ac"],
                "settings": [{"kind": "masks", "masks": "coco", "region": "frame", "min_height_px": 10.0}],
            }
        ],
        "training": {
            "seed": 0, "batch": 2, "epochs": 1, "steps_per_epoch": 6, "optimiser": "adamw", "lr": 0.002,
            "clip_norm": 5.0, "schedule": "cosine", "whole": ranges, "crops": ranges,
        },
    }  # fmt: skip


def weights() -> dict[str, torch.Tensor]:
    """Weights by their names in a checkpoint; every anchor is a vehicle with score sigmoid(2) and c_c 0.25."""
    torch.manual_seed(0)
    body = {k: v for k, v in resnet18(weights=None).state_dict().items() if not k.startswith("fc.")}
    state = {f"model.backbone.body.{key}": value for key, value in body.items()}
    for i, channels in enumerate((128, 256, 512)):
        state[f"model.backbone.fpn.inner_blocks.{i}.0.weight"] = torch.randn(16, channels, 1, 1)
        state[f"model.backbone.fpn.layer_blocks.{i}.0.weight"] = torch.randn(16, 16, 3, 3)
        state[f"model.backbone.fpn.inner_blocks.{i}.0.bias"] = torch.zeros(16)
        state[f"model.backbone.fpn.layer_blocks.{i}.0.bias"] = torch.zeros(16)
    for head in ("classification_head", "regression_head"):
        state[f"model.head.{head}.conv.0.0.weight"] = torch.randn(16, 16, 3, 3)
        state[f"model.head.{head}.conv.0.1.weight"] = torch.ones(16)
        state[f"model.head.{head}.conv.0.1.bias"] = torch.zeros(16)
    for name, bias in (
        ("classification_head.cls_logits", [2.0]),
        ("regression_head.bbox_reg", [0.0, 0.0, 0.0, 0.0]),
        ("regression_head.cc", [0.25, 0.0, 0.0]),
    ):
        state[f"model.head.{name}.weight"] = torch.zeros(len(bias), 16, 3, 3)
        state[f"model.head.{name}.bias"] = torch.tensor(bias)
    return state


def checkpoint(folder: Path, **changes: Any) -> Path:
    """A checkpoint of format version 1, as Lightning wrote it."""
    data = {
        "epoch": 0, "global_step": 6, "pytorch-lightning_version": "2.6.0", "loops": {}, "callbacks": {},
        "optimizer_states": [], "lr_schedulers": [], "state_dict": weights(), "labelgen": metadata(),
    }  # fmt: skip
    path = folder / "last.ckpt"
    torch.save({**data, **changes}, path)
    return path


def test_a_checkpoint_of_format_1_is_read(tmp_path: Path) -> None:
    model, loaded = load_model(checkpoint(tmp_path), score_thresh=0.1)
    assert (loaded.preset, loaded.pair, loaded.size_wh) == ("small", Pair.VP2_VP3, (96, 64))
    assert (loaded.min_height_px, loaded.region, loaded.producer) == (10.0, Region.FRAME, "labelgen 0.1.0")
    assert loaded.to_dict() == metadata()
    assert not model.training
    with torch.no_grad():
        (output,) = model([torch.rand(3, 64, 96)])
    assert len(output["boxes"]) > 0
    assert output["scores"].tolist() == pytest.approx([1 / (1 + math.exp(-2))] * len(output["scores"]), rel=1e-5)
    assert output["cc"].tolist() == pytest.approx([0.25] * len(output["cc"]))
    assert output["sizes"].abs().max() == 0


def test_a_detector_is_loaded_from_it(tmp_path: Path) -> None:
    detector = load_detector(checkpoint(tmp_path), device="cpu")
    assert detector.metadata.to_dict() == metadata()
    assert detector.device == torch.device("cpu")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"labelgen": None}, "not a checkpoint of a labelgen detector"),
        ({"labelgen": {**metadata(), "version": 2}}, "checkpoint format 2, this labelgen reads 1"),
        ({"labelgen": {**metadata(), "pair": "VP7"}}, "damaged metadata"),
        ({"labelgen": {**metadata(), "config": {"trunk": "resnet18"}}}, "damaged metadata"),
        ({"state_dict": {}}, "its weights are of another network"),
    ],
)
def test_what_is_no_checkpoint_of_a_detector_is_refused(tmp_path: Path, changes: Any, message: str) -> None:
    with pytest.raises(DataError, match=message):
        load_model(checkpoint(tmp_path, **changes))


def test_a_checkpoint_with_code_inside_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bad.ckpt"
    torch.save({"labelgen": Path("x"), "hook": print}, path)
    with pytest.raises(DataError, match=r"not a whole file of PyTorch tensors.*it asks for .*not data"):
        read_checkpoint(path)
    path.write_bytes(b"nonsense")
    with pytest.raises(DataError, match=r"bad\.ckpt"):
        load_model(path)
