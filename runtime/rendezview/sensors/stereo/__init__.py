"""Lights of a target in two or more cameras (Welch, Montgomery & Barsky 1991)."""

from rendezview.sensors.stereo.batch import Poses, reprocess
from rendezview.sensors.stereo.detectors import UNKNOWN, Photodiode, Spots
from rendezview.sensors.stereo.euler import YawPitchRoll, rotation_of, yaw_pitch_roll
from rendezview.sensors.stereo.lens import Lens
from rendezview.sensors.stereo.motion import MotionOptions
from rendezview.sensors.stereo.observation import StereoObservation
from rendezview.sensors.stereo.response import Normalisation, Response, ResponseFit, fit_response
from rendezview.sensors.stereo.rig import Rig, RigCamera, Sights
from rendezview.sensors.stereo.tracker import StereoTracker, TrackerOptions

__all__ = [
    "UNKNOWN",
    "Lens",
    "MotionOptions",
    "Normalisation",
    "Photodiode",
    "Poses",
    "Response",
    "ResponseFit",
    "Rig",
    "RigCamera",
    "Sights",
    "Spots",
    "StereoObservation",
    "StereoTracker",
    "TrackerOptions",
    "YawPitchRoll",
    "fit_response",
    "reprocess",
    "rotation_of",
    "yaw_pitch_roll",
]
