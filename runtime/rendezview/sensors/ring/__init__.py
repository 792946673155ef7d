"""The docking ring: ellipses in a frame to the ring's pose (Zhai et al.)."""

from rendezview.sensors.ring.circle_pose import (
    CirclePose,
    circle_poses,
    shape_of_circle,
    tangent_basis,
)
from rendezview.sensors.ring.detector import RingDetector, RingOptions
from rendezview.sensors.ring.ellipse import Ellipse
from rendezview.sensors.ring.observation import RingObservation
from rendezview.sensors.ring.sensor import RingPrior, RingSensor

__all__ = [
    "CirclePose",
    "Ellipse",
    "RingDetector",
    "RingObservation",
    "RingOptions",
    "RingPrior",
    "RingSensor",
    "circle_poses",
    "shape_of_circle",
    "tangent_basis",
]
