"""Camera frames of a target in space, with the truth of every one."""

from rendezview_ground.simulate.background import Earth
from rendezview_ground.simulate.mitsuba_renderer import MitsubaOptions
from rendezview_ground.simulate.scene import SceneOptions, render_frame, simulate, sun_at_phase
from rendezview_ground.simulate.sensor import SensorOptions
from rendezview_ground.simulate.shading import ShadingOptions
from rendezview_ground.simulate.trajectories import TrajectoryOptions, trajectory

__all__ = [
    "Earth",
    "MitsubaOptions",
    "SceneOptions",
    "SensorOptions",
    "ShadingOptions",
    "TrajectoryOptions",
    "render_frame",
    "simulate",
    "sun_at_phase",
    "trajectory",
]
