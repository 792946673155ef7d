"""Several sensors, one state: an error-state filter on relative pose and rates."""

from rendezview.fusion.fusion import Estimate, Fusion, Status
from rendezview.fusion.measurements import (
    Measurement,
    PoseMeasurement,
    RangeMeasurement,
    RingCandidate,
    RingMeasurement,
    Surface,
)
from rendezview.fusion.options import FusionOptions, MotionOptions, SensorOptions
from rendezview.fusion.state import Innovation, Rejected, State, innovation, predict, update
from rendezview.fusion.trust import Trust, Verdict

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
    "Status",
    "Surface",
    "Trust",
    "Verdict",
    "innovation",
    "predict",
    "update",
]
