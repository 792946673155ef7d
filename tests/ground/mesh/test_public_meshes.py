"""Meshes as users really have them: open, mixed winding, missing materials. All must train."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from rendezview.sensors.appearance import ViewModel
from rendezview_ground.learn.job import train
from rendezview_ground.learn.options import TrainingOptions
from rendezview_ground.mesh.mesh import load_mesh

MESHES = (  # the three largest of a collection, and one by another author
    "meshes_42/HST.obj",
    "meshes_42/ISS_MainBody.obj",
    "meshes_42/SpaceShuttleOrbiter.obj",
    "tango/tango.obj",
)


@pytest.mark.parametrize("name", MESHES)
def test_a_public_mesh_trains_and_its_trees_beat_chance(name: str, tmp_path: Path) -> None:
    data = os.environ.get("RENDEZVIEW_TEST_DATA")
    if not data or not (Path(data) / name).is_file():
        pytest.skip(f"{name} is not here: set RENDEZVIEW_TEST_DATA to the folder of test data")
    mesh = load_mesh(Path(data) / name)
    options = TrainingOptions(
        surface_points=64,
        order=0,
        perturbed_views=400,
        held_out_views=100,
        resolution_px=128,
        contour_radii=(1.0,),
        contour_resolution_px=256,
        component_step=8,
        forest_trees=1,
    )
    path = tmp_path / "model.rvm"
    trained = train(mesh, path, name="public", options=options, jobs=1)
    decisions = trained.decisions
    assert decisions is not None
    # of an even number of in- and out-views, chance would have half of each right
    assert decisions.in_right.sum() > 0.7 * decisions.in_total.sum()
    assert decisions.out_right.sum() > 0.8 * decisions.out_total.sum()
    assert np.isfinite(ViewModel.load(path).views.area_m2).all()
