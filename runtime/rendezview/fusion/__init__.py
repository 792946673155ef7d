"""Sensor fusion: an error-state filter on relative pose and rates."""

from rendezview.fusion.fusion import Estimate, Fusion
from rendezview.fusion.options import FusionOptions, MotionOptions, SensorOptions
from rendezview.fusion.prediction import predict
from rendezview.fusion.state import FilterState
from rendezview.fusion.trust import Trust, Verdict
from rendezview.sensors.beam import BeamMesh, BeamSurface
from rendezview.sensors.measurement import (
    Measurement,
    PoseMeasurement,
    RangeMeasurement,
    RateMeasurement,
    RingCandidate,
    RingMeasurement,
    ThrustMeasurement,
)

__all__ = [
    "BeamMesh",
    "BeamSurface",
    "Estimate",
    "FilterState",
    "Fusion",
    "FusionOptions",
    "Measurement",
    "MotionOptions",
    "PoseMeasurement",
    "RangeMeasurement",
    "RateMeasurement",
    "RingCandidate",
    "RingMeasurement",
    "SensorOptions",
    "ThrustMeasurement",
    "Trust",
    "Verdict",
    "predict",
]
