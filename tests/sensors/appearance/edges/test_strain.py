"""What a strain of the craft does to a pose, and how large the edges say it is."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.sensors.appearance.edges.test_kernel_twins import measured, shift_of, weighted

from rendezview.sensors.appearance.edges.measured import MeasuredEdges
from rendezview.sensors.appearance.edges.predicted import FOUND, RESIDUAL, STATE, WEIGHT


def of_points(rng: np.random.Generator, edges: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Slopes of random points (N, 3) about the view centre, into edges; the points."""
    points = rng.normal(size=(len(edges), 3))
    across = np.cross(points + centre, rng.normal(size=(len(edges), 3)))  # j · (q + centre) = 0
    edges[:, 3:6], edges[:, :3] = across, np.cross(points, across)
    return points


def moves_by_strains(slopes: np.ndarray, points: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """(N, 6) how far a unit of each strain moves edges along their normals."""
    j, q = slopes[:, 3:6] @ rotation, points @ rotation
    half = np.sqrt(0.5)
    return np.stack(
        [j[:, a] * q[:, a] for a in range(3)]
        + [(j[:, a] * q[:, b] + j[:, b] * q[:, a]) * half for a, b in ((0, 1), (0, 2), (1, 2))],
        axis=1,
    )


def test_covariance_of_a_strained_craft():
    rng = np.random.default_rng(3)
    edges, arm, loose = measured(rng), rng.normal(size=3), np.full(6, 1e-3)
    centre = np.array([0.3, -0.2, 9.0])
    points = of_points(rng, edges, centre)
    rotation = Rotation.random(random_state=rng).as_matrix()
    root = rng.normal(size=(6, 6))
    known = MeasuredEdges.of(edges, 1.5, rotation, centre)
    found = known.strained(loose, arm, root @ root.T)
    jacobian, _, w = weighted(edges, 1.5)
    kept = (edges[:, STATE] == FOUND) & (np.abs(edges[:, RESIDUAL]) < 1.5)
    strains = moves_by_strains(edges[kept], points[kept], rotation)
    bread = np.linalg.inv(jacobian.T * w @ jacobian + np.diag(loose))
    response = shift_of(arm) @ bread @ (jacobian.T * w @ strains) @ root
    assert found == pytest.approx(response @ response.T, rel=1e-8, abs=1e-12)


def test_strains_that_the_edges_show_are_told_apart_from_the_pose_and_from_noise():
    rng, noise_px, loose = np.random.default_rng(8), 0.02, np.full(6, 1e-9)
    rotation, centre = Rotation.random(random_state=rng).as_matrix(), np.array([0.3, -0.2, 9.0])
    found: dict[float, list[float]] = {0.0: [], 0.002: [], 0.02: []}
    for sigma, variances in found.items():
        for _ in range(20):
            edges = measured(rng, 200)
            edges[:, WEIGHT], edges[:, STATE] = 1.0, FOUND
            points = of_points(rng, edges, centre)
            strains = moves_by_strains(edges, points, rotation)
            moved = strains @ rng.normal(0.0, sigma, 6) + rng.normal(0.0, noise_px, 200)
            # The pose at the least squares has absorbed what it can.
            edges[:, RESIDUAL] = moved - edges[:, :6] @ np.linalg.lstsq(edges[:, :6], moved)[0]
            by_hand = np.linalg.lstsq(np.hstack([edges[:, :6], strains]), moved)[0][6:]
            known = MeasuredEdges.of(edges, 1e3, rotation, centre)
            _, information, right = known.strain_moves(loose)
            best = np.linalg.lstsq(information, right)[0]
            for strain in (best, by_hand):  # a uniform one is a range
                strain[:3] -= strain[:3].mean()
            assert best == pytest.approx(by_hand, abs=1e-3 * np.abs(by_hand).max())
            variances.append(known.likely_strain(loose, noise_px))
    none, small, large = (np.sqrt(np.mean(v)) for v in found.values())
    assert none < 0.001
    assert 0.002 < small < 0.004
    assert 0.02 < large < 0.04
