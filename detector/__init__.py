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

Speeds of the vehicles in a video, with its calibration and road mask beside it:

    from pathlib import Path

    from detector import DetectorDetections, SpeedMeter, load_detector, model_view
    from labelgen import find_scene

    scene = find_scene(Path("video.mp4")).open()
    detector = load_detector("run/last.ckpt", score=0.3)
    view = model_view(detector.metadata, scene.camera, scene.road)
    meter, vehicles = SpeedMeter(scene.camera, fps=scene.frames.fps), []
    for frame, detections in DetectorDetections(detector, view).stream(scene.frames):
        vehicles += meter.add(detections)[1]
    vehicles += meter.finish()

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
    from detector.speed.meter import MeasureRules, SpeedMeter
    from detector.speed.model_detections import DetectorDetections, model_view
    from detector.speed.track_speed import MeasuredVehicle
    from detector.speed.variant import Variant
    from detector.speed.view import MeasurementView
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

_ROOMS = {
    "detector.checkpoint": ("ModelMetadata",),
    "detector.inference": ("Detector", "load_detector"),
    "detector.metrics": ("evaluate_detections",),
    "detector.model.retinanet": ("ModelConfig",),
    "detector.speed.detections": ("Detections",),
    "detector.speed.track_speed": ("MeasuredVehicle",),
    "detector.speed.view": ("MeasurementView",),
    "detector.speed.meter": ("MeasureRules", "SpeedMeter"),
    "detector.speed.model_detections": ("DetectorDetections", "model_view"),
    "detector.speed.variant": ("Variant",),
    "detector.tracking.iou_tracker": ("IouTracker", "TrackRules"),
    "detector.training.config": ("PRESETS", "MachineConfig", "Preset", "find_preset"),
    "detector.training.train": ("TrainSummary", "train"),
}
_ROOM_OF = {name: room for room, names in _ROOMS.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _ROOM_OF:
        raise AttributeError(f"module 'detector' has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_ROOM_OF[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
