"""Several sensors, one state: an error-state filter on relative pose and rates."""

from rendezview.fusion.fusion import Estimate, Fusion
from rendezview.fusion.options import FusionOptions, MotionOptions, SensorOptions
from rendezview.fusion.state import Innovation, Rejected, State, innovation, predict, update
from rendezview.fusion.trust import Trust, Verdict
from rendezview.sensors.measurement import (
    Measurement,
    PoseMeasurement,
    RangeMeasurement,
    RingCandidate,
    RingMeasurement,
    Surface,
)

__all__ = [
    "Estimate",
    "Fusion",
    "FusionOptions",
    "Innovation",
    "Measurement",
    "MotionOptions",
    "PoseMeasurement",
    "RangeMeasurement",
    "Rejected",
    "RingCandidate",
    "RingMeasurement",
    "SensorOptions",
    "State",
    "Surface",
    "Trust",
    "Verdict",
    "innovation",
    "predict",
    "update",
]
