"""The compiled loops of training against plain numpy."""

from __future__ import annotations

import numpy as np
import pytest

from rendezview.geometry.pose import Pose
from rendezview.geometry.zbuffer import draw_parallel, empty_buffers
from rendezview_ground.learn.options import TrainingOptions, view_geometry
from rendezview_ground.learn.views.contours import _free_runs
from rendezview_ground.learn.views.drawn_view import DrawnView, draw_view
from rendezview_ground.learn.views.edge_profiles import _joined
from rendezview_ground.learn.views.perturbed_views import exposed
from rendezview_ground.learn.views.surface_points import _look_up, candidate_points
from rendezview_ground.render.crossings import (
    KIND,
    STEP_RADII,
    depth_on,
    edge_crossings,
    edge_pixels,
    face_normals,
    faces_beside,
    line_in_face,
)
from rendezview_ground.render.curve import evenly_spread
from rendezview_ground.render.faces_along import faces_along, scratch_for
from rendezview_ground.render.projection import Window, project_vertices

OPTIONS = TrainingOptions(surface_points=200)


@pytest.fixture(scope="module")
def view(bumpy_mesh) -> DrawnView:
    geometry = view_geometry(bumpy_mesh, OPTIONS, None)
    direction = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
    return draw_view(bumpy_mesh, geometry, direction, geometry.sphere_radius_m, 96, 4.0)


