"""Weights to start training from: checkpoints and torchvision's own files."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torchvision import models
from torchvision.models.detection import RetinaNet

from detector.model.backbone import build_backbone
from detector.model.retinanet import CcRetinaNet, ModelConfig, build_model
from detector.training.pretrained import load_pretrained
from labelgen.errors import DataError

LIGHT = ModelConfig(
    backbone="resnet18", levels=(3, 4, 5), channels=32, head_convs=1, anchor_sizes=((16.0,), (32.0,), (64.0,))
)


def model(**changes: Any) -> CcRetinaNet:
    return build_model(ModelConfig(**{**LIGHT.__dict__, **changes}))


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor], keys: list[str]) -> bool:
    assert keys
    return all(torch.equal(a[key], b[key]) for key in keys)


def test_a_checkpoint_is_taken_whole() -> None:
    before, after = model(), model()
    state = {f"model.{key}": value for key, value in before.state_dict().items()}
    assert load_pretrained(after, {"state_dict": state, "labelgen": {}}, "x") == "detector"
    assert same(before.state_dict(), after.state_dict(), list(before.state_dict()))


@pytest.mark.parametrize("backbone", ["resnet18", "mobilenet_v3_small", "efficientnet_b0"])
@pytest.mark.parametrize("norm", ["batch", "frozen"])
def test_torchvisions_file_of_the_backbone(backbone: str, norm: str) -> None:
    ours = model(backbone=backbone, trunk_norm=norm)
    pyramid = {k: v.clone() for k, v in ours.state_dict().items() if k.startswith("backbone.fpn.")}
    state = models.get_model(backbone, weights=None).state_dict()
    assert load_pretrained(ours, state, "x") == "trunk"
    plain = build_backbone(backbone, LIGHT.levels, LIGHT.channels, norm=norm).body.state_dict()
    theirs = {key.removeprefix("features."): value for key, value in state.items()}
    assert same(ours.backbone.body.state_dict(), theirs, [key for key in plain if not key.endswith("tracked")])
    assert same(ours.state_dict(), pyramid, list(pyramid))


def test_torchvisions_retinanet_gives_all_that_fits() -> None:
    ours = model()
    theirs = RetinaNet(
        build_backbone("resnet18", LIGHT.levels, LIGHT.channels), 91, anchor_generator=ours.anchor_generator
    )
    state = theirs.state_dict()
    scores = ours.head.classification_head.cls_logits.weight.clone()
    assert load_pretrained(ours, state, "x") == "torchvision RetinaNet"
    taken = [key for key in state if key.startswith("backbone.")]
    taken += ["head.classification_head.conv.0.0.weight", "head.regression_head.bbox_reg.weight"]
    assert same(ours.state_dict(), state, taken)
    # 91 classes are not one.
    assert torch.equal(ours.head.classification_head.cls_logits.weight, scores)


@pytest.mark.parametrize(
    ("state", "message"),
    [
        (lambda: models.resnet50(weights=None).state_dict(), "of another network"),
        (lambda: model(backbone="resnet34").state_dict(), "of another network"),
        (dict, r"conv1\.weight"),
        (lambda: {"state_dict": {"a": 1}}, "torchvision's file"),
    ],
)
def test_weights_that_fit_nowhere(state: Callable[[], Any], message: str) -> None:
    ours = model()
    before = {key: value.clone() for key, value in ours.state_dict().items()}
    with pytest.raises(DataError, match=message):
        load_pretrained(ours, state(), "weights x")
    assert same(ours.state_dict(), before, list(before))
