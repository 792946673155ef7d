"""Normal equations of several edges of one ring, beside numpy's and numerical derivatives."""

from __future__ import annotations

import numpy as np
import pytest

from rendezview.geometry.camera import Camera
from rendezview.geometry.lens import lens_vector
from rendezview.sensors.ring.circle_pose import tangent_basis
from rendezview.sensors.ring.concentric import _equations, _misfit, _predict

CAMERA = lens_vector(Camera(640, 480, 600.0, 590.0, 319.5, 239.5))
CENTRE, RADIUS, PLANE_SHARE = np.array([0.2, -0.1, 3.0]), 0.6, 0.004


def test_misfit_and_normal_equations_of_three_edges_are_those_of_numpy():
    rng = np.random.default_rng(8)
    axis = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
    basis = tangent_basis(axis)
    p = np.array([0.01, -0.02, 0.03, 0.02, -0.01, 0.8, 0.002, 1.3, -0.001])

    def predict(parameters):
        out = np.empty((3, 5))
        assert _predict(CAMERA, CENTRE, axis, basis, RADIUS, parameters, 3, out)
        return out

    here = predict(p)
    shapes = here + rng.normal(scale=0.3, size=(3, 5))
    roots = rng.normal(size=(3, 5, 5))
    information = roots @ roots.transpose(0, 2, 1)
    off, heights = shapes - here, p[6::2] / PLANE_SHARE
    chi2 = np.einsum("ki,kij,kj", off, information, off) + heights @ heights
    assert _misfit(shapes, here, information, p, PLANE_SHARE) == pytest.approx(chi2, rel=1e-12)

    normal, right = np.empty((9, 9)), np.empty(9)
    assert _equations(
        CAMERA, shapes, here, information, RADIUS, PLANE_SHARE, CENTRE, axis, basis, p, normal,
        right,
    )  # fmt: skip
    steps = 1e-5 * np.eye(9)
    slopes = np.array([(predict(p + step) - predict(p - step)) / 2e-5 for step in steps])
    prior = np.diag([0.0] * 3 + [1.0] * 2 + [0.0, PLANE_SHARE**-2] * 2)
    expected = np.einsum("aki,kij,bkj->ab", slopes, information, slopes) + prior
    # The slopes are one-sided: they differ by half a step of the bend.
    np.testing.assert_allclose(normal, expected, rtol=1e-3, atol=1e-4 * expected.max())
    down = np.einsum("aki,kij,kj->a", slopes, information, off)
    down[6::2] -= heights / PLANE_SHARE
    np.testing.assert_allclose(right, down, rtol=1e-3, atol=1e-4 * np.abs(down).max())


def test_where_an_edge_is_behind_the_camera_there_are_no_equations():
    axis = np.array([0.0, 0.0, -1.0])
    p, out = np.array([0.0, 0.0, -6.0, 0.0, 0.0]), np.empty((1, 5))
    assert not _predict(CAMERA, CENTRE, axis, tangent_basis(axis), RADIUS, p, 1, out)
