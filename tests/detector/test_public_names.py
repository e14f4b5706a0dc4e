"""What `import detector` offers, and that it loads nothing before it is used."""

from __future__ import annotations

import subprocess
import sys
from inspect import getdoc
from pathlib import Path
from textwrap import dedent
from typing import Any

import pytest
import torch
from clips import write_clip

import detector
from detector.checkpoint import METADATA_KEY, ModelMetadata
from detector.model.retinanet import ModelConfig, build_model
from labelgen.geometry import Pair

REPOSITORY = Path(__file__).resolve().parents[2]


def test_public_names_are_these() -> None:
    """A name that is added or renamed is changed here, in the docstring of `detector`, and in the changelog."""
    assert sorted(detector.__all__) == [
        "Detections", "Detector", "DetectorDetections", "IouTracker", "MachineConfig", "MeasureRules",
        "MeasuredVehicle", "MeasurementView", "ModelConfig", "ModelMetadata", "PRESETS", "Preset", "SpeedMeter",
        "TrackRules", "TrainSummary", "Variant", "evaluate_detections", "find_preset", "load_detector", "model_view",
        "train",
    ]  # fmt: skip
    assert set(detector._ROOM_OF) == set(detector.__all__)


@pytest.mark.parametrize("name", detector.__all__)
def test_every_public_name_is_there_and_documented(name: str) -> None:
    value = getattr(detector, name)
    if name == "PRESETS":
        assert "small" in value
    else:
        assert value.__name__ == name
        assert getdoc(value)
    assert f"`{name}`" in str(detector.__doc__)
    assert name in dir(detector)


def test_the_example_of_the_docstring_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a short clip, with a network that has learnt nothing."""
    write_clip(tmp_path, 3, name="video.mp4", coco=False)
    config = ModelConfig(
        backbone="mobilenet_v3_small", levels=(3, 4), channels=16, head_convs=1, anchor_sizes=((32.0,), (64.0,))
    )
    metadata = ModelMetadata("small", Pair.VP2_VP3, (160, 96), config, 10.0, [], {})
    (tmp_path / "run").mkdir()
    torch.save(
        {"state_dict": build_model(config).state_dict(), METADATA_KEY: metadata.to_dict()},
        tmp_path / "run" / "last.ckpt",
    )
    monkeypatch.chdir(tmp_path)
    lines = str(detector.__doc__).splitlines()
    example = dedent("\n".join(line for line in lines if line.startswith("    ")))
    names: dict[str, Any] = {}
    exec(example, names)
    assert names["detections"].frame == 2
    assert names["vehicles"] == []


def test_unknown_names_are_attribute_errors() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'Detektor'"):
        _ = detector.Detektor  # type: ignore[attr-defined]


def test_importing_the_package_loads_nothing() -> None:
    code = "import sys, detector; print(sorted({'torch', 'cv2', 'numpy', 'labelgen'} & set(sys.modules)))"
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=True, timeout=60
    )
    assert result.stdout.strip() == "[]"
