"""The detector: it learns from shards, detects vehicles in rectified pictures, and measures their speeds.

Names are imported from their modules on first use, so that `import detector` alone is quick.

Train a network:

- `find_preset`, `PRESETS`, `Preset`, `ModelConfig`, `MachineConfig`: settings.
- `train`, `TrainSummary`: shards and a preset -> checkpoints.

Detect vehicles:

- `load_detector`, `Detector`: checkpoint -> detector; labels in rectified pictures.
- `ModelMetadata`: what a checkpoint says of its network: pair, size, training data.
- `evaluate_detections`: detections and labels -> average precision, errors of c_c and of the measured point.

Measure speeds:

- `model_view`, `MeasurementView`, `Variant`: where detections lie and which point of a vehicle is measured.
- `DetectorDetections`, `Detections`: frames -> vehicles placed in time and on the road.
- `IouTracker`, `TrackRules`: detections -> tracks.
- `SpeedMeter`, `MeasureRules`, `MeasuredVehicle`: detections -> tracks and speeds.

The packages in it: `model` (network), `data` (training samples), `training`, `tracking`, `speed` (measuring),
`evaluation` (of speeds, by the public protocols).
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from detector.checkpoint import ModelMetadata
    from detector.inference import Detector, load_detector
    from detector.metrics import evaluate_detections
    from detector.model.retinanet import ModelConfig
    from detector.speed.detections import Detections
    from detector.speed.measurement import MeasurementView, Variant
    from detector.speed.meter import MeasuredVehicle, MeasureRules, SpeedMeter
    from detector.speed.model_detections import DetectorDetections, model_view
    from detector.tracking.iou_tracker import IouTracker, TrackRules
    from detector.training.config import PRESETS, MachineConfig, Preset, find_preset
    from detector.training.train import TrainSummary, train

__all__ = [
    "PRESETS",
    "Detections",
    "Detector",
    "DetectorDetections",
    "IouTracker",
    "MachineConfig",
    "MeasureRules",
    "MeasuredVehicle",
    "MeasurementView",
    "ModelConfig",
    "ModelMetadata",
    "Preset",
    "SpeedMeter",
    "TrackRules",
    "TrainSummary",
    "Variant",
    "evaluate_detections",
    "find_preset",
    "load_detector",
    "model_view",
    "train",
]

_MODULE_OF = {
    "PRESETS": "training.config",
    "Detections": "speed.detections",
    "Detector": "inference",
    "DetectorDetections": "speed.model_detections",
    "IouTracker": "tracking.iou_tracker",
    "MachineConfig": "training.config",
    "MeasureRules": "speed.meter",
    "MeasuredVehicle": "speed.meter",
    "MeasurementView": "speed.measurement",
    "ModelConfig": "model.retinanet",
    "ModelMetadata": "checkpoint",
    "Preset": "training.config",
    "SpeedMeter": "speed.meter",
    "TrackRules": "tracking.iou_tracker",
    "TrainSummary": "training.train",
    "Variant": "speed.measurement",
    "evaluate_detections": "metrics",
    "find_preset": "training.config",
    "load_detector": "inference",
    "model_view": "speed.model_detections",
    "train": "training.train",
}
"""Module, below this package, that each public name comes from."""


def __getattr__(name: str) -> Any:
    """Import a public name on first use."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
