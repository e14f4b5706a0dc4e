"""The network: equal to torchvision's where it should be, and its loss against hand-computed cases."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torchvision.models.detection import RetinaNet

from detector.model.retinanet import CcHead, CcRetinaNet, ModelConfig, build_model
from labelgen.errors import LabelgenError

LIGHT = ModelConfig(
    backbone="resnet18",
    levels=(3, 4, 5),
    channels=32,
    head_convs=1,
    anchor_sizes=((16.0,), (32.0,), (64.0,)),
    anchor_ratios=(0.5, 1.0),
)


def seeded(config: ModelConfig, **options: float) -> CcRetinaNet:
    torch.manual_seed(0)
    return build_model(config, **options)


def focal(logit: float, positive: bool) -> float:
    """Focal loss of one anchor, alpha 0.25 and gamma 2, from its definition."""
    p = 1 / (1 + math.exp(-logit))
    return -0.25 * (1 - p) ** 2 * math.log(p) if positive else -0.75 * p**2 * math.log(1 - p)


def smooth_l1(error: float) -> float:
    """Smooth L1 with sigma 3, from its definition."""
    return 0.5 * 9 * error**2 if abs(error) < 1 / 9 else abs(error) - 0.5 / 9


# -- the same as torchvision --------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("convs", [1, 4])
def test_detections_are_torchvisions_on_the_same_weights(convs: int) -> None:
    model = seeded(replace(LIGHT, channels=64, head_convs=convs, cc_weight=0.0), score_thresh=0.005).eval()
    plain = RetinaNet(model.backbone, 1, anchor_generator=model.anchor_generator, score_thresh=0.005)
    plain.transform = model.transform
    for head in (plain.head.classification_head, plain.head.regression_head):
        head.conv = head.conv[:convs]
    state = {key: value for key, value in model.state_dict().items() if ".regression_head.cc." not in key}
    plain.load_state_dict(state)
    images = [torch.rand(3, 96, 160), torch.rand(3, 90, 120)]
    with torch.no_grad():
        detections, expected = model(images), plain.eval()(images)
    for ours, theirs in zip(detections, expected, strict=True):
        assert len(theirs["boxes"]) > 10
        for key, value in theirs.items():
            assert torch.equal(ours[key], value)


@pytest.mark.slow
def test_full_size_default_is_torchvisions_architecture() -> None:
    ours = build_model(ModelConfig(), weights="none").state_dict()
    from torchvision.models.detection import retinanet_resnet50_fpn

    theirs = retinanet_resnet50_fpn(weights=None, weights_backbone=None, num_classes=1).state_dict()
    shapes = {key: value.shape for key, value in ours.items() if "regression_head.cc" not in key}
    assert shapes == {key: value.shape for key, value in theirs.items()}


def test_image_size_is_kept() -> None:
    model = seeded(LIGHT)
    images, _ = model.transform([torch.rand(3, 90, 150)])
    assert images.image_sizes == [(90, 150)]
    assert images.tensors.shape == (1, 3, 96, 160)


# -- the loss ----------------------------------------------------------------------------------------

ANCHORS = torch.tensor([[0.0, 0, 10, 10], [20, 0, 30, 10], [0, 20, 10, 30], [20, 20, 30, 30]])


def head_and_outputs() -> tuple[CcHead, dict[str, torch.Tensor]]:
    head = CcHead(8, 1)
    outputs = {
        "cls_logits": torch.tensor([[[2.0], [-1.0], [0.5], [0.0]]]),
        "bbox_regression": torch.zeros(1, 4, 4),
        "cc": torch.tensor([[0.30, 0.9, 0.9, 0.9]]),
    }
    return head, outputs


def target(boxes: list[list[float]], cc: list[float], known: list[bool] | None = None) -> dict[str, torch.Tensor]:
    return {
        "boxes": torch.tensor(boxes),
        "labels": torch.zeros(len(boxes), dtype=torch.int64),
        "cc": torch.tensor(cc),
        "cc_known": torch.tensor(known or [True] * len(boxes)),
    }


def test_loss_of_a_hand_computed_case() -> None:
    head, outputs = head_and_outputs()
    # Anchor 0 positive, 1 and 3 negative, 2 neither. The label is the anchor moved right by 1 px: dx = 0.1.
    losses = head.compute_loss(
        [target([[1.0, 0, 11, 10]], [0.35])], outputs, [ANCHORS], [torch.tensor([0, -1, -2, -1])]
    )
    assert losses["conf"].item() == pytest.approx(focal(2.0, True) + focal(-1.0, False) + focal(0.0, False), rel=1e-5)
    assert losses["loc"].item() == pytest.approx(smooth_l1(0.1), rel=1e-5)
    assert losses["cc"].item() == pytest.approx(smooth_l1(0.05), rel=1e-5)


def test_loss_is_divided_by_the_positive_anchors_of_the_batch() -> None:
    head, outputs = head_and_outputs()
    two = {key: torch.cat([value, value]) for key, value in outputs.items()}
    labels = [target([[0.0, 0, 10, 10]], [0.8]), target([[0.0, 0, 10, 10], [20.0, 0, 30, 10]], [0.8, 0.9])]
    matched = [torch.tensor([0, -1, -1, -1]), torch.tensor([0, 1, -1, -1])]
    losses = head.compute_loss(labels, two, [ANCHORS, ANCHORS], matched)
    assert losses["cc"].item() == pytest.approx(2 * smooth_l1(0.5) / 3, rel=1e-5)
    empty = [target([[0.0, 0, 1, 1]], [0.5])] * 2
    nothing = head.compute_loss(empty, two, [ANCHORS, ANCHORS], [torch.full((4,), -1)] * 2)
    assert nothing["cc"] == 0
    assert nothing["loc"] == 0
    assert torch.isfinite(nothing["conf"])


def test_unknown_cc_is_left_out_of_its_term_alone() -> None:
    head, outputs = head_and_outputs()
    labels = target([[0.0, 0, 10, 10], [20.0, 0, 30, 10]], [0.0, 0.4], [False, True])
    losses = head.compute_loss([labels], outputs, [ANCHORS], [torch.tensor([0, 1, -1, -1])])
    assert losses["cc"].item() == pytest.approx(smooth_l1(0.5) / 2, rel=1e-5)
    assert losses["conf"].item() * 2 == pytest.approx(
        focal(2.0, True) + focal(-1.0, True) + focal(0.5, False) + focal(0.0, False), rel=1e-5
    )


@pytest.mark.parametrize(
    ("ignored", "left_out"),
    [
        ([], []),
        ([[18.0, 18, 40, 40]], [3]),
        ([[20.0, 0, 25, 10]], [1]),  # half of anchor 1
        ([[20.0, 0, 24, 10]], []),
        ([[20.0, 0, 24, 10], [24.0, 0, 28, 10]], []),  # each box alone counts
        ([[0.0, 0, 100, 100]], [1, 3]),  # the positive anchor stays positive
    ],
)
def test_negative_anchors_in_ignored_boxes_are_not_counted(ignored: list[list[float]], left_out: list[int]) -> None:
    head, outputs = head_and_outputs()
    labels = {**target([[0.0, 0, 10, 10]], [0.35]), "ignored": torch.tensor(ignored).reshape(-1, 4)}
    losses = head.compute_loss([labels], outputs, [ANCHORS], [torch.tensor([0, -1, -2, -1])])
    terms = {0: focal(2.0, True), 1: focal(-1.0, False), 3: focal(0.0, False)}
    assert losses["conf"].item() == pytest.approx(sum(v for k, v in terms.items() if k not in left_out), rel=1e-5)
    assert losses["cc"].item() == pytest.approx(smooth_l1(0.05), rel=1e-5)


def test_ignored_boxes_of_a_picture_without_labels_reach_the_loss() -> None:
    model = seeded(LIGHT).train()
    image = torch.rand(3, 96, 160)
    empty = {"boxes": torch.empty(0, 4), "labels": torch.empty(0, dtype=torch.int64), "cc": torch.empty(0)}
    empty |= {"cc_known": torch.empty(0, dtype=torch.bool)}
    whole = torch.tensor([[-500.0, -500, 800, 800]])
    with torch.no_grad():
        plain = model([image], [empty])["conf"].item()
        ignored = model([image], [{**empty, "ignored": whole}])["conf"].item()
    assert plain > 0
    assert ignored == 0


def test_cc_weight_scales_the_term() -> None:
    _, outputs = head_and_outputs()
    arguments = ([target([[0.0, 0, 10, 10]], [0.8])], outputs, [ANCHORS], [torch.tensor([0, -1, -1, -1])])
    full, half = (CcHead(8, 1, cc_weight=w).compute_loss(*arguments) for w in (1.0, 0.5))
    assert half["cc"].item() == pytest.approx(full["cc"].item() / 2)
    assert half["loc"] == full["loc"]


def test_gradients_reach_cc_through_positive_anchors_alone() -> None:
    head, outputs = head_and_outputs()
    outputs["cc"].requires_grad_()
    losses = head.compute_loss([target([[0.0, 0, 10, 10]], [0.8])], outputs, [ANCHORS], [torch.tensor([-1, -2, 0, -1])])
    sum(losses.values()).backward()
    assert (outputs["cc"].grad != 0).tolist() == [[False, False, True, False]]


@pytest.mark.slow
# IoU of a 10x10 label with an anchor of the same shape shifted right by d is (10 - d) / (10 + d).
@pytest.mark.parametrize(
    ("shift", "kind"), [(3.3, "positive"), (3.4, "neither"), (4.2, "neither"), (4.4, "negative"), (20.0, "negative")]
)
def test_matching_thresholds(shift: float, kind: str) -> None:
    model = seeded(replace(LIGHT, low_quality_matches=False))
    matches = {}
    model.head.compute_loss = lambda t, o, a, matched: matches.update(matched=matched[0])  # type: ignore[method-assign]
    model.compute_loss([target([[0.0, 0, 10, 10]], [0.5])], {}, [torch.tensor([[shift, 0.0, shift + 10, 10]])])
    assert matches["matched"].tolist() == [{"positive": 0, "neither": -2, "negative": -1}[kind]]


def test_low_quality_matches_keep_a_label_without_a_good_anchor() -> None:
    model = seeded(replace(LIGHT, low_quality_matches=True))
    matches = {}
    model.head.compute_loss = lambda t, o, a, matched: matches.update(matched=matched[0])  # type: ignore[method-assign]
    anchors = torch.tensor([[6.0, 0, 16, 10], [8.0, 0, 18, 10]])
    model.compute_loss([target([[0.0, 0, 10, 10]], [0.5])], {}, [anchors])
    assert matches["matched"].tolist() == [0, -1]


# -- after the network --------------------------------------------------------------------------------


def test_cc_stays_with_its_box_through_thresholds_and_suppression() -> None:
    model = seeded(LIGHT, score_thresh=0.3)
    anchors = torch.tensor([[0.0, 0, 10, 10], [1.0, 0, 11, 10], [40.0, 40, 60, 60], [5.0, 50, 15, 60]])
    outputs = {
        "cls_logits": [torch.tensor([[[1.0], [2.0], [0.0], [-3.0]]])],
        "bbox_regression": [torch.zeros(1, 4, 4)],
        "cc": [torch.tensor([[0.1, 0.2, 1.3, 0.4]])],
    }
    (detections,) = model.postprocess_detections(outputs, [[anchors]], [(100, 100)])
    # The second suppresses the first, the last is too weak, and 1.3 is no share.
    assert detections["boxes"].tolist() == [[1.0, 0, 11, 10], [40.0, 40, 60, 60]]
    assert detections["cc"].tolist() == pytest.approx([0.2, 1.0])


@pytest.mark.parametrize("name", ["resnet18", "mobilenet_v3_large", "mobilenet_v3_small", "shufflenet_v2_x0_5"])
def test_backbones_by_name(name: str) -> None:
    model = seeded(replace(LIGHT, backbone=name)).eval()
    features = model.backbone(torch.zeros(1, 3, 64, 96))
    assert [tuple(f.shape) for f in features.values()] == [(1, 32, 8, 12), (1, 32, 4, 6), (1, 32, 2, 3)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"backbone": "resnet19"}, "no such network"),
        ({"backbone": "resnet18", "levels": (3, 5)}, "no pyramid of the levels"),
        ({"backbone": "vit_b_16"}, "backbone vit_b_16"),
    ],
)
def test_impossible_backbones_are_named(changes: dict[str, object], message: str) -> None:
    with pytest.raises(LabelgenError, match=message):
        build_model(replace(LIGHT, **changes))


def test_half_precision_leaves_boxes_precise() -> None:
    """Anchors and boxes in bfloat16 would lie on whole or even pixels."""
    model = seeded(LIGHT, score_thresh=0.0).eval()
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        (detections,) = model([torch.rand(3, 270, 480)])
    assert {value.dtype for key, value in detections.items() if key != "labels"} == {torch.float32}
    far = detections["boxes"][:, 0] > 256
    assert far.any()
    assert (detections["boxes"][far, 0] % 2).unique().numel() > 10
