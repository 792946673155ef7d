"""The geodesic sphere of views (Cleghorn & Sternberg 1991, eq. 1–3)."""

from __future__ import annotations

import numpy as np
import pytest

from rendezview.geometry.geodesic import MAX_ORDER, Geodesic, angle_between

# order: nodes, faces, edges (eq. 1–3; the paper gives order 3 as 642, 1280, 1920)
COUNTS = {
    0: (12, 20, 30),
    1: (42, 80, 120),
    2: (162, 320, 480),
    3: (642, 1280, 1920),
    4: (2562, 5120, 7680),
}


@pytest.mark.parametrize("order", COUNTS)
def test_counts_are_those_of_equations_1_to_3(order):
    sphere = Geodesic.of_order(order)
    assert (len(sphere.nodes), len(sphere.faces), len(sphere.edges)) == COUNTS[order]


@pytest.mark.parametrize("order", COUNTS)
def test_twelve_nodes_have_five_neighbours_and_all_others_six(order):
    sphere = Geodesic.of_order(order)
    valence = [len(sphere.neighbours(k)) for k in range(len(sphere.nodes))]
    assert valence[:12] == [5] * 12
    assert set(valence[12:]) <= {6}


def test_neighbours_share_an_edge_and_are_mutual():
    sphere = Geodesic.of_order(2)
    edges = {tuple(e) for e in sphere.edges.tolist()}
    for a in range(len(sphere.nodes)):
        for b in sphere.neighbours(a):
            assert (min(a, b), max(a, b)) in edges
            assert a in sphere.neighbours(b)


def test_nodes_are_unit_vectors_and_all_different():
    nodes = Geodesic.of_order(3).nodes
    assert np.allclose(np.linalg.norm(nodes, axis=1), 1.0, atol=1e-15)
    assert len(np.unique(nodes.round(9), axis=0)) == len(nodes)


@pytest.mark.parametrize("order", range(4))
def test_nodes_of_an_order_are_the_first_of_the_next(order):
    below, above = Geodesic.of_order(order), Geodesic.of_order(order + 1)
    assert np.array_equal(above.nodes[: len(below.nodes)], below.nodes)


@pytest.mark.parametrize("order", range(4))
def test_new_nodes_are_the_mid_points_of_the_edges_in_their_order(order):
    below, above = Geodesic.of_order(order), Geodesic.of_order(order + 1)
    a, b = (below.nodes[below.edges[:, k]] for k in (0, 1))
    new = above.nodes[len(below.nodes) :]
    assert np.allclose(angle_between(new, a), angle_between(new, b), atol=1e-12)
    assert np.allclose(angle_between(new, a), 0.5 * angle_between(a, b), atol=1e-12)


def test_faces_look_outwards_and_cover_the_sphere():
    sphere = Geodesic.of_order(2)
    volume = np.linalg.det(sphere.nodes[sphere.faces])
    assert (volume > 0).all()
    a, b, c = (sphere.nodes[sphere.faces[:, k]] for k in range(3))
    # solid angle of a spherical triangle (Van Oosterom & Strackee 1983)
    below = 1.0 + np.sum(a * b + b * c + c * a, axis=1)
    assert np.sum(2.0 * np.arctan2(volume, below)) == pytest.approx(4.0 * np.pi)


def test_order_3_edges_run_from_an_eighth_of_the_icosahedrons_to_9_44_degrees():
    sphere = Geodesic.of_order(3)
    assert np.rad2deg(sphere.mean_edge_rad) == pytest.approx(8.61, abs=0.05)
    a, b = (sphere.nodes[sphere.edges[:, k]] for k in (0, 1))
    angle = np.rad2deg(angle_between(a, b))
    assert angle.min() == pytest.approx(np.rad2deg(np.arctan(2.0)) / 8.0)  # bisected exactly
    assert angle.max() == pytest.approx(9.44, abs=0.01)


@pytest.mark.parametrize("angle_deg", [0.0, 3.0, 20.0, 90.0, 180.0, 400.0])
def test_within_gives_what_an_exhaustive_search_gives(angle_deg):
    sphere = Geodesic.of_order(3)
    direction = np.random.default_rng(1).normal(size=3)
    direction /= np.linalg.norm(direction)
    expected = np.flatnonzero(angle_between(sphere.nodes, direction) <= np.deg2rad(angle_deg))
    assert np.array_equal(sphere.within(direction, np.deg2rad(angle_deg)), expected)


def test_within_counts_a_node_at_the_very_edge():
    sphere = Geodesic.of_order(1)
    neighbour = sphere.neighbours(0)[0]
    angle = float(angle_between(sphere.nodes[0], sphere.nodes[neighbour]))
    assert neighbour in sphere.within(sphere.nodes[0], angle)
    assert neighbour not in sphere.within(sphere.nodes[0], angle - 1e-6)


def test_nearest_gives_what_an_exhaustive_search_gives():
    sphere = Geodesic.of_order(3)
    directions = np.random.default_rng(2).normal(size=(4, 50, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    found = sphere.nearest(directions)
    assert found.shape == (4, 50)
    assert np.array_equal(found, np.argmax(directions @ sphere.nodes.T, axis=-1))


def test_angles_are_exact_near_zero_and_near_pi():
    x = np.array([1.0, 0.0, 0.0])
    near = np.array([np.cos(1e-9), np.sin(1e-9), 0.0])
    assert angle_between(x, near) == pytest.approx(1e-9, rel=1e-6)
    assert np.pi - angle_between(x, -near) == pytest.approx(1e-9, rel=1e-6)


def test_shared_arrays_cannot_be_written_to():
    sphere = Geodesic.of_order(1)
    for array in (sphere.nodes, sphere.faces):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


@pytest.mark.parametrize("order", [-1, MAX_ORDER + 1])
def test_orders_out_of_range_are_refused(order):
    with pytest.raises(ValueError, match=str(order)):
        Geodesic.of_order(order)
