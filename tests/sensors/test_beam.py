"""What a ranger's beam meets on a plane and on a mesh."""

import numpy as np
import pytest

from rendezview.sensors.beam import BeamMesh, BeamSurface, Met

START = np.array([0.4, 0.3, 10.0])
BEAM = np.array([0.03, -0.02, -1.0]) / np.linalg.norm([0.03, -0.02, -1.0])


def plate(z_m, x0, x1):
    """A plate across z from x0 to x1, 4 m in y."""
    corners = [(x0, -2.0, z_m), (x1, -2.0, z_m), (x1, 2.0, z_m), (x0, 2.0, z_m)]
    return np.array(corners), np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def meshed(*plates, relief_m=0.0):
    vertices = np.vstack([v for v, _ in plates])
    faces = np.vstack([f + 4 * k for k, (_, f) in enumerate(plates)])
    return BeamMesh(vertices, faces, relief_m)


def spread(sigma_m):
    return sigma_m**2 * np.eye(3)


def test_on_a_flat_mesh_the_beam_meets_what_it_meets_on_the_plane():
    plane = BeamSurface(np.zeros(3), np.array([0.0, 0.0, 1.0])).met(START, BEAM, spread(0.1))
    mesh = meshed(plate(0.0, -3.0, 3.0), relief_m=0.02).met(START, BEAM, spread(0.1))
    assert isinstance(plane, Met)
    assert isinstance(mesh, Met)
    assert mesh.distance_m == pytest.approx(plane.distance_m)
    assert abs(mesh.normal @ plane.normal) == pytest.approx(1.0)
    assert mesh.relief_m == pytest.approx(0.02)


def test_a_step_within_reach_of_the_spot_is_relief_and_beyond_it_is_none():
    steps = meshed(plate(0.0, -3.0, 0.9), plate(1.0, 0.85, 3.0))  # the beam meets x = 0.7
    near, far = (steps.met(START, BEAM, spread(sigma)) for sigma in (0.15, 0.05))
    assert isinstance(near, Met)
    assert isinstance(far, Met)
    assert far.relief_m == pytest.approx(0.0, abs=1e-9)
    assert far.distance_m == pytest.approx(10.0 / -BEAM[2])
    assert 0.2 < near.relief_m < 0.5
    assert near.distance_m < far.distance_m - 0.05  # some of it may be a metre nearer


@pytest.mark.parametrize(
    ("x0_m", "beam", "words"),
    [
        (2.0, BEAM, "would miss"),
        (0.6, BEAM, "may miss"),
        (-3.0, np.array([np.sqrt(1.0 - 1e-4), 0.0, -0.01]), "would miss"),
    ],
)
def test_a_beam_beside_the_mesh_is_told(x0_m, beam, words):
    met = meshed(plate(0.0, x0_m, 3.0)).met(START, beam, spread(0.1))
    assert isinstance(met, str)
    assert words in met


def test_a_grazing_beam_is_told():
    beam = np.array([1.0, 0.0, -0.02])
    beam /= np.linalg.norm(beam)
    start = -20.0 * beam
    wide = meshed(plate(0.0, -300.0, 300.0))
    assert "grazes" in wide.met(start, beam, spread(1e-4))
