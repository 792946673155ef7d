"""Camera frames of a target in space, with the truth of every one."""

from rendezview_ground.simulate.background import Earth, Stars
from rendezview_ground.simulate.mitsuba_renderer import MitsubaOptions
from rendezview_ground.simulate.scene import SceneOptions, render_frame, simulate, sun_at_phase
from rendezview_ground.simulate.sensor import SensorOptions, automatic_exposure, expose
from rendezview_ground.simulate.shading import Rendering, ShadingOptions, render
from rendezview_ground.simulate.trajectories import (
    TrajectoryKind,
    TrajectoryOptions,
    looking_at,
    torque_free,
    trajectory,
)

__all__ = [
    "Earth",
    "MitsubaOptions",
    "Rendering",
    "SceneOptions",
    "SensorOptions",
    "ShadingOptions",
    "Stars",
    "TrajectoryKind",
    "TrajectoryOptions",
    "automatic_exposure",
    "expose",
    "looking_at",
    "render",
    "render_frame",
    "simulate",
    "sun_at_phase",
    "torque_free",
    "trajectory",
]
