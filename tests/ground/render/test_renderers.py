"""Silhouette renderers against each other and against geometry."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Pose
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.render.projection import Window
from rendezview_ground.render.rasterizer import NumbaRenderer, NumpyRenderer, fill_silhouette
from rendezview_ground.render.renderers import Renderer, make_renderer

WINDOW = Window(90, 70, 80.0, 41.3, 36.9)


def mesh_of(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    rgb = np.full((len(faces), 3), 0.6, dtype=np.float32)
    return Mesh(np.asarray(vertices, dtype=float), np.asarray(faces, dtype=np.int32), rgb, ())


def some_pose(rng: np.random.Generator, distance: float = 4.0) -> Pose:
    rotation = Rotation.random(random_state=rng).as_matrix()
    return Pose(rotation, [*rng.uniform(-0.5, 0.5, 2), distance])


# Random vertices never put an edge on a pixel's centre exactly, where the two ways of
# rounding (a row's crossing, a half-plane's sign) may differ: so no tie is compared here.
def test_compiled_rows_and_numpy_half_planes_agree_on_every_pixel():
    rng = np.random.default_rng(0)
    lit = 0
    for count in (1, 1, 1, 4, 15, 60):
        for _ in range(12):
            vertices = rng.normal(0.0, 0.6, size=(count + 3, 3))
            mesh = mesh_of(vertices, rng.integers(0, count + 3, size=(count, 3)))
            pose = some_pose(rng)
            fast, plain = (
                NumbaRenderer(mesh).draw(pose, WINDOW),
                NumpyRenderer(mesh).draw(pose, WINDOW),
            )
            assert np.array_equal(fast, plain)
            lit += np.count_nonzero(plain)
    assert lit > 10_000


def test_triangles_partly_or_wholly_outside_the_picture_agree_too(bumpy_mesh):
    rng = np.random.default_rng(1)
    seen = []
    for _ in range(12):
        pose = Pose(some_pose(rng).rotation, [*rng.uniform(-4.0, 4.0, 2), 4.0])
        fast, plain = (r(bumpy_mesh).draw(pose, WINDOW) for r in (NumbaRenderer, NumpyRenderer))
        assert np.array_equal(fast, plain)
        seen.append(np.count_nonzero(plain))
    assert min(seen) < 0.5 * max(seen)


def test_winding_does_not_matter(bumpy_mesh):
    flipped = mesh_of(bumpy_mesh.vertices_m, bumpy_mesh.faces[:, ::-1])
    pose = some_pose(np.random.default_rng(2))
    masks = [NumbaRenderer(m).draw(pose, WINDOW) for m in (bumpy_mesh, flipped)]
    assert masks[0].any()
    assert np.array_equal(*masks)


def test_a_pixel_is_on_where_a_triangle_covers_its_centre():
    points = np.array([[0.6, 0.6], [3.4, 0.6], [3.4, 2.4], [0.6, 2.4]])
    mask = np.zeros((5, 6), np.uint8)
    fill_silhouette(points, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32), mask)
    expected = np.zeros_like(mask)
    expected[1:3, 1:4] = 255
    assert np.array_equal(mask, expected)


def test_a_square_before_the_camera_falls_where_pinhole_geometry_says():
    square = mesh_of([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    window = Window(100, 100, 50.0, 40.0, 60.0)
    mask = NumbaRenderer(square).draw(Pose(np.eye(3), [0.31, -0.17, 5.0]), window)
    rows, columns = np.nonzero(mask)
    # 40 + 50 (±1 + 0.31) / 5 and 60 + 50 (±1 − 0.17) / 5
    assert (columns.min(), columns.max()) == (34, 53)
    assert (rows.min(), rows.max()) == (49, 68)
    assert len(rows) == 20 * 20


def test_a_finer_window_covers_the_same_part_of_the_picture(bumpy_mesh):
    pose = some_pose(np.random.default_rng(3))
    coarse = NumbaRenderer(bumpy_mesh).draw(pose, WINDOW)
    fine = NumbaRenderer(bumpy_mesh).draw(pose, WINDOW.supersampled(5))
    assert fine.shape == (350, 450)
    # the centre of a pixel is the centre of its middle sub-pixel
    assert np.array_equal(fine[2::5, 2::5], coarse)


@pytest.mark.parametrize("kind", [Renderer.NUMBA, Renderer.NUMPY])
@pytest.mark.parametrize("distance", [0.3, 0.0, -5.0])
def test_a_target_at_or_behind_the_cameras_plane_is_refused(bumpy_mesh, kind, distance):
    with pytest.raises(RendezviewError, match="behind"):
        make_renderer(kind, bumpy_mesh).draw(Pose(np.eye(3), [0.0, 0.0, distance]), WINDOW)
