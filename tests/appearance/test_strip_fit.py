"""What lies beside an edge, as it is seen from a pose that is not the model's view."""

from __future__ import annotations

import numpy as np
import pytest

from rendezview.appearance.contours import CELLS, OUTLINE, OUTLINE_CELLS, POINT_UNIT
from rendezview.appearance.strip_fit import across, in_shadow, outline_strip, rim_end

# A camera on the z axis looks down on a body whose outline on the side of +x runs along y.
EYE = np.array([0.0, 0.0, 10.0])
POINT = np.array([1.0, 0.0, 0.0])


def seen_from(eye: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    out = np.empty(6)
    across(eye, *POINT, tangent, out)
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
            across(eye, *point, contours.tangent[0, view, j], out)
            signs.append(out[3:] @ point)
    assert np.mean(np.array(signs) > 0.0) > 0.8  # few bumps look inwards
    plus = np.array([0, 127, 0], dtype=np.int8)
    return plus if seen_from(EYE, plus)[3] > 0.0 else -plus


def test_outwards_is_where_the_model_has_the_sky(outwards):
    drawn = seen_from(EYE, outwards)
    assert drawn[3] > 0.99
    assert abs(drawn[:3] @ drawn[3:]) < 1e-9


def test_the_end_of_a_rim_is_seen_where_it_stands_in_space(outwards):
    """0.1 m inside the point and 0.5 m nearer, from straight above and from either side."""
    drawn = seen_from(EYE, outwards)
    away = (POINT - EYE) / np.linalg.norm(POINT - EYE)
    end = POINT - 0.1 * drawn[3:] - 0.5 * away
    looking_down = np.diag([1.0, -1.0, -1.0])
    for aside in (0.0, -1.5, 1.5):
        eye = EYE + np.array([aside, 0.0, 0.0])
        found = rim_end(
            *POINT, 0.1, -0.5, drawn, away, looking_down, looking_down @ -eye
        )  # fmt: skip
        place = looking_down @ (end - eye)
        assert found == pytest.approx(place[:2] / place[2], abs=1e-9)


def test_a_wall_before_a_rim_shades_it_where_the_sun_stands_behind_the_wall(outwards):
    drawn = seen_from(EYE, outwards)
    away = (POINT - EYE) / np.linalg.norm(POINT - EYE)
    behind, beside = np.array([-0.6, 0.0, 0.8]), np.array([0.6, 0.0, 0.8])
    assert in_shadow(0.1, -0.5, behind, drawn, away)
    assert not in_shadow(0.1, -0.5, beside, drawn, away)
    assert not in_shadow(0.1, -0.05, behind, drawn, away)  # its shadow is too short
    assert not in_shadow(0.1, 0.5, behind, drawn, away)  # it falls away


def steps_of(rim: float, rim_px: float, shaded: bool, seen, drawn) -> list[tuple[float, float]]:
    palette = np.zeros((256, 4), dtype=np.float32)
    palette[1], palette[2] = (1.0, 0.0, 0.0, 0.8), (0.0, 0.0, 1.0, 0.4)
    shade = np.zeros(256)
    shade[1], shade[2] = 200.0, 100.0
    strip = np.array([1] + [2] * (CELLS - 1), dtype=np.uint8)
    depths, levels = np.empty(CELLS), np.empty(CELLS)
    count = outline_strip(
        strip, palette, shade, seen, drawn, rim, rim_px, shaded, 99.0, 196.0, depths, levels
    )
    return list(zip(depths[:count].tolist(), levels[:count].tolist(), strict=True))


def test_a_rim_is_as_wide_as_it_is_seen_and_makes_no_edge_where_it_is_hidden(outwards):
    drawn = seen_from(EYE, outwards)
    wide = 0.4 * OUTLINE_CELLS[1]
    assert steps_of(wide, 0.7, False, drawn, drawn) == [(0.0, 200.0), (0.7, -100.0)]
    assert steps_of(wide, 0.7, True, drawn, drawn) == [(0.0, 0.0), (0.7, 100.0)]
    assert steps_of(wide, -0.3, False, drawn, drawn) == [(-0.3, 100.0)]


def test_a_facet_that_turns_towards_the_camera_is_seen_wider(outwards):
    drawn = seen_from(EYE + np.array([2.0, 0.0, 0.0]), outwards)
    turned = seen_from(EYE + np.array([4.0, 0.0, 0.0]), outwards)
    (_, _), (before, _) = steps_of(0.0, 0.0, False, drawn, drawn)
    (_, _), (after, _) = steps_of(0.0, 0.0, False, turned, drawn)
    assert before == pytest.approx(1.0)
    assert after == pytest.approx(turned[0] / drawn[0])
    assert after > 2.0
