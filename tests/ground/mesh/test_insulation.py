"""A blanket of insulation: how thick it is, where it lies, and what stays as it was."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from rendezview_ground.mesh.insulation import insulated
from rendezview_ground.mesh.mesh import Mesh

SHARE = 0.02
CENTRE_M = np.array([1.0, 0.0, 0.0])


def _ball() -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=2.0)
    faces = np.array(ball.faces, np.int32)
    red = np.tile(np.float32([0.8, 0.1, 0.1]), (len(faces), 1))
    return Mesh(np.array(ball.vertices) + CENTRE_M, faces, red, ())


def _heights(mesh: Mesh, plain: Mesh) -> np.ndarray:
    """Of the vertices over the plain mesh, radii; a ball's facets lie below its sphere."""
    body = trimesh.Trimesh(plain.vertices_m, plain.faces, process=False)
    _, distance, _ = trimesh.proximity.closest_point_naive(body, mesh.vertices_m)
    return distance / plain.bounding_sphere[1]


def test_half_of_the_surface_gets_a_layer_of_the_thickness_and_half_stays():
    ball = _ball()
    heights = _heights(insulated(ball, SHARE, np.random.default_rng(1)), ball)
    bare = heights < 1e-9
    assert 0.35 < bare.mean() < 0.55
    under = heights[heights > 0.2 * SHARE]
    assert under.mean() == pytest.approx(SHARE, rel=0.25)
    assert 0.25 * SHARE < under.std() < 0.75 * SHARE


def test_surfaces_move_outwards_whatever_the_winding():
    ball = _ball()
    mixed = ball.faces.copy()
    mixed[::2] = mixed[::2, ::-1]
    for faces in (ball.faces, mixed):
        mesh = insulated(
            Mesh(ball.vertices_m, faces, ball.face_rgb, ()), SHARE, np.random.default_rng(1), 1.0
        )
        inside = np.linalg.norm(mesh.vertices_m - CENTRE_M, axis=1)
        assert inside.min() > 2.0 * 0.96  # facets of the ball are that deep
        assert inside.max() > 2.0 * (1.0 + SHARE)


def test_a_box_stays_closed_and_keeps_its_colours():
    box = trimesh.creation.box((2.0, 1.0, 1.0))
    colours = np.linspace(0.0, 1.0, 36, dtype=np.float32).reshape(12, 3)
    plain = Mesh(np.array(box.vertices), np.array(box.faces, np.int32), colours, ("read",))
    mesh = insulated(plain, 0.03, np.random.default_rng(2), 1.0)
    body = trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)
    assert body.is_watertight
    assert body.volume > box.volume
    assert len(np.unique(mesh.face_rgb, axis=0)) == 12
    assert mesh.notes[0] == "read"
    assert "3 % of the radius" in mesh.notes[1]


def test_the_seed_makes_the_blanket_and_none_changes_nothing():
    ball = _ball()
    first, again, other = (insulated(ball, SHARE, np.random.default_rng(s)) for s in (3, 3, 4))
    np.testing.assert_array_equal(first.vertices_m, again.vertices_m)
    assert not np.array_equal(first.vertices_m, other.vertices_m)
    assert insulated(ball, 0.0, np.random.default_rng(3)) is ball


@pytest.mark.parametrize(("share", "covered"), [(-0.1, 0.5), (0.2, 0.5), (0.02, 1.5)])
def test_blankets_that_cannot_be_are_refused(share: float, covered: float):
    with pytest.raises(ValueError, match=r"share|covered"):
        insulated(_ball(), share, np.random.default_rng(0), covered)
