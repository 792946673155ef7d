"""The public interface: everything a user needs, under one name.

    from rendezview.api import Recognizer, Tracker, ViewModel, load_camera

Nothing is imported before it is used, so ``import rendezview.api`` is quick, and the names of
the ground side (`train`, `simulate`, `evaluate`, ...) ask for ``rendezview[training]`` only when
they are called for.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from rendezview.errors import RendezviewError

if TYPE_CHECKING:
    from rendezview.client import Client
    from rendezview.evaluation import evaluate, frame_overlay, write_report
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
    from rendezview.sensors.measurement import BeamSurface, RangeMeasurement
    from rendezview.sensors.observation import Observation, Status
    from rendezview.sensors.reflectors import LitDark, ReflectorSensor, patterns_of
    from rendezview.sensors.ring import RingPrior, RingSensor
    from rendezview.sensors.stereo import Rig, StereoTracker
    from rendezview.sensors.stereo.rig_files import load_rig
    from rendezview.simulation import simulate
    from rendezview.training.mesh import load_mesh
    from rendezview.training.options import TrainingOptions
    from rendezview.training.target_job import train

__all__ = [
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

_HOME = {
    "client": ("Client",),
    "fusion": ("Fusion", "FusionOptions"),
    "geometry.camera": ("Camera",),
    "geometry.pose": ("Pose",),
    "io.camera_files": ("load_camera", "save_camera"),
    "io.results": (
        "JsonLinesWriter",
        "ResultRow",
        "read_json_lines",
        "read_results",
        "write_results",
    ),
    "io.sequences": ("Frame", "Sequence", "open_sequence"),
    "io.bundled": ("find_target",),
    "io.target": ("DockingRing", "Target"),
    "sensors.appearance": ("Recognizer", "Tracker", "TrackerOptions", "ViewModel"),
    "sensors.measurement": ("BeamSurface", "RangeMeasurement"),
    "sensors.observation": ("Observation", "Status"),
    "sensors.reflectors": ("LitDark", "ReflectorSensor", "patterns_of"),
    "sensors.ring": ("RingPrior", "RingSensor"),
    "sensors.stereo": ("Rig", "StereoTracker"),
    "sensors.stereo.rig_files": ("load_rig",),
}
_GROUND = {
    "evaluation": ("evaluate", "frame_overlay", "write_report"),
    "simulation": ("simulate",),
    "training.mesh": ("load_mesh",),
    "training.options": ("TrainingOptions",),
    "training.target_job": ("train",),
}
_MODULE = {name: module for module, names in (_HOME | _GROUND).items() for name in names}


def __getattr__(name: str) -> Any:
    """Import a name on its first use (PEP 562)."""
    if name not in _MODULE:
        raise AttributeError(f"rendezview.api has no {name!r}")
    module = _MODULE[name]
    try:
        value = getattr(importlib.import_module(f"rendezview.{module}"), name)
    except ModuleNotFoundError as error:
        if module in _HOME and (error.name or "").startswith("rendezview"):
            raise
        raise RendezviewError(
            f"rendezview.api.{name} needs {error.name}: pip install 'rendezview[training]'"
        ) from error
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
