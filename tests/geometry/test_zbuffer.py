"""The z-buffer: which of several triangles a sample shows."""

from __future__ import annotations

import numpy as np

from rendezview.geometry.zbuffer import (
    NOBODY,
    draw_chosen,
    draw_from_afar,
    empty_buffers,
    fill_triangle,
)


def test_a_triangle_covers_the_samples_inside_it() -> None:
    nearness, owner = empty_buffers(6, 8)
    fill_triangle(0.5, 0.5, 2.0, 6.5, 0.5, 2.0, 0.5, 4.5, 2.0, 3, nearness, owner)
    rows, columns = np.nonzero(owner == 3)
    inside = {
        (row, column)
        for row in range(6)
        for column in range(8)
        if column > 0.5 and row > 0.5 and (column - 0.5) / 6.0 + (row - 0.5) / 4.0 < 1.0
    }
    assert set(zip(rows.tolist(), columns.tolist(), strict=True)) == inside
    np.testing.assert_array_equal(nearness[owner == 3], np.float32(2.0))
    assert set(np.unique(owner)) == {NOBODY, 3}


def test_of_the_chosen_triangles_the_nearest_is_shown() -> None:
    corners = [(-1.0, -1.0), (9.0, -1.0), (-1.0, 9.0)]
    vertices = np.array([[x, y, w] for w in (1.0, 3.0, 2.0) for x, y in corners])
    faces = np.arange(9, dtype=np.int32).reshape(3, 3)
    nearness, owner = empty_buffers(4, 4)
    draw_chosen(vertices, faces, np.array([0, 2]), nearness, owner)
    assert (owner == 2).all()  # the second is nearer, and was not chosen
    draw_chosen(vertices, faces, np.array([1]), nearness, owner)
    assert (owner == 1).all()
    np.testing.assert_allclose(nearness, 3.0)


def test_from_afar_the_faces_towards_the_eye_hide_the_others_in_their_places() -> None:
    """Two sheets: one at z = 1 over x > 0, one at z = -1 over all; seen from +z and from -z."""
    x = np.array([[0.5, -2.0], [2.5, -2.0], [0.5, 2.0], [-2.5, -3.0], [2.5, -3.0], [0.0, 3.5]])
    z = np.repeat([1.0, -1.0], 3)
    vertices, faces = np.column_stack([x, z]), np.arange(6, dtype=np.int32).reshape(2, 3)
    height, owner = draw_from_afar(vertices, faces, np.eye(3), 10.0, 80)
    assert owner[40, 50] == 0  # x = 1, y = 0
    assert owner[40, 35] == 1  # x = -0.5
    assert height[40, 50] - height[40, 35] == 20.0
    assert owner[5, 5] == NOBODY
    behind = np.diag([1.0, -1.0, -1.0])
    _, owner = draw_from_afar(vertices, faces, behind, 10.0, 80)
    assert owner[40, 50] == owner[40, 35] == 1
