"""Rays on a mesh beside a plain solution of the linear equations."""

import numpy as np
import pytest

from rendezview.geometry.ray_cast import first_hits


def spheres(corners):
    centres = 0.5 * (corners.min(axis=1) + corners.max(axis=1))
    return centres, np.linalg.norm(corners - centres[:, None], axis=2).max(axis=1)


def by_equations(corners, start, direction):
    """Nearest face and distance: a + u (b − a) + v (c − a) = start + d direction."""
    best, which = np.inf, -1
    for face, (a, b, c) in enumerate(corners):
        matrix = np.column_stack([b - a, c - a, -direction])
        if abs(np.linalg.det(matrix)) < 1e-12:
            continue
        u, v, distance = np.linalg.solve(matrix, start - a)
        if min(u, v, 1.0 - u - v, distance) >= 0.0 and distance < best:
            best, which = distance, face
    return best, which


@pytest.mark.parametrize("seed", range(4))
def test_the_nearest_face_is_that_of_the_linear_equations(seed):
    rng = np.random.default_rng(seed)
    corners = rng.normal(size=(60, 1, 3)) + 0.5 * rng.normal(size=(60, 3, 3))
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    starts = -6.0 * direction + 0.8 * rng.normal(size=(12, 3))
    distances, faces = first_hits(corners, *spheres(corners), starts, direction)
    expected = [by_equations(corners, start, direction) for start in starts]
    assert faces.tolist() == [face for _, face in expected]
    assert len(set(faces.tolist())) > 3
    assert distances == pytest.approx([distance for distance, _ in expected])


def test_what_lies_behind_or_beside_a_ray_is_not_met():
    corners = np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]])
    starts = np.array([[0.2, 0.2, 1.0], [0.2, 0.2, -1.0], [0.8, 0.8, -1.0]])
    distances, faces = first_hits(corners, *spheres(corners), starts, np.array([0.0, 0.0, 1.0]))
    assert faces.tolist() == [-1, 0, -1]
    assert distances.tolist() == [np.inf, 1.0, np.inf]
