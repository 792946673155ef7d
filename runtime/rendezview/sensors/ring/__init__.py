"""The docking ring: ellipses in a frame to the ring's pose (Zhai et al.)."""

from rendezview.sensors.ring.choice import Choice, MotionChooser, by_attitude, by_point
from rendezview.sensors.ring.circle_pose import (
    CirclePose,
    circle_poses,
    shape_of_circle,
    tangent_basis,
)
from rendezview.sensors.ring.detector import Detection, RingDetector, RingEdge, RingOptions
from rendezview.sensors.ring.ellipse import Ellipse, fit_hyper
from rendezview.sensors.ring.observation import RingObservation
from rendezview.sensors.ring.sensor import RingPrior, RingSensor

__all__ = [
    "Choice",
    "CirclePose",
    "Detection",
    "Ellipse",
    "MotionChooser",
    "RingDetector",
    "RingEdge",
    "RingObservation",
    "RingOptions",
    "RingPrior",
    "RingSensor",
    "by_attitude",
    "by_point",
    "circle_poses",
    "fit_hyper",
    "shape_of_circle",
    "tangent_basis",
]
