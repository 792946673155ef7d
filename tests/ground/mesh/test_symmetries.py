"""Symmetries of solids anywhere in their frame, whose numbers group theory gives."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from rendezview.geometry.symmetry import Symmetry, common_point, discrete_turns
from rendezview.sensors.appearance import ViewModel
from rendezview_ground.learn.command import summary
from rendezview_ground.learn.job import Trained
from rendezview_ground.learn.options import TrainingOptions, view_geometry
from rendezview_ground.mesh.colours import GREY
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.mesh.symmetries import described, find_symmetries

TURN = Rotation.from_rotvec([0.7, -1.1, 0.4]).as_matrix()
SHIFT_M = np.array([20.0, -7.0, 3.0])
SOLIDS = trimesh.creation


def as_mesh(solid: trimesh.Trimesh, rgb: np.ndarray | None = None) -> Mesh:
    rgb = np.full((len(solid.faces), 3), GREY) if rgb is None else rgb
    vertices = np.asarray(solid.vertices, dtype=np.float64)
    return Mesh(vertices, solid.faces.astype(np.int32), rgb.astype(np.float32), ())


def aside(solid: trimesh.Trimesh) -> trimesh.Trimesh:
    """Turned, and moved far from the origin."""
    return trimesh.Trimesh(solid.vertices @ TURN.T + SHIFT_M, solid.faces, process=False)


def box_with(*sizes_m: float) -> trimesh.Trimesh:
    """A box with an antenna of some size beside its middle."""
    above = trimesh.transformations.translation_matrix([1.2, 0.7, 0.5 + 0.5 * sizes_m[2]])
    return trimesh.util.concatenate([SOLIDS.box((3, 2, 1)), SOLIDS.box(sizes_m, transform=above)])


def count(symmetries: tuple[Symmetry, ...]) -> tuple[int, int]:
    """Continuous axes, and turns of the discrete symmetries."""
    continuous = sum(symmetry.kind == "continuous" for symmetry in symmetries)
    return continuous, len(discrete_turns(symmetries))


# Orders of the rotation groups: D2, D4, O, T, I, D6, C6.
@pytest.mark.parametrize(
    ("solid", "order"),
    [
        (SOLIDS.box((3.0, 2.0, 1.0)), 4),
        (SOLIDS.box((2.0, 2.0, 1.0)), 8),
        (SOLIDS.box((1.0, 1.0, 1.0)), 24),
        (SOLIDS.icosahedron(), 60),
        (SOLIDS.cylinder(1.0, 2.0, sections=6), 12),
        (SOLIDS.cone(1.0, 2.0, sections=6), 6),
    ],
    ids=["box", "square box", "cube", "icosahedron", "prism", "pyramid"],
)
def test_a_solid_aside_has_the_turns_of_its_group(solid: trimesh.Trimesh, order: int) -> None:
    moved = aside(solid)
    found = find_symmetries(as_mesh(moved))
    assert count(found) == (0, order)
    assert len(found) <= 2
    centre = common_point(found)
    for turn in discrete_turns(found):  # each vertex lands on a vertex
        landed = (moved.vertices - centre) @ turn.T + centre
        apart = np.linalg.norm(landed[:, None] - moved.vertices[None], axis=2).min(axis=1)
        assert apart.max() < 1e-3 * moved.scale


@pytest.mark.parametrize(
    ("solid", "expected"),
    [
        (SOLIDS.cylinder(1.0, 2.0, sections=128), (1, 2)),  # any turn, and the half turn across
        (SOLIDS.cone(1.0, 2.0, sections=128), (1, 1)),  # its moments are nearly equal
        (SOLIDS.icosphere(4), (2, 1)),
    ],
    ids=["cylinder", "cone", "ball"],
)
def test_a_round_solid_aside_turns_by_any_angle(
    solid: trimesh.Trimesh, expected: tuple[int, int]
) -> None:
    found = find_symmetries(as_mesh(aside(solid)))
    assert count(found) == expected
    if expected[0] == 1:
        assert abs(found[0].axis @ TURN[:, 2]) == pytest.approx(1.0, abs=1e-4)
        missed = np.cross(found[0].axis, found[0].point_m - SHIFT_M)
        assert np.linalg.norm(missed) < 1e-3


def test_an_axis_through_the_origin_needs_no_point() -> None:
    cone = SOLIDS.cone(1.0, 2.0, sections=6)
    cone.apply_translation([0.0, 0.0, 5.0])  # along its axis
    (sixth,) = find_symmetries(as_mesh(cone))
    np.testing.assert_array_equal(sixth.point_m, np.zeros(3))
    cone.apply_translation([0.1, 0.0, 0.0])
    (moved,) = find_symmetries(as_mesh(cone))
    np.testing.assert_allclose(moved.point_m[:2], [0.1, 0.0], atol=1e-9)


def test_an_antenna_of_half_a_percent_of_the_surface_breaks_a_symmetry() -> None:
    assert count(find_symmetries(as_mesh(aside(box_with(0.06, 0.06, 0.4))))) == (0, 1)
    # One of 0.05 % does not.
    assert count(find_symmetries(as_mesh(aside(box_with(0.03, 0.03, 0.1))))) == (0, 4)


def test_a_face_of_another_albedo_breaks_a_symmetry_and_of_the_same_one_does_not() -> None:
    box = SOLIDS.box((3.0, 2.0, 1.0))
    rgb = np.full((12, 3), 0.6)
    rgb[box.face_normals[:, 2] > 0.9] = 0.2
    (half_turn,) = find_symmetries(as_mesh(box, rgb))
    np.testing.assert_allclose(half_turn.axis, [0.0, 0.0, 1.0], atol=1e-6)  # the painted face's
    assert count(find_symmetries(as_mesh(box, np.full((12, 3), 0.2)))) == (0, 4)


def test_faces_that_are_there_twice_move_no_axis() -> None:
    box = SOLIDS.box((3.0, 2.0, 1.0))
    doubled = trimesh.Trimesh(box.vertices, np.vstack([box.faces, box.faces[:3]]), process=False)
    assert count(find_symmetries(as_mesh(doubled))) == (0, 4)


def test_a_noisy_mesh_keeps_its_exact_turns() -> None:
    """Noise of 0.2 % of the radius: the turns found still come round."""
    box = SOLIDS.box((2.0, 2.0, 1.0)).subdivide().subdivide().subdivide()
    noise = np.random.default_rng(5).normal(size=box.vertices.shape) * 0.003
    noisy = trimesh.Trimesh(box.vertices + noise, box.faces, process=False)
    assert count(find_symmetries(as_mesh(noisy))) == (0, 8)


def test_a_body_that_is_nearly_round_has_only_turns_that_come_round() -> None:
    """An ellipse 1.4 % longer than wide: small turns hold, and their powers do not."""
    ring = SOLIDS.torus(1.0, 0.35, major_sections=32, minor_sections=10)
    ring.apply_scale([1.014, 1.0, 1.0])
    continuous, turns = count(find_symmetries(as_mesh(ring)))
    assert continuous == 0
    assert turns in (4, 8, 16, 32, 48)  # of D2 to D24


def test_a_body_without_symmetry_has_none(bumpy_mesh: Mesh) -> None:
    assert find_symmetries(bumpy_mesh) == ()


def test_symmetries_are_described_with_their_point() -> None:
    z, x = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
    box = (Symmetry("discrete", z, math.pi), Symmetry("discrete", x, math.pi))
    assert described(()) == "has no symmetry"
    assert described(box) == (
        "looks the same when turned by 180° about (0.00, 0.00, 1.00), by 180° about "
        "(1.00, 0.00, 0.00), or by these in turn: 4 attitudes"
    )
    assert described((Symmetry("continuous", z, None, np.array([1.5, 1.0, 0.0])),)) == (
        "looks the same when turned by any angle about (0.00, 0.00, 1.00); the axis passes "
        "through (1.50, 1.00, 0.00) m"
    )


def test_training_names_the_symmetries(tiny_model: ViewModel, bumpy_mesh: Mesh) -> None:
    geometry = view_geometry(bumpy_mesh, TrainingOptions(), None)
    z, point_m = np.array([0.0, 0.0, 1.0]), np.array([1.5, 1.0, 0.0])
    round_model = replace(tiny_model, symmetries=(Symmetry("continuous", z, None, point_m),))
    assert "the target has no symmetry" in summary(Trained(tiny_model, None, geometry))
    words = summary(Trained(round_model, None, geometry))
    assert "the target looks the same when turned by any angle about (0.00, 0.00, 1.00)" in words
    assert "the axis passes through (1.50, 1.00, 0.00) m" in words