def random_triangles(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.uniform(-4.0, 28.0, (count, 3, 2))


def test_projection_is_that_of_a_pinhole(bumpy_mesh):
    rng = np.random.default_rng(0)
    pose = Pose.from_quat_wxyz(rng.normal(size=4), np.array([0.1, -0.2, 9.0]))
    window = Window(64, 48, 55.0, 30.5, 21.0)
    points = bumpy_mesh.vertices_m @ pose.rotation.T + pose.translation_m
    plain = points[:, :2] / points[:, 2:] * 55.0 + [30.5, 21.0]
    assert np.allclose(project_vertices(bumpy_mesh.vertices_m, pose, window), plain, atol=1e-12)


def test_the_z_buffer_keeps_the_greatest_w_of_all_triangles_over_a_sample():
    rng = np.random.default_rng(1)
    corners = random_triangles(rng, 20)
    w = rng.uniform(0.1, 1.0, (20, 3))
    vertices = np.concatenate([corners, w[..., None]], axis=2).reshape(-1, 3)
    nearness, owner = empty_buffers(24, 26)
    draw_parallel(vertices, np.arange(60, dtype=np.int32).reshape(-1, 3), nearness, owner)
    rows, columns = np.mgrid[0:24, 0:26]
    samples = np.stack([columns.ravel(), rows.ravel(), np.ones(24 * 26)])
    best, face = np.zeros(24 * 26), np.full(24 * 26, -1)
    for k in range(20):
        barycentric = np.linalg.solve(np.vstack([corners[k].T, np.ones(3)]), samples)
        depth = w[k] @ barycentric
        closer = (barycentric >= 0.0).all(axis=0) & (depth > best)
        best[closer], face[closer] = depth[closer], k
    assert np.count_nonzero(face >= 0) > 300
    assert np.array_equal(owner.ravel(), face)
    assert np.allclose(nearness.ravel(), best, atol=1e-6)  # kept in single precision


def test_a_line_is_clipped_at_the_half_planes_of_a_face():
    rng = np.random.default_rng(2)
    faces = np.array([[0, 1, 2]], dtype=np.int32)
    hits = 0
    for points in random_triangles(rng, 300):
        p, d = rng.uniform(0.0, 24.0, 2), rng.normal(size=2)
        enter, leave, edge = line_in_face(points, faces, 0, *p, *d)
        along = np.roll(points, -1, axis=0) - points
        turn = np.sign(np.linalg.det(np.stack([along[0], points[2] - points[0]])))
        normals = turn * np.stack([-along[:, 1], along[:, 0]], axis=1)  # inwards
        crossing = np.sum(normals * (points - p), axis=1) / (normals @ d)
        entering = normals @ d > 0.0
        assert enter == pytest.approx(crossing[entering].max(), rel=1e-9)
        assert leave == pytest.approx(crossing[~entering].min(), rel=1e-9)
        assert edge == np.flatnonzero(~entering)[np.argmin(crossing[~entering])]
        hits += enter < leave
    assert hits > 50


def test_a_ray_meets_the_plane_of_a_face_where_the_equations_say():
    rng = np.random.default_rng(3)
    for _ in range(50):
        vertices = rng.normal((0.0, 0.0, 6.0), 1.0, (3, 3))
        ray = np.array([*rng.uniform(-0.3, 0.3, 2), 1.0])
        normals = face_normals(vertices, np.array([[0, 1, 2]], dtype=np.int32))
        a, b, c = vertices
        z = np.linalg.solve(np.stack([ray, a - b, a - c], axis=1), a)[0]
        found = depth_on(vertices, np.array([[0, 1, 2]], dtype=np.int32), 0, normals, *ray[:2])
        assert found == pytest.approx(z, rel=1e-9)


def test_normals_of_faces_are_unit_and_look_at_the_camera(view):
    corners = view.vertices[view.faces]
    plain = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    plain /= np.linalg.norm(plain, axis=1)[:, None]
    plain[np.sum(plain * corners[:, 0], axis=1) > 0.0] *= -1.0
    assert np.allclose(face_normals(view.vertices, view.faces), plain, atol=1e-12)
    flat = face_normals(np.ones((3, 3)), np.array([[0, 1, 2]], dtype=np.int32))
    assert flat.tolist() == [[0.0, 0.0, -1.0]]


def test_places_are_spread_evenly_over_the_length_of_a_line_and_over_the_plane():
    rng = np.random.default_rng(8)
    u = rng.permutation(2000).astype(np.int32)
    chosen = evenly_spread(u, np.full(2000, 40, np.int32), np.ones(2000), 100)
    assert len(chosen) == 100
    assert np.all(np.diff(chosen) > 0)
    assert np.diff(np.sort(u[chosen])).max() <= 32  # px; 20 on average, in cells of 4 px
    assert evenly_spread(u[:50], u[:50], np.ones(50), 100).tolist() == list(range(50))
    u, v = rng.integers(0, 800, (2, 20_000), dtype=np.int32)
    length = np.where(u < 400, 3.0, 1.0)  # three quarters of the length lie on the left
    chosen = evenly_spread(u, v, length, 640)
    assert 620 <= len(chosen) <= 640
    cells = np.bincount(u[chosen] // 100 + 8 * (v[chosen] // 100), minlength=64).reshape(8, 8)
    assert np.all(np.abs(cells[:, :4] - 15) <= 7)
    assert np.all(np.abs(cells[:, 4:] - 5) <= 4)


def test_faces_along_a_line_are_the_nearest_at_each_place(bumpy_mesh, view):
    """Against every face of the mesh, place by place; the sky's border is the z-buffer's."""
    normals = face_normals(view.vertices, view.faces)
    places = np.linspace(-3.0, 9.0, 49)
    scratch = scratch_for(len(places), len(view.faces))
    p, q, r = (view.points[view.faces[:, k], :2] for k in range(3))
    plane = np.sum(normals * view.vertices[view.faces[:, 0]], axis=1)
    rng = np.random.default_rng(8)
    agree = total = 0
    for y, x in rng.permutation(np.argwhere(view.owner >= 0))[:60]:
        turn = rng.uniform(0.0, 2.0 * np.pi)
        line = np.array([x, y, np.cos(turn), np.sin(turn)])
        faces_along(
            line, places, view.vertices, view.points, view.faces, faces_beside(bumpy_mesh),
            view.focal, view.middle, view.owner, normals, scratch,
        )  # fmt: skip
        for i, place in enumerate(places):
            at = line[:2] + place * line[2:]
            sides = [
                np.linalg.det(np.stack([b - a, at - a], -2)) for a, b in ((p, q), (q, r), (r, p))
            ]
            inside = np.all(np.array(sides) >= 0, axis=0) | np.all(np.array(sides) <= 0, axis=0)
            ray = np.array([*(at - view.middle) / view.focal, 1.0])
            near = np.where(inside, (normals @ ray) / plane, 0.0)
            best = int(np.argmax(near)) if near.max() > 0.0 else -1
            total += 1
            same = scratch.visible[i] == best
            if same and best >= 0:
                assert scratch.nearness[i] == pytest.approx(near[best], rel=1e-9)
            agree += bool(same)
    assert agree > 0.99 * total


def test_edges_between_pixels_are_outlines_steps_and_creases(bumpy_mesh, view):
    albedo = np.random.default_rng(4).uniform(0.1, 0.9, len(view.faces))
    normals = face_normals(view.vertices, view.faces)
    step = STEP_RADII * view_geometry(bumpy_mesh, OPTIONS, None).target_radius_m
    owner, near = view.owner, view.nearness.astype(float)
    y, x = (index[1:-1, 1:-1] for index in np.indices(owner.shape))
    face = owner[1:-1, 1:-1]
    found, expected = dict.fromkeys(range(3), 0), set()
    for dx, dy in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        beyond = owner[y + dy, x + dx]
        rays = np.stack([x + dx - view.middle, y + dy - view.middle, 0 * x + view.focal], -1)
        n = normals[face]
        plane = np.sum(n * view.vertices[view.faces[face, 0]], axis=-1)
        z_here = plane / np.sum(n * rays / view.focal, axis=-1)
        z_there = 1.0 / np.maximum(near[y + dy, x + dx], 1e-9)  # the sky lies far away
        z_own = 1.0 / np.maximum(near[y, x], 1e-9)
        gap = z_there - z_own
        is_step = (gap > step) & ((z_here <= 0.0) | (z_there - z_here > step))
        cosine = np.sum(n * normals[beyond], axis=-1)
        bent = (cosine <= np.cos(np.deg2rad(30.0))) | (abs(albedo[face] - albedo[beyond]) >= 0.12)
        crease = ~is_step & (dx + dy > 0) & (abs(gap) < step) & bent
        plain = np.where(beyond < 0, 0, np.where(is_step, 1, np.where(crease, 2, -1)))
        for i, j in np.argwhere((face >= 0) & (beyond != face) & (plain >= 0)):
            side = ((1, 0), (0, 1), (-1, 0), (0, -1)).index((dx, dy))
            expected.add((int(x[i, j]), int(y[i, j]), side, int(plain[i, j])))
            found[int(plain[i, j])] += 1
    pixels, marks = edge_pixels(
        view.vertices, view.faces, normals, albedo, view.focal, view.middle, view.nearness, owner,
        step,
    )  # fmt: skip
    assert {tuple(row) for row in pixels.tolist()} == expected
    assert len(pixels) == len(expected)
    assert {(int(c), int(r)) for r, c in np.argwhere(marks)} == {e[:2] for e in expected}
    assert min(found[0], found[2]) > 50


def test_crossings_lie_on_edges_of_the_mesh_and_project_to_their_pixels(bumpy_mesh, view):
    normals = face_normals(view.vertices, view.faces)
    pixels, _ = edge_pixels(
        view.vertices, view.faces, normals, bumpy_mesh.face_albedo, view.focal, view.middle,
        view.nearness, view.owner, 0.02,
    )  # fmt: skip
    rows = edge_crossings(
        view.vertices, view.points, view.faces, normals, faces_beside(bumpy_mesh), pixels,
        view.focal, view.middle, view.nearness, view.owner, 0.02,
    )  # fmt: skip
    assert len(rows) > 100
    assert set(rows[:, KIND]) <= {0.0, 1.0, 2.0}
    pixels = rows[:, 2:4] / rows[:, 4:5] * view.focal + view.middle
    assert np.allclose(pixels, rows[:, :2], atol=1e-9)
    ends = np.concatenate([view.vertices[view.faces[:, [k, (k + 1) % 3]]] for k in range(3)])
    a, along = ends[:, 0], ends[:, 1] - ends[:, 0]
    for row in rows[:: len(rows) // 50]:
        share = np.sum((row[2:5] - a) * along, axis=1) / np.sum(along**2, axis=1)
        foot = a + np.clip(share, 0.0, 1.0)[:, None] * along
        nearest = int(np.argmin(np.linalg.norm(foot - row[2:5], axis=1)))
        assert np.linalg.norm(foot[nearest] - row[2:5]) < 1e-6
        direction = along[nearest] / np.linalg.norm(along[nearest])
        assert abs(direction @ row[5:8]) == pytest.approx(1.0, abs=1e-6)


def test_points_are_visible_where_their_face_owns_a_pixel_around(bumpy_mesh, view):
    geometry = view_geometry(bumpy_mesh, OPTIONS, None)
    points, faces = candidate_points(bumpy_mesh, geometry, OPTIONS)
    places = points @ view.rotation.T + np.array([0.0, 0.0, geometry.sphere_radius_m])
    visible = _look_up(places, faces, view.focal, view.middle, view.owner)
    pixels = (places[:, :2] / places[:, 2:] * view.focal + view.middle + 0.5).astype(int)
    plain = [
        np.any(view.owner[row - 1 : row + 2, column - 1 : column + 2] == face)
        for (column, row), face in zip(pixels, faces, strict=True)
    ]
    assert np.array_equal(visible, plain)
    assert 0.2 < visible.mean() < 0.8


def test_free_runs_end_at_the_next_edge_along_the_normal():
    edges = np.zeros((41, 61), dtype=np.bool_)
    edges[:, 30] = edges[:, 44] = True
    nearness = np.full(edges.shape, 0.5, dtype=np.float32)
    # An inner crease at column 30 that runs downwards: outwards is to the left.
    point = np.array([[30.0, 20.0, 0.0, 0.0, 2.0, 0.0, -1.0, 0.0, 2.0, 1.0]])
    runs = _free_runs(point, 50.0, edges, nearness, 0.01, 25.0)
    steps = np.arange(2.5, 25.0, 0.5)
    assert runs[0, 0] == steps[np.rint(30.0 + steps) == 44][0]
    assert runs[0, 1] == 25.0


def merged(samples: np.ndarray, weights: np.ndarray, most: int) -> list[int]:
    """Plain twin of `_joined` at one depth: Ward's merging of neighbours."""
    parts = [[k] for k in range(len(samples))]
    means = [s.copy() for s in samples]
    totals = list(weights)
    brightest = samples[:, 3].max()
    while len(parts) > 1:
        costs = []
        for i in range(len(parts) - 1):
            low, high = sorted((means[i][3], means[i + 1][3]))
            apart = np.sum((means[i] - means[i + 1]) ** 2)
            cost = apart * totals[i] * totals[i + 1] / (totals[i] + totals[i + 1])
            costs.append(np.inf if low < 1e-6 and high > 0.25 * brightest else cost)
        i = int(np.argmin(costs))
        if not np.isfinite(costs[i]) or (len(parts) <= most and costs[i] > 1e-4 / 196.0):
            break
        total = totals[i] + totals[i + 1]
        means[i] = (totals[i] * means[i] + totals[i + 1] * means[i + 1]) / total
        totals[i], parts[i] = total, parts[i] + parts[i + 1]
        del means[i + 1], totals[i + 1], parts[i + 1]
    return [part[0] for part in parts]


def test_stretches_of_a_profile_are_merged_as_ward_says():
    rng = np.random.default_rng(5)
    for _ in range(30):
        levels = np.repeat(rng.uniform(0.0, 1.0, (6, 4)), rng.integers(1, 9, 6), axis=0)
        samples = levels + 0.02 * rng.normal(size=levels.shape)
        samples[: rng.integers(0, 4)] = 0.0  # sky
        weights = rng.uniform(0.001, 0.01, len(samples))
        depth = np.full(len(samples), 3.0)
        found = _joined(samples, depth, weights, 3, 0.1)
        assert found.tolist() == merged(samples, weights, 3)


def test_an_exposed_frame_has_gain_sky_noise_and_eight_bits():
    rng = np.random.default_rng(6)
    cover = rng.integers(0, 256, (17, 23), dtype=np.uint8)
    tile = np.rint(256.0 * rng.standard_normal((16, 16))).astype(np.int16)
    found = exposed(cover, 0.9, 12.0, 30.0, tile, 5, 11)
    rows, columns = np.indices(cover.shape)
    noise = tile[(rows + 5) % 16, (columns + 11) % 16] / 256.0
    value = np.clip(cover * 0.9 + 12.0 + 30.0 * noise, 0.0, 255.0)
    assert np.abs(found - value).max() <= 0.51
    assert len(np.unique(found[found < 255])) > 50
