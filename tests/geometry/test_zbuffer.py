"""The z-buffer: which of several triangles a sample shows."""

from __future__ import annotations

import numpy as np

from rendezview.geometry.zbuffer import NOBODY, draw_chosen, empty_buffers, fill_triangle


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
