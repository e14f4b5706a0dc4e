"""What `import labelgen` and `import detector` offer, and what they cost."""

from __future__ import annotations

import subprocess
import sys

import pytest

import detector
import labelgen

LABELGEN = {
    "Camera", "Flag", "IgnoreReason", "IgnoredBoxes", "InstanceMasks", "LabelgenError", "Labels", "Pair",
    "Rectification", "Region", "RoadMask", "Rule", "Sample", "ShardDataset", "ShardReader", "ShardWriter", "Split",
    "VehicleClass", "create_mask_source", "decode_boxes", "encode_boxes", "find_scene", "label_masks",
    "open_frames", "road_cuboids", "__version__",
}  # fmt: skip


def test_public_names() -> None:
    """Names that users may rely on: adding one is a decision, losing one breaks somebody."""
    assert set(labelgen.__all__) == LABELGEN


@pytest.mark.parametrize("package", [labelgen, detector])
def test_every_public_name_is_there_and_listed(package) -> None:
    assert len(package.__all__) > 5
    for name in package.__all__:
        assert getattr(package, name) is not None
        assert name in dir(package)
    with pytest.raises(AttributeError, match="nonsense"):
        package.nonsense  # noqa: B018


@pytest.mark.parametrize("module", ["labelgen", "labelgen.cli", "labelgen.cli.main", "detector"])
def test_importing_is_light(module: str) -> None:
    code = f"import sys, {module}; print([m for m in ('numpy', 'cv2', 'h5py', 'shapely', 'torch') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
