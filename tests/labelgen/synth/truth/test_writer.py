"""Run-length encoding of masks in COCO's form."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pycocotools import mask as coco

from labelgen.synth.truth.writer import encode_mask

pytestmark = pytest.mark.slow


@settings(max_examples=60, deadline=None)
@given(
    st.integers(1, 12), st.integers(1, 12), st.integers(0, 5), st.integers(0, 5), st.booleans(), st.integers(0, 1 << 30)
)
def test_run_lengths_are_those_of_pycocotools(h: int, w: int, x: int, y: int, fits: bool, seed: int) -> None:
    part = np.random.default_rng(seed).random((h, w)) < 0.6
    size = (x + w, y + h) if fits else (x + w + 3, y + h + 2)
    whole = np.zeros(size[::-1], dtype=np.uint8, order="F")
    whole[y : y + h, x : x + w] = part
    expected = coco.encode(whole)["counts"].decode()
    assert encode_mask(part, (x, y), size)["counts"] == expected
