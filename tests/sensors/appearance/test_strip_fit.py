"""What lies beside an edge, as it is seen from a pose that is not the model's view."""

from __future__ import annotations

import numpy as np
import pytest

from rendezview.sensors.appearance.edges.profile import (
    edge_axes,
    in_shadow,
    profile_steps,
    project_start,
)
from rendezview.sensors.appearance.model.contours import OUTLINE, POINT_UNIT, SURFACES

# A camera on the z axis looks down on a body whose outline on the side of +x runs along y.
EYE = np.array([0.0, 0.0, 10.0])
POINT = np.array([1.0, 0.0, 0.0])


def seen_from(eye: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    out = np.empty(6)
    edge_axes(eye, *POINT, tangent, out)
    return out


@pytest.fixture
def outwards(refining_model) -> np.ndarray:
    """The tangent along y that has +x outside, by the model's own convention."""
    contours = refining_model.contours
    signs = []
    for view, towards in enumerate(refining_model.lattice.nodes[:40]):
        eye = towards * contours.shells_m[0]
        for j in np.flatnonzero(contours.kind[0, view] == OUTLINE):
            point = contours.point[0, view, j] * POINT_UNIT * refining_model.target_radius_m
            out = np.empty(6)
            edge_axes(eye, *point, contours.tangent[0, view, j], out)
            signs.append(out[3:] @ point)
    assert np.mean(np.array(signs) > 0.0) > 0.8  # few bumps look inwards
    plus = np.array([0, 127, 0], dtype=np.int8)
    return plus if seen_from(EYE, plus)[3] > 0.0 else -plus


def test_outwards_is_where_the_model_has_the_sky(outwards):
    drawn = seen_from(EYE, outwards)
    assert drawn[3] > 0.99
    assert abs(drawn[:3] @ drawn[3:]) < 1e-9


@pytest.mark.parametrize("place", [(0.9, 0.0, -0.3), (0.97, 0.0, 0.5), (1.02, 0.0, 0.2)])
def test_a_surface_begins_where_its_place_in_space_is_seen(outwards, place):
    """From straight above and from either side of a camera whose view told how far it is."""
    drawn = seen_from(EYE, outwards)
    # The ray of the model's camera to the place meets the line across the point …
    ray = np.array(place) - EYE
    reach, inside = np.linalg.solve(
        np.array([ray, drawn[3:], [0.0, 1.0, 0.0]]).T, POINT - EYE
    )[:2]  # fmt: skip
    deeper = (1.0 / reach - 1.0) * np.linalg.norm(POINT - EYE)  # … and goes on from there
    looking_down = np.diag([1.0, -1.0, -1.0])
    for aside in (0.0, -1.5, 1.5):
        eye = EYE + np.array([aside, 0.0, 0.0])
        found = project_start(
            *POINT, inside, deeper, EYE, drawn, looking_down, looking_down @ -eye
        )  # fmt: skip
        expected = looking_down @ (np.array(place) - eye)
        assert found == pytest.approx(expected[:2] / expected[2], abs=1e-9)


def test_a_facet_that_turns_towards_the_camera_is_seen_wider(outwards):
    """A facet that lies 0.05 m inwards and 0.5 m down, seen ever less edge-on."""
    looking_down = np.diag([1.0, -1.0, -1.0])
    drawn = seen_from(EYE, outwards)
    far = np.linalg.norm(POINT - EYE)
    widths = []
    for aside in (0.0, 1.0, 2.0):
        eye = EYE + np.array([aside, 0.0, 0.0])
        u, _ = project_start(*POINT, 0.05, -0.5, EYE, drawn, looking_down, looking_down @ -eye)
        widths.append((POINT[0] - aside) / far - u)
    assert np.all(np.diff(widths) < 0.0) or np.all(np.diff(widths) > 0.0)
    assert max(widths) > 2.0 * abs(widths[0])


def test_a_wall_before_a_rim_shades_it_where_the_sun_stands_behind_the_wall(outwards):
    drawn = seen_from(EYE, outwards)
    away = (POINT - EYE) / np.linalg.norm(POINT - EYE)
    behind, beside = np.array([-0.6, 0.0, 0.8]), np.array([0.6, 0.0, 0.8])
    assert in_shadow(0.1, 0.5, behind, drawn, away)
    assert not in_shadow(0.1, 0.5, beside, drawn, away)
    assert not in_shadow(0.1, 0.05, behind, drawn, away)  # its shadow is too short
    assert not in_shadow(0.1, -0.5, behind, drawn, away)  # it falls away


SHADE = np.array([0.0, 200.0, 100.0, 103.0])


def steps(outline: bool, kinds: list[int], places: list[float], shaded: bool = False):
    strip = np.array(kinds + kinds[-1:] * (SURFACES - len(kinds)), dtype=np.uint8)
    begins = np.array(places + [60.0] * (SURFACES - len(places)))
    depths, levels = np.empty(SURFACES), np.empty(SURFACES)
    count = profile_steps(outline, strip, SHADE, begins, shaded, depths, levels)
    return list(zip(depths[:count].tolist(), levels[:count].tolist(), strict=True))


def test_an_outline_is_a_step_from_the_sky_and_one_at_each_other_surface():
    assert steps(True, [1, 2], [0.0, 0.7]) == [(0.0, 200.0), (0.7, -100.0)]
    assert steps(True, [1, 2], [0.0, 0.7], shaded=True) == [(0.0, 0.0), (0.7, 100.0)]
    assert steps(True, [1, 0, 2], [0.0, 0.7, 2.0]) == [(0.0, 200.0), (0.7, -200.0), (2.0, 100.0)]


def test_a_surface_that_is_hidden_makes_no_step():
    assert steps(True, [1, 2], [0.0, -0.3]) == [(-0.3, 100.0)]
    assert steps(True, [1, 0, 2], [0.0, 0.7, 0.6]) == [(0.0, 200.0), (0.6, -100.0)]


def test_what_is_hardly_brighter_makes_no_step():
    assert steps(True, [2, 3], [0.0, 0.7]) == [(0.0, 100.0)]


def test_the_first_surface_of_an_inner_edge_is_its_background():
    assert steps(False, [2, 1], [-99.0, 0.2]) == [(0.2, 100.0)]
    assert steps(False, [2, 1, 2], [-99.0, -0.4, 0.5]) == [(-0.4, 100.0), (0.5, -100.0)]
