"""The picture of several edges of one ring, beside that of each."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from rendezview.geometry.camera import Camera
from rendezview.sensors.ring import CirclePose, Ellipse
from rendezview.sensors.ring.circle_pose import shape_of_circle, tangent_basis
from rendezview.sensors.ring.concentric import PLANE_SHARE, fit_joint

CAMERA = Camera(640, 480, 600.0, 590.0, 319.5, 239.5)
CENTRE, RADIUS = np.array([0.2, -0.1, 3.0]), 0.6


def test_the_joint_fit_is_scipys():
    rng = np.random.default_rng(8)
    axis = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
    basis = tangent_basis(axis)

    def edges(p):
        turned = axis + basis @ p[3:5]
        turned /= np.linalg.norm(turned)
        for ratio, height in ((1.0, 0.0), p[5:7], p[7:9]):
            place = CENTRE + RADIUS * (p[:3] + height * turned)
            yield shape_of_circle(CAMERA, place, turned, RADIUS * ratio)

    start = np.array([0.0] * 5 + [0.8, 0.0, 1.3, 0.0])
    seen = np.array(list(edges(start))) + rng.normal(scale=0.05, size=(3, 5))

    def off(p):
        return np.append((np.array(list(edges(p))) - seen).ravel() / 0.05, p[[6, 8]] / PLANE_SHARE)

    peer = least_squares(off, start, x_scale="jac", xtol=1e-14)
    ellipses = [Ellipse.from_shape(shape, 0.05**2 * np.eye(5)) for shape in seen]
    pose, chi2 = fit_joint(CAMERA, ellipses, CirclePose(CENTRE + 0.01, axis, RADIUS))
    turned = axis + basis @ peer.x[3:5]
    sigma = np.sqrt(np.diag(np.linalg.inv(peer.jac.T @ peer.jac)))
    np.testing.assert_allclose(chi2, 2.0 * peer.cost, rtol=1e-3)
    apart = np.abs(pose.centre_m - CENTRE - RADIUS * peer.x[:3])
    assert (apart < 0.03 * RADIUS * sigma[:3]).all()
    assert pose.axis @ turned / np.linalg.norm(turned) > np.cos(0.03 * sigma[3:5].min())
    own = np.sqrt(np.diag(pose.covariance))
    np.testing.assert_allclose(own[3:], sigma[3:5], rtol=0.1)
