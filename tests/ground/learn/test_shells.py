"""Shells of contour points that the user asks for."""

from dataclasses import replace

import pytest

from rendezview.errors import RendezviewError
from rendezview.io.bundled import find_target
from rendezview_ground.learn.command import _radii
from rendezview_ground.learn.options import TrainingOptions, view_geometry
from rendezview_ground.mesh.mesh import load_mesh


def test_shells_are_read_in_any_order_and_refused_in_words():
    assert _radii("3,0.5,1") == (0.5, 1.0, 3.0)
    with pytest.raises(RendezviewError, match="--shells"):
        _radii("near")


def test_a_shell_inside_the_target_is_refused():
    found = find_target("client")
    mesh = load_mesh(found.mesh_path, found.unit)
    options = TrainingOptions()
    assert view_geometry(mesh, replace(options, contour_radii=(0.4, 1.0)), None)
    with pytest.raises(RendezviewError, match="does not enclose"):
        view_geometry(mesh, replace(options, contour_radii=(0.32, 1.0)), None)
