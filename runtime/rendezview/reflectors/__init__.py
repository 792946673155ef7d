"""The video guidance sensor: retro-reflectors to six numbers (Book et al. 1992, Bales 1995)."""

from rendezview.reflectors.acquisition import Acquirer, AcquisitionOptions
from rendezview.reflectors.cameras import RangedCamera, SwitchingSensor
from rendezview.reflectors.closed_form import Calibration, calibrate, closed_form
from rendezview.reflectors.difference import LitDark, Opening, ThresholdOptions
from rendezview.reflectors.discs import predict_spots
from rendezview.reflectors.p3p import solve_p3p, solve_p3p_batch
from rendezview.reflectors.pattern import (
    ReflectorPattern,
    SixNumbers,
    patterns_of,
    pose_of,
    six_numbers,
)
from rendezview.reflectors.reading import Reading
from rendezview.reflectors.refinement import refine
from rendezview.reflectors.sensor import ReflectorSensor
from rendezview.reflectors.spots import Centroid, Spots, find_spots
from rendezview.reflectors.status import Status
from rendezview.reflectors.track import TrackingOptions

__all__ = [
    "Acquirer",
    "AcquisitionOptions",
    "Calibration",
    "Centroid",
    "LitDark",
    "Opening",
    "RangedCamera",
    "Reading",
    "ReflectorPattern",
    "ReflectorSensor",
    "SixNumbers",
    "Spots",
    "Status",
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
