"""Inference: the optimised paths give what the plain ones give."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from clips import CAMERA, SIZE, road_mask
from detector_shards import painted_sample

from detector.checkpoint import ModelMetadata
from detector.device import choose_device
from detector.inference import Detector, DeviceRectifier, fold_batch_norm, image_to_tensor, labels_from_output
from detector.model.retinanet import CcRetinaNet, ModelConfig, build_model
from detector.speed.model_detections import DetectorDetections, model_view
from detector.speed.variant import Variant
from labelgen.errors import LabelgenError
from labelgen.geometry import Pair, Rectification, RoadMask
from labelgen.media.frames import Frame

CONFIG = ModelConfig(
    backbone="mobilenet_v3_small",
    levels=(3, 4),
    channels=32,
    head_convs=1,
    head_norm="group",
    anchor_sizes=((16.0,), (32.0,)),
)
ROAD = RoadMask(road_mask())


def model(config: ModelConfig = CONFIG) -> CcRetinaNet:
    torch.manual_seed(0)
    network = build_model(config, score_thresh=0.01)
    # Running averages that are not those of an untrained network.
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.uniform_(-0.1, 0.1)
            module.running_var.uniform_(0.8, 1.2)
    return network.eval()


def metadata(config: ModelConfig = CONFIG) -> ModelMetadata:
    return ModelMetadata("small", Pair.VP2_VP3, (160, 96), config, 10.0, [], {})


@pytest.mark.parametrize("backbone", ["mobilenet_v3_small", "resnet18", "shufflenet_v2_x0_5"])
def test_folding_batch_normalisation_changes_nothing(backbone: str) -> None:
    config = replace(CONFIG, backbone=backbone)
    plain, folded = model(config), model(config)
    fold_batch_norm(folded)
    assert not any(isinstance(m, torch.nn.BatchNorm2d) for m in folded.backbone.body.modules())
    image = image_to_tensor(painted_sample(1).image, torch.device("cpu"))
    with torch.no_grad():
        a, b = plain([image])[0], folded([image])[0]
    assert len(a["boxes"]) > 5
    assert torch.allclose(a["boxes"], b["boxes"], atol=1e-3)
    assert torch.allclose(a["cc"], b["cc"], atol=1e-4)


def test_rectifying_on_the_device_is_opencvs() -> None:
    rectification = Rectification.from_road_mask(CAMERA, ROAD, Pair.VP2_VP3, (160, 96))
    rng = np.random.default_rng(0)
    frame = np.asarray(rng.integers(0, 255, (SIZE[1] // 8, SIZE[0] // 8, 3)), dtype=np.uint8).repeat(8, 0).repeat(8, 1)
    ours = DeviceRectifier(rectification, torch.device("cpu"))(frame)
    expected = image_to_tensor(rectification.warp_image(frame), torch.device("cpu"))
    assert ours.shape == expected.shape == (3, 96, 160)
    # Both are zero outside of the frame; on its very border they blend differently.
    assert (ours - expected).abs().quantile(0.98) < 2 / 255


def test_a_detector_is_a_source_of_detections() -> None:
    detector, view = Detector(model(), metadata(), device="cpu"), model_view(metadata(), CAMERA, ROAD)
    source = DetectorDetections(detector, view, batch=2)
    assert source.view.variant is Variant.TRANSFORM3D
    assert source.view.size_wh == (160, 96)
    rng = np.random.default_rng(0)
    frames = [Frame(n, n / 25, np.asarray(rng.integers(0, 255, (SIZE[1], SIZE[0], 3)), np.uint8)) for n in range(5)]
    out = list(source.detections(frames))
    assert [frame.number for frame, _ in out] == [0, 1, 2, 3, 4]
    assert [detections.frame for _, detections in out] == [0, 1, 2, 3, 4]
    assert any(len(detections) for _, detections in out)
    alone = list(DetectorDetections(detector, view).detections(frames[2:3]))
    np.testing.assert_allclose(alone[0][1].boxes_xyxy, out[2][1].boxes_xyxy, atol=1e-3)


def test_a_detector_gives_labels() -> None:
    detector = Detector(model(), metadata(), device="cpu")
    (labels,) = detector.detect([detector.input_of_sample(painted_sample(1))])
    assert detector.batch_size == 1
    assert len(labels) > 0
    assert (labels.scores >= 0.01).all()


def test_detections_without_an_area_are_left_out() -> None:
    """A box cut at the picture's border may be a line."""
    output = {
        "boxes": torch.tensor([[0.0, 10, 20, 30], [0.0, 10, 0, 30], [5.0, 96, 9, 96], [1.0, 2, 3, 4]]),
        "scores": torch.tensor([0.9, 0.8, 0.7, 0.6]),
        "cc": torch.tensor([0.1, 0.2, 0.3, 0.4]),
    }
    labels = labels_from_output(output, torch.zeros(4), metadata())
    assert labels.boxes_xyxy.tolist() == [[0, 10, 20, 30], [1, 2, 3, 4]]
    assert labels.cc.tolist() == output["cc"][[0, 3]].double().tolist()
    assert labels.scores.tolist() == output["scores"][[0, 3]].tolist()


