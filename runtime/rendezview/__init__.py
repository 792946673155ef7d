"""The public interface: everything a user needs, under one name.

    from rendezview import Recognizer, Tracker, ViewModel, load_camera

Nothing is imported before it is used, so ``import rendezview`` is quick. The names of the ground
side (`train`, `simulate`, `evaluate`, ...) and the service's `Client` need their extras only when
they are used.
"""

from __future__ import annotations

import importlib
from importlib import metadata
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rendezview.errors import RendezviewError
    from rendezview.fusion import Fusion, FusionOptions
    from rendezview.geometry.camera import Camera
    from rendezview.geometry.pose import Pose
    from rendezview.io.bundled import find_target
    from rendezview.io.camera_files import load_camera, save_camera
    from rendezview.io.results import (
        JsonLinesWriter,
        ResultRow,
        read_json_lines,
        read_results,
        write_results,
    )
    from rendezview.io.sequences import Frame, Sequence, open_sequence
    from rendezview.io.target import DockingRing, Target
    from rendezview.sensors.appearance import Recognizer, Tracker, TrackerOptions, ViewModel
    from rendezview.sensors.beacons import LitDark, ReflectorSensor, Rig, StereoTracker, patterns_of
    from rendezview.sensors.beacons.rig_files import load_rig
    from rendezview.sensors.beam import BeamMesh, BeamSurface
    from rendezview.sensors.measurement import RangeMeasurement
    from rendezview.sensors.observation import Observation, Status
    from rendezview.sensors.ring import RingPrior, RingSensor
    from rendezview_ground.evaluate import evaluate, frame_overlay, write_report
    from rendezview_ground.learn.options import TrainingOptions
    from rendezview_ground.learn.target_job import train
    from rendezview_ground.mesh.mesh import load_mesh
    from rendezview_ground.simulate import simulate
    from rendezview_service.client import Client

__all__ = [
    "BeamMesh",
    "BeamSurface",
    "Camera",
    "Client",
    "DockingRing",
    "Frame",
    "Fusion",
    "FusionOptions",
    "JsonLinesWriter",
    "LitDark",
    "Observation",
    "Pose",
    "RangeMeasurement",
    "Recognizer",
    "ReflectorSensor",
    "RendezviewError",
    "ResultRow",
    "Rig",
    "RingPrior",
    "RingSensor",
    "Sequence",
    "Status",
    "StereoTracker",
    "Target",
    "Tracker",
    "TrackerOptions",
    "TrainingOptions",
    "ViewModel",
    "evaluate",
    "find_target",
    "frame_overlay",
    "load_camera",
    "load_mesh",
    "load_rig",
    "open_sequence",
    "patterns_of",
    "read_json_lines",
    "read_results",
    "save_camera",
    "simulate",
    "train",
    "write_report",
    "write_results",
]

# Where each name lives.
_MODULE = {
    name: module
    for module, names in {
        "rendezview.errors": ("RendezviewError",),
        "rendezview.fusion": ("Fusion", "FusionOptions"),
        "rendezview.geometry.camera": ("Camera",),
        "rendezview.geometry.pose": ("Pose",),
        "rendezview.io.bundled": ("find_target",),
        "rendezview.io.camera_files": ("load_camera", "save_camera"),
        "rendezview.io.results": (
            "JsonLinesWriter",
            "ResultRow",
            "read_json_lines",
            "read_results",
            "write_results",
        ),
        "rendezview.io.sequences": ("Frame", "Sequence", "open_sequence"),
        "rendezview.io.target": ("DockingRing", "Target"),
        "rendezview.sensors.appearance": ("Recognizer", "Tracker", "TrackerOptions", "ViewModel"),
        "rendezview.sensors.beacons": (
            "LitDark",
            "ReflectorSensor",
            "Rig",
            "StereoTracker",
            "patterns_of",
        ),
        "rendezview.sensors.beacons.rig_files": ("load_rig",),
        "rendezview.sensors.beam": ("BeamMesh", "BeamSurface"),
        "rendezview.sensors.measurement": ("RangeMeasurement",),
        "rendezview.sensors.observation": ("Observation", "Status"),
        "rendezview.sensors.ring": ("RingPrior", "RingSensor"),
        "rendezview_ground.evaluate": ("evaluate", "frame_overlay", "write_report"),
        "rendezview_ground.learn.options": ("TrainingOptions",),
        "rendezview_ground.learn.target_job": ("train",),
        "rendezview_ground.mesh.mesh": ("load_mesh",),
        "rendezview_ground.simulate": ("simulate",),
        "rendezview_service.client": ("Client",),
    }.items()
    for name in names
}
_EXTRAS = {"rendezview_ground": "training", "rendezview_service": "service"}


def __getattr__(name: str) -> Any:
    """Import a name on its first use (PEP 562)."""
    if name == "__version__":
        value: Any = metadata.version("rendezview")
    elif name in _MODULE:
        value = _imported(name, _MODULE[name])
    else:
        raise AttributeError(f"module 'rendezview' has no attribute {name!r}")
    globals()[name] = value
    return value


def _imported(name: str, module: str) -> Any:
    try:
        return getattr(importlib.import_module(module), name)
    except RuntimeError as error:
        from rendezview.errors import without_cache

        words = without_cache(error)
        if words is None:
            raise
        raise words from error
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        extra = _EXTRAS.get(module.partition(".")[0])
        if extra is None or package in ("rendezview", *_EXTRAS):
            raise
        from rendezview.errors import RendezviewError

        raise RendezviewError(
            f"rendezview.{name} needs {error.name}: pip install 'rendezview[{extra}]'"
        ) from error


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
