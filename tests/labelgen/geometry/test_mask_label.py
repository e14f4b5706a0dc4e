"""Labels from masks: analytic cases, and what must hold for any mask."""

from __future__ import annotations

import numpy as np
import pytest

from labelgen.geometry import Outline, Rule, label_outlines, mask_outline, rectified_outline


@pytest.mark.parametrize("rule", list(Rule))
def test_cc_stays_in_its_range(rule):
    # Weighting two candidates that both lie on the box's edge must not leave it by a rounding error:
    # `Labels` would refuse the whole image.
    rng = np.random.default_rng(0)
    low = np.floor(rng.uniform(0, 300, (5000, 2)))
    high = low + rng.integers(2, 60, (5000, 2))
    outlines = [
        Outline(np.array([*a, *b]), np.array([a + 0.5, [b[0] - 0.5, a[1] + 0.5], b - 0.5, [a[0] + 0.5, b[1] - 0.5]]), 1)
        for a, b in zip(low, high, strict=True)
    ]
    for vpu in ((-200.3, 700.1), (150.7, 612.9), (640.1, -80.5), (120.2, -55.5)):
        labels = label_outlines(outlines, vpu, rule)
        assert labels.valid.all()
        assert labels.cc.min() >= 0
        assert labels.cc.max() <= 1


def test_rule_by_its_name_is_that_rule():
    outlines = [mask_outline(np.tri(50, dtype=bool))]
    by_name = {str(rule): label_outlines(outlines, (10, -50), rule.value).cc[0] for rule in Rule}
    by_rule = {str(rule): label_outlines(outlines, (10, -50), rule).cc[0] for rule in Rule}
    assert by_name == by_rule
    assert by_rule["wider"] != by_rule["conditioned"]
    with pytest.raises(ValueError, match="narrower"):
        label_outlines(outlines, (10, -50), "narrower")


@pytest.mark.parametrize(
    "mask",
    [
        np.full((4, 5), True),
        np.full((4, 5), 255, np.uint8),
        np.full((4, 5), 256, np.uint16),
        np.full((4, 5), 0.6),
        np.full((4, 5), -1, np.int32),
        np.full((10, 8), True)[::-2, :5][:4],
        np.full((5, 4), True).T,
    ],
    ids=lambda m: str(m.dtype),
)
def test_any_nonzero_value_is_set(mask, rectification):
    outline = mask_outline(mask, (10, 20))
    np.testing.assert_array_equal(outline.box_xyxy, [10, 20, 15, 24])
    assert outline.area_px2 == 20
    small = rectified_outline(rectification, mask, (300, 200))
    full = rectified_outline(rectification, np.full((4, 5), True), (300, 200))
    np.testing.assert_array_equal(small.box_xyxy, full.box_xyxy)
