"""The compiled loops of alignment on a sketch, against plain numpy."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.geometry.lens import lens_vector
from rendezview.geometry.pose import Pose
from rendezview.geometry.zbuffer import draw_perspective, empty_buffers
from rendezview.sensors.appearance.edges.alignment import nearest_views
from rendezview.sensors.appearance.edges.predicted import (
    COLUMNS,
    FOUND,
    NX,
    NY,
    OUTSIDE,
    RESIDUAL,
    STATE,
    U,
    V,
)
from rendezview.sensors.appearance.edges.refinement import Refiner
from rendezview.sensors.appearance.edges.sketch import (
    Maps,
    align_all_to_sketch,
    align_to_sketch,
    lies_in,
    likeliest_edge,
    measure_sketch,
    predict_view,
    read_line,
    read_map,
    sketch_agreement,
)
from rendezview.sensors.appearance.judge.explained import explained_share
from rendezview.sensors.appearance.model.contours import CREASE, NO_POINT, OUTLINE
from rendezview_ground.learn.views.sketch_maps import SAMPLES, sketch_maps
from rendezview_ground.render.crossings import face_normals

STAGES = np.array([[10.0, 5.0, 6.0, 1.0, 0.5], [4.0, 2.0, 6.0, 1.0, 0.5]])


@pytest.fixture(scope="module")
def ideal(bumpy_mesh, refining_model, camera):
    """Maps as a perfect network would draw them at a pose, over the whole frame at half scale."""
    rotation = Rotation.from_rotvec([0.4, -0.7, 0.2]).as_matrix()
    centre = np.array([0.1, -0.05, 1.5 * refining_model.sphere_radius_m])
    pose = Pose(rotation, centre - rotation @ refining_model.centre_m)
    scale, n = 0.5, SAMPLES
    size = int(camera.width * scale)
    vertices = np.ascontiguousarray(pose.apply(bumpy_mesh.vertices_m))
    near, owner = empty_buffers(size * n, size * n)
    f = camera.fx * scale * n
    c = (camera.cx + 0.5) * scale * n - 0.5
    draw_perspective(vertices, bumpy_mesh.faces, f, f, c, c, 0.01, near, owner)
    normals = face_normals(vertices, bumpy_mesh.faces).astype(np.float32)
    drawn = sketch_maps(near, owner, normals, refining_model.target_radius_m)
    soft = [cv2.GaussianBlur(m, (0, 0), 0.7) for m in drawn]
    shift = 0.5 * scale - 0.5
    maps = Maps(drawn[0], soft[1], np.maximum(soft[2], 0.5 * soft[1]))
    lens = (lens_vector(camera), camera.is_distorted)
    lens[0][:4] *= scale
    lens[0][2:4] += shift
    return pose, maps, lens, Refiner(refining_model, camera).views


def test_read_map_is_bilinear_and_minus_one_outside():
    plane = np.random.default_rng(1).random((5, 7)).astype(np.float32)
    x, y = 2.25, 3.5
    corners = plane[3:5, 2:4]
    expected = np.array([0.5, 0.5]) @ corners @ np.array([0.75, 0.25])
    assert read_map(plane, x, y) == pytest.approx(expected, rel=1e-6)
    assert lies_in(plane, x, y)
    for place in ((-0.1, 1.0), (6.0, 1.0), (1.0, 4.0), (np.nan, 1.0)):
        assert read_map(plane, *place) == -1.0
        assert not lies_in(plane, *place)


def test_read_line_is_read_map_along_a_normal():
    plane = np.random.default_rng(2).random((40, 50)).astype(np.float32)
    line = np.empty(15, np.float32)
    inside, outside = ((20.3, 17.8, 0.6, 0.8), (31.0, 21.5, -0.8, 0.6)), (3.2, 30.1, 0.8, 0.6)
    for x, y, nx, ny in (*inside, outside):
        read_line(plane, x, y, nx, ny, 7, line)
        expected = [read_map(plane, x + k * nx, y + k * ny) for k in range(-7, 8)]
        assert line == pytest.approx(expected, abs=1e-5)
    assert line[0] == -1.0
    assert line[7] > 0.0


def test_likeliest_edge_finds_the_ridge_and_wants_the_target_inside():
    x = np.arange(60.0)
    plane = np.tile(np.exp(-0.5 * ((x - 33.3) / 1.2) ** 2), (40, 1)).astype(np.float32)
    cover = np.tile(x < 33.3, (40, 1)).astype(np.float32)
    row, line = np.zeros(COLUMNS), np.empty(19, np.float32)

    def likeliest(nx: float, plane: np.ndarray, outline: bool) -> tuple[float, float]:
        row[[U, V, NX, NY]] = 30.0, 20.0, nx, 0.0
        read_line(plane, *row[[U, V, NX, NY]], 9, line)
        return likeliest_edge(line, cover, row, 8, 5.0, outline)

    at, score = likeliest(1.0, plane, True)
    assert at == pytest.approx(3.3, abs=0.1)
    _, wrong = likeliest(-1.0, plane, True)  # the target would be outside
    assert wrong < 0.1 * score
    assert likeliest(1.0, np.zeros_like(plane), False) == (0.0, 0.0)


def test_the_view_that_is_predicted_is_the_nearest_one(ideal, refining_model):
    pose, _, lens, views = ideal
    for view in (0, 7, 30):
        eye = views.shells_m[1] * views.directions[view]
        edges = np.zeros((views.point.shape[2], COLUMNS))
        seen = predict_view(lens, views, pose.rotation.copy(), -pose.rotation @ eye, 1, edges)
        assert seen == (1, view, np.count_nonzero(views.kind[1, view] != NO_POINT))


def test_the_points_of_the_true_pose_lie_on_the_edges_of_its_maps(ideal, refining_model):
    pose, maps, lens, views = ideal
    edges = np.zeros((views.point.shape[2], COLUMNS))
    centre = pose.apply(refining_model.centre_m)
    count = measure_sketch(maps, lens, views, pose.rotation.copy(), centre, 6, 3.0, 1, 1.0, edges)
    found = edges[:count][edges[:count, STATE] == FOUND]
    assert len(found) > 0.7 * count
    # The views of this small model are 8° apart: that far its outline may lie aside.
    assert abs(np.median(found[:, RESIDUAL])) < 0.7


def test_alignment_comes_back_from_five_degrees(ideal, refining_model):
    pose, maps, lens, views = ideal
    centre = pose.apply(refining_model.centre_m)
    edges = np.zeros((views.point.shape[2], COLUMNS))
    rng = np.random.default_rng(5)
    rotations = [
        Rotation.from_rotvec(np.deg2rad(5.0) * v / np.linalg.norm(v)).as_matrix() @ pose.rotation
        for v in rng.standard_normal((6, 3))
    ]
    scores = np.empty((6, 4))
    all_rotations, all_centres = np.array(rotations), np.tile(1.02 * centre, (6, 1))
    align_all_to_sketch(maps, lens, views, STAGES, all_rotations, all_centres, scores)
    errors = []
    for k, rotation in enumerate(rotations):
        at = 1.02 * centre
        assert align_to_sketch(maps, lens, views, STAGES, rotation, at, edges)
        assert np.array_equal(rotation, all_rotations[k])
        agreement = sketch_agreement(maps, lens, views, rotation, at, 1, edges)
        assert scores[k] == pytest.approx(agreement)
        errors.append(np.rad2deg(Rotation.from_matrix(rotation @ pose.rotation.T).magnitude()))
        assert np.linalg.norm(at - centre) < 0.02 * np.linalg.norm(centre)
    assert np.median(errors) < 2.5
    assert np.max(scores[:, 0]) > 0.5


@pytest.mark.parametrize("stride", [1, 4])
def test_a_pose_is_scored_at_every_so_many_th_point(ideal, refining_model, stride):
    pose, maps, lens, views = ideal
    centre = pose.apply(refining_model.centre_m)
    edges = np.zeros((views.point.shape[2], COLUMNS))
    count = measure_sketch(maps, lens, views, pose.rotation.copy(), centre, 1, 1.0, 1, 1.0, edges)
    nearest = np.zeros(1, dtype=np.int64)
    shell = nearest_views(views.directions, views.shells_m, pose.rotation.copy(), centre, nearest)
    some = edges[:count:stride].copy()
    kinds = views.kind[shell, nearest[0], :count:stride]
    outer = kinds == OUTLINE
    u, v, nx, ny = some[:, [U, V, NX, NY]].T
    planes = np.where((kinds == CREASE)[:, None, None], maps.crease, maps.edge)
    at = np.array([read_map(plane, x, y) for plane, x, y in zip(planes, u, v, strict=True)])
    seen = (at >= 0.0) & (some[:, STATE] != OUTSIDE)
    step = [
        read_map(maps.cover, x - 4.0 * a, y - 4.0 * b)
        - read_map(maps.cover, x + 4.0 * a, y + 4.0 * b)
        for x, y, a, b in zip(u, v, nx, ny, strict=True)
    ]
    expected = (
        at[outer & seen].mean(), at[~outer & seen].mean(),
        np.array(step)[outer & seen].mean(), np.mean(seen[outer]),
    )  # fmt: skip
    scored = sketch_agreement(maps, lens, views, pose.rotation.copy(), centre, stride, edges)
    assert scored == pytest.approx(expected, abs=1e-6)


def test_no_edges_are_no_hold(ideal, refining_model):
    pose, maps, lens, views = ideal
    empty = maps._replace(edge=np.zeros_like(maps.edge), crease=np.zeros_like(maps.crease))
    edges = np.zeros((views.point.shape[2], COLUMNS))
    centre = pose.apply(refining_model.centre_m)
    rotation = pose.rotation.copy()
    assert not align_to_sketch(empty, lens, views, STAGES, rotation, centre, edges)


@pytest.fixture
def explained(ideal):
    """Of lines (h, w), the share that an attitude explains; the view centre stays."""
    _, _, lens, views = ideal

    def share(lines: np.ndarray, rotation: np.ndarray, centre: np.ndarray) -> float:
        lines = (lines / lines.sum()).astype(np.float32)
        seen = np.full(lines.shape, 7, np.uint8)  # what another pose left there does not matter
        return explained_share(lines, lens, views, rotation.copy(), centre, seen)

    return share


def test_the_true_pose_explains_the_lines_of_a_sketch(ideal, refining_model, explained):
    pose, maps, _, _ = ideal
    lines = maps.edge**2 + maps.crease**2
    centre = pose.apply(refining_model.centre_m)
    right = explained(lines, pose.rotation, centre)
    assert 0.7 < right <= 1.0 + 1e-6
    turns = (np.deg2rad(turn) * axis for turn in (25.0, 90.0, 180.0) for axis in np.eye(3))
    wrong = [explained(lines, Rotation.from_rotvec(t).as_matrix() @ pose.rotation, centre)
             for t in turns]  # fmt: skip
    assert max(wrong) < 0.75 * right


def test_lines_without_an_edge_of_the_model_are_not_explained(ideal, refining_model, explained):
    pose, maps, _, _ = ideal
    lines = (maps.edge**2 + maps.crease**2).copy()
    centre = pose.apply(refining_model.centre_m)
    alone = explained(lines, pose.rotation, centre)
    beside = np.zeros_like(lines)
    beside[2, 5:-5] = lines.sum() / (lines.shape[1] - 10)  # at the border, where no target is
    assert explained(lines + beside, pose.rotation, centre) == pytest.approx(0.5 * alone, rel=1e-4)
    assert explained(beside, pose.rotation, centre) == 0.0
    behind = centre * np.array([1.0, 1.0, -1.0])
    assert explained(lines, pose.rotation, behind) == 0.0


def test_a_strip_counts_each_pixel_once(ideal, refining_model, explained):
    pose, maps, _, _ = ideal
    lines = np.ones_like(maps.edge)
    share = explained(lines, pose.rotation, pose.apply(refining_model.centre_m))
    pixels = share * lines.size
    assert pixels == pytest.approx(round(pixels), abs=0.01)
    assert 500 < pixels < 0.2 * lines.size


def test_the_strips_lie_on_the_contour_points_to_half_a_pixel(ideal, refining_model):
    pose, maps, lens, views = ideal
    centre = pose.apply(refining_model.centre_m)
    seen = np.zeros(maps.edge.shape, np.uint8)
    explained_share(maps.edge, lens, views, pose.rotation.copy(), centre, seen)
    edges = np.zeros((views.point.shape[2], COLUMNS))
    count = measure_sketch(maps, lens, views, pose.rotation.copy(), centre, 1, 1.0, 1, 1.0, edges)
    height, width = seen.shape
    down, right = np.mgrid[:height, :width]

    def around(points: np.ndarray, along_px: float, across_px: float) -> np.ndarray:
        """The pixels whose centres lie in a strip about one of the points."""
        inside = np.zeros(seen.shape, dtype=bool)
        for u, v, nx, ny in points:
            x, y = right - u, down - v
            inside |= (np.abs(nx * y - ny * x) <= along_px) & (np.abs(nx * x + ny * y) <= across_px)
        return inside

    points = edges[:count, [U, V, 11, 12]]
    # A pixel that is touched has its centre at most half a diagonal beside the strip.
    assert not (seen.astype(bool) & ~around(points, 5.61, 2.81)).any()
    assert not (around(points, 4.8, 2.0) & (seen == 0)).any()
    for aside in ([0.5, 0.0], [0.0, 0.5], [-0.5, 0.0], [0.0, -0.5]):
        moved = points + np.array([*aside, 0.0, 0.0])
        assert (seen.astype(bool) & ~around(moved, 5.61, 2.81)).any()
