"""Trajectory: segments of a path fitted to observations, corrections, attitude and spin."""

from rendezview.trajectory.cloud import PointCloud, camera_place, centre_place
from rendezview.trajectory.descent import Method
from rendezview.trajectory.follower import FollowerOptions, PathFollower, Report
from rendezview.trajectory.guidance import Correction
from rendezview.trajectory.no_fit import NoFit
from rendezview.trajectory.plan import Orbit, Plan, PlanFile, load_plan, plan_of, read_plan
from rendezview.trajectory.segment import FitOptions, Segment, fit_segment
from rendezview.trajectory.shapes import Shape
from rendezview.trajectory.spin import Spin, fit_spin, fit_spin_of_directions

__all__ = [
    "Correction",
    "FitOptions",
    "FollowerOptions",
    "Method",
    "NoFit",
    "Orbit",
    "PathFollower",
    "Plan",
    "PlanFile",
    "PointCloud",
    "Report",
    "Segment",
    "Shape",
    "Spin",
    "camera_place",
    "centre_place",
    "fit_segment",
    "fit_spin",
    "fit_spin_of_directions",
    "load_plan",
    "plan_of",
    "read_plan",
]
