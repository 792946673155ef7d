"""The paper's 19 in-views and 54 out-views of a node, in its three readings."""

from __future__ import annotations

import numpy as np
import pytest

from rendezview.geometry.geodesic import Geodesic, angle_between
from rendezview_ground.learn.options import Neighbourhood
from rendezview_ground.learn.trees.neighbourhood import neighbourhood

ORDER = 3
SIX_VALENT = [12, 100, 333, 641]
# Near a node of five neighbours the rings are shorter: these are more than three edges from any.
SPHERE = Geodesic.of_order(ORDER)
from_five = np.min(angle_between(SPHERE.nodes[:, None], SPHERE.nodes[None, :12]), axis=1)
REMOTE = np.flatnonzero(from_five > 3.2 * SPHERE.mean_edge_rad).tolist()


@pytest.fixture(scope="module")
def lattice() -> Geodesic:
    return Geodesic.of_order(ORDER + 1)


@pytest.mark.parametrize(
    ("reading", "six", "five"),
    [(Neighbourhood.DISC, (19, 54), (16, 45)), (Neighbourhood.RINGS, (19, 54), (16, 45))],
)
def test_counts_are_the_papers(lattice, reading, six, five):
    assert len(REMOTE) > 20
    for node in REMOTE if reading is Neighbourhood.RINGS else [*REMOTE, *SIX_VALENT]:
        assert tuple(map(len, neighbourhood(lattice, node, reading))) == six
    for node in range(12):
        assert tuple(map(len, neighbourhood(lattice, node, reading))) == five


@pytest.mark.parametrize("reading", Neighbourhood)
@pytest.mark.parametrize("node", [0, *SIX_VALENT])
def test_in_and_out_are_apart_sorted_and_hold_the_node(lattice, reading, node):
    inside, outside = neighbourhood(lattice, node, reading)
    assert node in inside
    assert not np.intersect1d(inside, outside).size
    for part in (inside, outside):
        assert np.array_equal(part, np.unique(part))
        assert np.issubdtype(part.dtype, np.integer)


@pytest.mark.parametrize("node", [0, *SIX_VALENT])
def test_in_views_are_the_node_its_half_edges_and_its_neighbours(lattice, node):
    inside, _ = neighbourhood(lattice, node, Neighbourhood.DISC)
    near = set(lattice.neighbours(node))
    expected = {node} | near | {n for k in near for n in lattice.neighbours(k)}
    assert set(inside.tolist()) == expected
    assert set(Geodesic.of_order(ORDER).neighbours(node)) <= expected


@pytest.mark.parametrize("node", SIX_VALENT)
def test_out_views_of_the_disc_are_the_nearest_that_are_not_in(lattice, node):
    inside, outside = neighbourhood(lattice, node, Neighbourhood.DISC)
    distance = angle_between(lattice.nodes, lattice.nodes[node])
    rest = np.setdiff1d(np.arange(len(distance)), np.concatenate([inside, outside]))
    assert distance[outside].max() <= distance[rest].min() + 1e-9
    edge = 2.0 * distance[lattice.neighbours(node)].mean()
    assert distance[outside].max() / edge == pytest.approx(19**0.5 / 2.0, rel=0.12)


@pytest.mark.parametrize("node", REMOTE[:4])
def test_rings_are_those_at_two_and_two_and_a_half_edges(lattice, node):
    _, outside = neighbourhood(lattice, node, Neighbourhood.RINGS)
    steps = {node: 0}
    frontier = [node]
    for step in range(1, 7):
        frontier = [
            n for k in frontier for n in lattice.neighbours(k) if steps.setdefault(n, step) == step
        ]
    counts = np.bincount([steps[int(k)] for k in outside], minlength=7)
    assert counts.tolist() == [0, 0, 0, 0, 24, 30, 0]


@pytest.mark.parametrize("node", [0, *SIX_VALENT])
def test_all_is_every_point_out_to_three_edges(lattice, node):
    inside, outside = neighbourhood(lattice, node, Neighbourhood.ALL)
    distance = angle_between(lattice.nodes, lattice.nodes[node])
    edge = 2.0 * distance[lattice.neighbours(node)].mean()
    expected = np.setdiff1d(np.flatnonzero(distance <= 3.0 * edge), inside)
    assert np.array_equal(outside, expected)
    assert 80 <= len(outside) <= 140


@pytest.mark.parametrize("order", [0, 1])
@pytest.mark.parametrize("reading", Neighbourhood)
def test_coarse_spheres_have_both_kinds_of_views(order, reading):
    coarse = Geodesic.of_order(order + 1)
    for node in range(len(Geodesic.of_order(order).nodes)):
        inside, outside = neighbourhood(coarse, node, reading)
        assert len(inside) in (16, 19)
        assert len(outside) > 0
