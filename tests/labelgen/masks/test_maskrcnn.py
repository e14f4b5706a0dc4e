"""Mask R-CNN with weights made here: no COCO weights can be had in a test."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torchvision.models.detection import maskrcnn_resnet50_fpn, maskrcnn_resnet50_fpn_v2

from labelgen.errors import DataError, LabelgenError
from labelgen.labels import VehicleClass
from labelgen.masks import create_mask_source


@pytest.fixture(scope="module")
def model() -> Any:
    """A network that sees cars and trucks in many places, with masks that have parts and holes."""
    torch.manual_seed(1)
    net = maskrcnn_resnet50_fpn(weights=None, weights_backbone=None, num_classes=91)
    classes, masks = net.roi_heads.box_predictor.cls_score, net.roi_heads.mask_predictor
    with torch.no_grad():
        classes.weight.mul_(4)
        classes.bias.fill_(-9)
        classes.bias[[3, 8]] = 0.0
        masks.mask_fcn_logits.weight.mul_(300)
        # Without this every second row and column of a random mask is another's.
        masks.conv5_mask.weight.copy_(masks.conv5_mask.weight.mean((2, 3), keepdim=True).expand(-1, -1, 2, 2))
    net.roi_heads.score_thresh = 0.3
    return net.eval()


@pytest.fixture(scope="module")
def weights(model: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path: Path = tmp_path_factory.mktemp("weights") / "v1.pt"
    torch.save(model.state_dict(), path)
    return path


@pytest.mark.slow
def test_agrees_with_torchvisions_own_pasted_masks(model: Any, weights: Path) -> None:
    blobs = np.random.default_rng(0).integers(0, 256, (4, 6, 3), dtype=np.uint8)
    image = np.asarray(cv2.resize(blobs, (240, 160), interpolation=cv2.INTER_CUBIC), dtype=np.uint8)
    source = create_mask_source("maskrcnn", weights=weights, score_threshold=0.3, device="cpu")
    ours = source.masks([image], [0], [""])[0]
    with torch.inference_mode():
        theirs = model([torch.from_numpy(image[..., ::-1].transpose(2, 0, 1).copy()).float() / 255])[0]
    # torchvision pastes masks at whole pixels, so thin ones say little.
    sides = (theirs["boxes"][:, 2:] - theirs["boxes"][:, :2]).min(dim=1).values
    keep = (sides > 12) & torch.isin(theirs["labels"], torch.tensor([3, 4, 6, 8]))
    mine = [ours.full(i) for i in range(len(ours))]
    masks = [mask for mask in theirs["masks"][keep, 0].numpy() >= 0.5 if mask.sum() > 100]
    best = [max((mask & m).sum() / (mask | m).sum() for m in mine) for mask in masks]
    assert len(best) > 8
    assert np.median(best) > 0.85
    assert set(ours.class_ids.tolist()) <= {VehicleClass.CAR, VehicleClass.TRUCK}
    assert (ours.scores >= 0.3).all()
    assert source.masks([]) == []


@pytest.mark.slow
def test_second_version_is_recognised_by_its_keys(tmp_path: Path) -> None:
    net = maskrcnn_resnet50_fpn_v2(weights=None, weights_backbone=None, num_classes=91)
    torch.save({"state_dict": {f"module.{k}": v for k, v in net.state_dict().items()}}, tmp_path / "v2.pt")
    source = create_mask_source("maskrcnn", weights=tmp_path / "v2.pt", device="cpu")
    assert source.masks([np.zeros((32, 32, 3), dtype=np.uint8)])[0].frame_wh == (32, 32)


class Payload:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.path),)


@pytest.mark.slow
def test_files_of_the_wrong_kind_are_refused(model: Any, tmp_path: Path) -> None:
    state = dict(model.state_dict())
    cut = {k: v for k, v in state.items() if not k.startswith("rpn.")} | {"extra.weight": torch.zeros(1)}
    small = state | {"roi_heads.box_predictor.cls_score.weight": torch.zeros(5, 1024)}
    cases: dict[str, tuple[Any, str]] = {
        "cut": (cut, r"6 keys missing \(such as rpn\..*1 unexpected \(such as extra.weight\)"),
        "classes": (small, r"with 91 classes: 1 of another shape \(such as roi_heads.box_predictor.cls_score.weight\)"),
        "list": ([torch.zeros(1)], "not a state dict"),
        "evil": ({"x": Payload(tmp_path / "ran")}, "not a whole file of PyTorch tensors"),
    }
    for name, (content, message) in cases.items():
        torch.save(content, tmp_path / f"{name}.pt")
        with pytest.raises(DataError, match=message) as caught:
            create_mask_source("maskrcnn", weights=tmp_path / f"{name}.pt", device="cpu")
        assert "\n" not in str(caught.value)
    assert not (tmp_path / "ran").exists()
    (tmp_path / "text.pt").write_text("hello")
    for name, message in (("text", "not a whole file of PyTorch tensors"), ("none", "No such file")):
        with pytest.raises(DataError, match=message):
            create_mask_source("maskrcnn", weights=tmp_path / f"{name}.pt", device="cpu")


def test_no_download_names_the_alternatives(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    # A proxy that is not there, so that the machine's own network does not matter.
    for variable in ("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY"):
        monkeypatch.setenv(variable, "http://127.0.0.1:9")
    with pytest.raises(
        LabelgenError, match=r"as weights, or use masks .*\(onnx:yolo11n-seg.onnx, background\)"
    ) as caught:
        create_mask_source("maskrcnn")
    assert "\n" not in str(caught.value)


def test_unusable_device_is_refused(weights: Path) -> None:
    with pytest.raises(LabelgenError, match="device warp9: unknown; use one of auto, cpu, gpu"):
        create_mask_source("maskrcnn", weights=weights, device="warp9")
