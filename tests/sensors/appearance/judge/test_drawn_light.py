"""The light of a drawn pose where surfaces are overexposed, or one face fills the picture."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.sensors.appearance.judge.near_symmetric import twelve_sides

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance.edges.lighting import light_strengths
from rendezview.sensors.appearance.judge.drawn import Drawn, DrawnEvidence
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.sky import Sky
from rendezview_ground.learn.options import TrainingOptions, view_geometry
from rendezview_ground.learn.views.carried_shape import carried_shape
from rendezview_ground.simulate.shading import ShadingOptions, render

CAMERA = Camera.from_fov(320, 320, np.deg2rad(40.0))
# The end of a drum in grazing light, seen from 10° beside its axis; a side is in full sun.
POSE = Pose(
    Rotation.from_euler("xyz", [10.0, -4.0, 20.0], degrees=True).as_matrix(),
    np.array([0.2, -0.1, 6.0]),
)
GRAZING = np.array([-0.85, 0.45, -0.27]) / np.linalg.norm([-0.85, 0.45, -0.27])


def drawn(tiny_model: ViewModel, exposure: float) -> tuple[Drawn, np.ndarray]:
    """The true pose beside nothing, and which pixels of the craft lie in shadow."""
    drum = twelve_sides()
    centre_m, radius_m = drum.bounding_sphere
    shape = carried_shape(drum, view_geometry(drum, TrainingOptions(), None), seed=0)
    model = dataclasses.replace(tiny_model, centre_m=centre_m, target_radius_m=radius_m)
    options = ShadingOptions(samples=3, specular=0.0, ambient=0.015, earthshine=0.0)
    radiance = render(drum, CAMERA, POSE, GRAZING, options).radiance
    grey = 5.0 + exposure * radiance / radiance.max()
    grey += np.random.default_rng(2).normal(0.0, 2.0, grey.shape)
    frame = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    evidence = DrawnEvidence(shape, model, CAMERA)
    one = evidence.drawn(evidence.window(frame, Sky.of(frame), POSE), POSE)
    assert one is not None
    one = dataclasses.replace(one, window=one.window.beside([one]))
    return one, one.sunlit(GRAZING) == 0.0


@pytest.mark.parametrize("exposure", [240.0, 800.0])
def test_the_shadow_on_a_face_is_dark_beside_an_overexposed_side(
    tiny_model: ViewModel, exposure: float
) -> None:
    one, dark = drawn(tiny_model, exposure)
    explained = one.under(GRAZING)
    assert explained.cost < 40.0
    expected, shown = (
        np.median(levels.ravel()[one.where][dark])
        for levels in (explained.picture, one.window.levels)
    )
    assert expected == pytest.approx(shown, abs=6.0)


def test_overexposed_levels_are_lower_bounds_of_the_light() -> None:
    rng = np.random.default_rng(3)
    albedo, facing = np.full(400, 0.6), rng.uniform(0.1, 1.0, 400)
    levels = np.minimum(albedo * (700.0 * facing + 20.0) + rng.normal(0.0, 3.0, 400), 250.0)
    strengths = np.empty(2)

    def fitted(white: float) -> float:
        lit = albedo * facing
        return light_strengths(levels, lit, albedo, 15.0, white, strengths, 12, True)

    assert fitted(249.0) < 40.0
    assert strengths == pytest.approx([700.0, 20.0], abs=25.0)
    fitted(np.inf)
    assert strengths[0] < 500.0
