"""Trajectory: segments of a path fitted to observations, corrections, attitude and spin."""

from rendezview.trajectory.cloud import NodeErrors, PointCloud, camera_place, centre_place
from rendezview.trajectory.descent import Method
from rendezview.trajectory.follower import FollowerOptions, PathFollower, Report
from rendezview.trajectory.guidance import Correction, correct
from rendezview.trajectory.no_fit import NoFit
from rendezview.trajectory.plan import Orbit, Plan, PlanFile, load_plan, plan_of, read_plan
from rendezview.trajectory.segment import FitOptions, Segment, fit_segment
from rendezview.trajectory.shapes import Shape
from rendezview.trajectory.spin import Spin, fit_spin, fit_spin_of_directions, in_line_of_sight

__all__ = [
    "Correction",
    "FitOptions",
    "FollowerOptions",
    "Method",
    "NoFit",
    "NodeErrors",
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
    "correct",
    "fit_segment",
    "fit_spin",
    "fit_spin_of_directions",
    "in_line_of_sight",
    "load_plan",
    "plan_of",
    "read_plan",
]