def test_half_precision_is_close() -> None:
    detectors = [Detector(model(), metadata(), device="cpu", half=half) for half in (False, True)]
    full, half = (detector.detect([detector.input_of_sample(painted_sample(1))])[0] for detector in detectors)
    assert abs(float(full.scores.max() - half.scores.max())) < 0.02


@pytest.mark.parametrize(
    ("weight", "variant", "message"),
    [
        (1.0, Variant.ORIG2D, "trained on rectifications of the road; use transform3d or transform2d"),
        (0.0, Variant.TRANSFORM3D, "trained without c_c"),
    ],
)
def test_variants_a_model_cannot_do(weight: float, variant: Variant, message: str) -> None:
    config = replace(CONFIG, cc_weight=weight)
    with pytest.raises(LabelgenError, match=message):
        model_view(metadata(config), CAMERA, ROAD, variant)


def test_a_model_of_plain_frames_sees_plain_frames() -> None:
    config = replace(CONFIG, cc_weight=0.0)
    plain = replace(metadata(config), labels=[{"settings": [{"kind": "masks", "region": "none"}]}])
    view = model_view(plain, CAMERA, ROAD)
    assert view.variant is Variant.ORIG2D
    np.testing.assert_allclose(view.to_frame([[80.0, 48.0]]), [[SIZE[0] / 2, SIZE[1] / 2]])
    placed, valid = view.place(0, 0.0, [[60.0, 30.0, 100.0, 60.0]])
    assert valid.all()
    np.testing.assert_allclose(placed.contact_points_px, [[SIZE[0] / 2, 60 / 96 * SIZE[1]]])
    with pytest.raises(LabelgenError, match="trained on frames as they are; use orig2d"):
        model_view(plain, CAMERA, ROAD, Variant.TRANSFORM2D)


def test_models_without_cc_default_to_2d() -> None:
    config = replace(CONFIG, cc_weight=0.0)
    assert model_view(metadata(config), CAMERA, ROAD).variant is Variant.TRANSFORM2D


def test_a_model_sees_the_region_it_was_trained_on() -> None:
    labels = [{"settings": [{"kind": "masks", "region": "frame"}]}]
    whole = replace(metadata(), labels=labels)
    assert model_view(whole, CAMERA, ROAD).variant is Variant.PREVIOUS3D
    assert model_view(whole, CAMERA, ROAD, Variant.PREVIOUS2D).variant is Variant.PREVIOUS2D
    with pytest.raises(LabelgenError, match="rectifications of the frame; use previous3d or previous2d"):
        model_view(whole, CAMERA, ROAD, Variant.TRANSFORM3D)
    with pytest.raises(LabelgenError, match="rectifications of the road"):
        model_view(metadata(), CAMERA, ROAD, Variant.PREVIOUS3D)


def test_unknown_devices_are_named() -> None:
    with pytest.raises(LabelgenError, match="device teapot"):
        choose_device("teapot")


@pytest.mark.parametrize(("pair", "size_wh"), [(Pair.VP2_VP3, (320, 192)), (Pair.VP1_VP2, (96, 160))])
def test_a_rectification_of_another_kind_is_refused(pair: Pair, size_wh: tuple[int, int]) -> None:
    detector = Detector(model(), metadata(), device="cpu")
    other = Rectification.from_road_mask(CAMERA, ROAD, pair, size_wh)
    with pytest.raises(LabelgenError, match=r"this detector sees VP2-VP3 160x96") as caught:
        detector.rectifier(other, CAMERA)
    assert caught.value.parameters == ("rectification",)
