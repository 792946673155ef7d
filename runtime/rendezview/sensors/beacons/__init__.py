"""Known points of a rigid body in one camera or more: retro-reflectors and lights.

The video guidance sensor (Book et al. 1992, Bales 1995) and the stereo tracker of lights (Welch,
Montgomery & Barsky 1991).
"""

from rendezview.estimation.p3p import solve_p3p, solve_p3p_batch
from rendezview.sensors.beacons.batch import Poses, reprocess
from rendezview.sensors.beacons.cameras import RangedCamera, SwitchingSensor
from rendezview.sensors.beacons.closed_form import ClosedFormCalibration, calibrate, closed_form
from rendezview.sensors.beacons.constellation import (
    ReflectorPattern,
    SixNumbers,
    patterns_of,
    pose_of,
    six_numbers,
)
from rendezview.sensors.beacons.detect.brown_lens import Lens
from rendezview.sensors.beacons.detect.detectors import UNKNOWN, Photodiode, Spots
from rendezview.sensors.beacons.detect.difference import (
    Centroid,
    LitDark,
    Opening,
    ThresholdOptions,
)
from rendezview.sensors.beacons.detect.discs import predict_spots
from rendezview.sensors.beacons.detect.photodiode import (
    Normalisation,
    Response,
    ResponseFit,
    fit_response,
)
from rendezview.sensors.beacons.detect.spots import SpotTable, find_spots
from rendezview.sensors.beacons.euler import YawPitchRoll, rotation_of, yaw_pitch_roll
from rendezview.sensors.beacons.match.acquisition import Acquirer
from rendezview.sensors.beacons.match.acquisition_options import AcquisitionOptions
from rendezview.sensors.beacons.observation import ReflectorObservation
from rendezview.sensors.beacons.pose.refinement import refine
from rendezview.sensors.beacons.rig import Rig, RigCamera, Sights
from rendezview.sensors.beacons.stereo_motion import MotionOptions
from rendezview.sensors.beacons.stereo_observation import StereoObservation
from rendezview.sensors.beacons.stereo_tracker import StereoTracker, TrackerOptions
from rendezview.sensors.beacons.track import TrackingOptions
from rendezview.sensors.beacons.tracker import ReflectorSensor

__all__ = [
    "UNKNOWN",
    "Acquirer",
    "AcquisitionOptions",
    "Centroid",
    "ClosedFormCalibration",
    "Lens",
    "LitDark",
    "MotionOptions",
    "Normalisation",
    "Opening",
    "Photodiode",
    "Poses",
    "RangedCamera",
    "ReflectorObservation",
    "ReflectorPattern",
    "ReflectorSensor",
    "Response",
    "ResponseFit",
    "Rig",
    "RigCamera",
    "Sights",
    "SixNumbers",
    "SpotTable",
    "Spots",
    "StereoObservation",
    "StereoTracker",
    "SwitchingSensor",
    "ThresholdOptions",
    "TrackerOptions",
    "TrackingOptions",
    "YawPitchRoll",
    "calibrate",
    "closed_form",
    "find_spots",
    "fit_response",
    "patterns_of",
    "pose_of",
    "predict_spots",
    "refine",
    "reprocess",
    "rotation_of",
    "six_numbers",
    "solve_p3p",
    "solve_p3p_batch",
    "yaw_pitch_roll",
]
