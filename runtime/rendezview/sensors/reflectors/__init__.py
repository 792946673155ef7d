"""The video guidance sensor: retro-reflectors to six numbers (Book et al. 1992, Bales 1995)."""

from rendezview.sensors.reflectors.acquisition import Acquirer
from rendezview.sensors.reflectors.acquisition_options import AcquisitionOptions
from rendezview.sensors.reflectors.cameras import RangedCamera, SwitchingSensor
from rendezview.sensors.reflectors.closed_form import ClosedFormCalibration, calibrate, closed_form
from rendezview.sensors.reflectors.difference import (
    Centroid,
    LitDark,
    Opening,
    ThresholdOptions,
)
from rendezview.sensors.reflectors.discs import predict_spots
from rendezview.sensors.reflectors.observation import ReflectorObservation
from rendezview.sensors.reflectors.p3p import solve_p3p, solve_p3p_batch
from rendezview.sensors.reflectors.pattern import (
    ReflectorPattern,
    SixNumbers,
    patterns_of,
    pose_of,
    six_numbers,
)
from rendezview.sensors.reflectors.refinement import refine
from rendezview.sensors.reflectors.sensor import ReflectorSensor
from rendezview.sensors.reflectors.spots import SpotTable, find_spots
from rendezview.sensors.reflectors.track import TrackingOptions

__all__ = [
    "Acquirer",
    "AcquisitionOptions",
    "Centroid",
    "ClosedFormCalibration",
    "LitDark",
    "Opening",
    "RangedCamera",
    "ReflectorObservation",
    "ReflectorPattern",
    "ReflectorSensor",
    "SixNumbers",
    "SpotTable",
    "SwitchingSensor",
    "ThresholdOptions",
    "TrackingOptions",
    "calibrate",
    "closed_form",
    "find_spots",
    "patterns_of",
    "pose_of",
    "predict_spots",
    "refine",
    "six_numbers",
    "solve_p3p",
    "solve_p3p_batch",
]
