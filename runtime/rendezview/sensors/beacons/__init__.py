"""Known points of a rigid body in one camera or more: retro-reflectors and lights.

The video guidance sensor (Book et al. 1992, Bales 1995) and the stereo tracker of lights (Welch,
Montgomery & Barsky 1991).
"""

from rendezview.sensors.beacons.constellation import (
    ReflectorPattern,
    SixNumbers,
    patterns_of,
    pose_of,
    six_numbers,
)
from rendezview.sensors.beacons.detect.brown_lens import Lens
from rendezview.sensors.beacons.detect.detectors import Photodiode, Spots
from rendezview.sensors.beacons.detect.difference import LitDark
from rendezview.sensors.beacons.detect.discs import predict_spots
from rendezview.sensors.beacons.detect.photodiode import Normalisation, Response
from rendezview.sensors.beacons.detect.spots import find_spots
from rendezview.sensors.beacons.euler import yaw_pitch_roll
from rendezview.sensors.beacons.match.acquisition import Acquirer
from rendezview.sensors.beacons.observation import ReflectorObservation
from rendezview.sensors.beacons.rig import Rig, RigCamera, Sights
from rendezview.sensors.beacons.stereo_motion import MotionOptions
from rendezview.sensors.beacons.stereo_observation import StereoObservation
from rendezview.sensors.beacons.stereo_tracker import StereoTracker, TrackerOptions
from rendezview.sensors.beacons.track import TrackingOptions
from rendezview.sensors.beacons.tracker import ReflectorSensor

__all__ = [
    "Acquirer",
    "Lens",
    "LitDark",
    "MotionOptions",
    "Normalisation",
    "Photodiode",
    "ReflectorObservation",
    "ReflectorPattern",
    "ReflectorSensor",
    "Response",
    "Rig",
    "RigCamera",
    "Sights",
    "SixNumbers",
    "Spots",
    "StereoObservation",
    "StereoTracker",
    "TrackerOptions",
    "TrackingOptions",
    "find_spots",
    "patterns_of",
    "pose_of",
    "predict_spots",
    "six_numbers",
    "yaw_pitch_roll",
]
