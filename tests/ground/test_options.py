"""Options of simulation, training and assessment that cannot be are refused by their name."""

from __future__ import annotations

from math import inf, nan, pi
from typing import Any

import pytest

from rendezview.errors import RendezviewError
from rendezview_ground.evaluate.assessment import AssessmentOptions
from rendezview_ground.learn.options import TrainingOptions
from rendezview_ground.simulate.background import Earth, Stars
from rendezview_ground.simulate.hard_light import HardLightOptions
from rendezview_ground.simulate.scene import SceneOptions
from rendezview_ground.simulate.sensor import SensorOptions
from rendezview_ground.simulate.shading import ShadingOptions
from rendezview_ground.simulate.trajectories import TrajectoryOptions

IMPOSSIBLE: dict[type, dict[str, list[Any]]] = {
    Earth: {"angular_radius_rad": [0.0, pi / 2, nan]},
    Stars: {"count": [-1], "brightest": [nan]},
    HardLightOptions: {"sky_share": [1.5], "bloom": [(0.2, 0.1)]},
    SceneOptions: {
        "sky_frame": ["ground"],
        "sun_phase_rad": [-0.1, nan],
        "sun_azimuth_rad": [inf],
        "sun_direction_sky": [(0.0, 0.0, 0.0)],
        "earth_direction_sky": [(0.0, nan, 0.0)],
        "sky_level_grey": [255.0, -1.0],
        "dust": [-1],
        "mesh_error": [0.9, nan],
        "insulation": [0.5],
    },
    SensorOptions: {
        "exposure": [0.0, inf],
        "overexposure": [0.0, inf],
        "bloom": [1.0, -0.1, nan],
        "blur_sigma_px": [-1.0],
        "noise_sigma_grey": [nan],
        "black_level_grey": [255.0, 210.0, -1.0],  # the target is exposed for 200
        "electrons_per_grey": [-3.0],
    },
    ShadingOptions: {
        "samples": [0, 9],
        "near_m": [0.0, nan],
        "specular": [-0.1],
        "ambient": [inf],
        "shadow_texels_max": [4],
    },
    TrajectoryOptions: {
        "frames": [0],
        "dt_s": [0.0],
        "start_range_m": [-1.0],
        "end_range_m": [nan],
        "turn_rad": [inf],
        "approach_axis": [(0.0, 0.0, 0.0)],
        "centre_m": [(0.0, 0.0)],
        "inertia": [(1.0, 1.0, 2.5), (0.0, 1.0, 1.0)],
        "bearing_max_rad": [1.6],
        "off_axis_max_rad": [1.6],
        "hop_ratio": [-0.1],
        "pointing_jitter_rad": [-0.1],
        "roll_jitter_rad": [nan],
    },
    TrainingOptions: {
        "order": [-1, 6],
        "bins": [4, 5000],
        "smooth_bins": [2, 0, 999],
        "component_step": [0],
        "resolution_px": [8],
        "sphere_radius_m": [0.0, nan, inf],
        "perturbed_views": [-1],
        "held_out_views": [-1],
        "clean_fraction": [1.1],
        "range_radii": [(0.5, 2.0), (3.0, 2.0), (1.0, inf)],
        "roll_error_rad": [-0.1, nan],
        "noise_sigma_grey": [-1.0, nan],
        "label_edges": [0.1],
        "reach_edges": [0.2],
        "far_edges": [nan],
        "far_fraction": [1.5],
        "min_samples_split": [1],
        "min_gain": [-1.0, nan],
        "seed": [-1],
    },
    AssessmentOptions: {
        "frames": [0],
        "sun_phase_rad": [(0.5, 0.1)],
        "range_radii": [(0.5, 2.0), (1.0, nan)],
        "samples": [0],
        "earth": [1.5],
        "seed": [-1],
    },
}


@pytest.mark.parametrize(
    ("options", "name", "value"),
    [
        (options, name, value)
        for options, wrong in IMPOSSIBLE.items()
        for name, values in wrong.items()
        for value in values
    ],
)
def test_impossible_options_are_refused_by_name(options: type, name: str, value: Any) -> None:
    with pytest.raises(RendezviewError, match=name):
        options(**{name: value})
