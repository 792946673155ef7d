"""The public interface: everything a user needs, under one name.

    from rendezview import Recognizer, Tracker, ViewModel, load_camera

Nothing is imported before it is used, so ``import rendezview`` is quick. The names of the ground
side (`train`, `simulate`, `evaluate`, ...) and the service's `Client` need their extras only when
they are used.
"""

from __future__ import annotations

import importlib
import os
from importlib import metadata
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # with `as`, type checkers take a name for one of this package's own
    from rendezview.errors import RendezviewError as RendezviewError
    from rendezview.fusion import Fusion as Fusion
    from rendezview.fusion import FusionOptions as FusionOptions
    from rendezview.geometry.camera import Camera as Camera
    from rendezview.geometry.pose import Pose as Pose
    from rendezview.io.bundled import find_target as find_target
    from rendezview.io.camera_files import load_camera as load_camera
    from rendezview.io.camera_files import save_camera as save_camera
    from rendezview.io.results import JsonLinesWriter as JsonLinesWriter
    from rendezview.io.results import ResultRow as ResultRow
    from rendezview.io.results import read_json_lines as read_json_lines
    from rendezview.io.results import read_results as read_results
    from rendezview.io.results import write_results as write_results
    from rendezview.io.sequences import Frame as Frame
    from rendezview.io.sequences import Sequence as Sequence
    from rendezview.io.sequences import open_sequence as open_sequence
    from rendezview.io.target import DockingRing as DockingRing
    from rendezview.io.target import Target as Target
    from rendezview.sensors.appearance import Recognizer as Recognizer
    from rendezview.sensors.appearance import Tracker as Tracker
    from rendezview.sensors.appearance import TrackerOptions as TrackerOptions
    from rendezview.sensors.appearance import ViewModel as ViewModel
    from rendezview.sensors.beacons import LitDark as LitDark
    from rendezview.sensors.beacons import ReflectorSensor as ReflectorSensor
    from rendezview.sensors.beacons import Rig as Rig
    from rendezview.sensors.beacons import StereoTracker as StereoTracker
    from rendezview.sensors.beacons import patterns_of as patterns_of
    from rendezview.sensors.beacons.rig_files import load_rig as load_rig
    from rendezview.sensors.beam import BeamMesh as BeamMesh
    from rendezview.sensors.beam import BeamSurface as BeamSurface
    from rendezview.sensors.measurement import RangeMeasurement as RangeMeasurement
    from rendezview.sensors.observation import Observation as Observation
    from rendezview.sensors.observation import Status as Status
    from rendezview.sensors.ring import RingPrior as RingPrior
    from rendezview.sensors.ring import RingSensor as RingSensor
    from rendezview_ground.evaluate import evaluate as evaluate
    from rendezview_ground.evaluate import frame_overlay as frame_overlay
    from rendezview_ground.evaluate import write_report as write_report
    from rendezview_ground.learn.options import TrainingOptions as TrainingOptions
    from rendezview_ground.learn.target_job import train as train
    from rendezview_ground.mesh.mesh import load_mesh as load_mesh
    from rendezview_ground.simulate import simulate as simulate
    from rendezview_service.client import Client as Client

# ONNX Runtime 1.29 and newer report the machine to their maker, with a number that they keep in the
# home folder, from the moment they are imported. Whoever has set the variable keeps their choice.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

# Where each name lives.
_MODULE = {
    name: module
    for module, names in {
        "rendezview.errors": "RendezviewError",
        "rendezview.fusion": "Fusion FusionOptions",
        "rendezview.geometry.camera": "Camera",
        "rendezview.geometry.pose": "Pose",
        "rendezview.io.bundled": "find_target",
        "rendezview.io.camera_files": "load_camera save_camera",
        "rendezview.io.results": (
            "JsonLinesWriter ResultRow read_json_lines read_results write_results"
        ),
        "rendezview.io.sequences": "Frame Sequence open_sequence",
        "rendezview.io.target": "DockingRing Target",
        "rendezview.sensors.appearance": "Recognizer Tracker TrackerOptions ViewModel",
        "rendezview.sensors.beacons": "LitDark ReflectorSensor Rig StereoTracker patterns_of",
        "rendezview.sensors.beacons.rig_files": "load_rig",
        "rendezview.sensors.beam": "BeamMesh BeamSurface",
        "rendezview.sensors.measurement": "RangeMeasurement",
        "rendezview.sensors.observation": "Observation Status",
        "rendezview.sensors.ring": "RingPrior RingSensor",
        "rendezview_ground.evaluate": "evaluate frame_overlay write_report",
        "rendezview_ground.learn.options": "TrainingOptions",
        "rendezview_ground.learn.target_job": "train",
        "rendezview_ground.mesh.mesh": "load_mesh",
        "rendezview_ground.simulate": "simulate",
        "rendezview_service.client": "Client",
    }.items()
    for name in names.split()
}
__all__ = sorted(_MODULE)
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
