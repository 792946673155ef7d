"""The renderer against geometry: where things are, what hides what, what is lit."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest
import trimesh

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate.scene import sun_at_phase
from rendezview_ground.simulate.shading import ShadingOptions, render

CAMERA = Camera(96, 72, 110.0, 112.0, 46.3, 35.8)
HERE = Pose.identity()  # meshes below are given in camera coordinates
TO_CAMERA = (0.0, 0.0, -1.0)  # the Sun behind the camera
MATT = ShadingOptions(specular=0.0, ambient=0.0, shadows=False)


def mesh_of(vertices: npt.ArrayLike, faces: npt.ArrayLike, albedo: float = 0.6) -> Mesh:
    faces = np.asarray(faces, dtype=np.int32)
    return Mesh(
        np.asarray(vertices, dtype=np.float64),
        faces,
        np.full((len(faces), 3), albedo, np.float32),
        (),
    )


def quad(corners: npt.ArrayLike, albedo: float = 0.6) -> Mesh:
    return mesh_of(corners, [[0, 1, 2], [0, 2, 3]], albedo)


def square(centre: npt.ArrayLike, half_m: float, spin_rad: float = 0.0) -> Array:
    """Corners (4, 3) of a square across the boresight."""
    angles = spin_rad + math.pi / 4 + math.pi / 2 * np.arange(4)
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(4)], axis=1)
    return np.asarray(centre) + half_m * math.sqrt(2.0) * ring


def together(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(mesh.vertices_m) for mesh in meshes[:-1])])
    return Mesh(
        np.concatenate([mesh.vertices_m for mesh in meshes]),
        np.concatenate(
            [mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]
        ).astype(np.int32),
        np.concatenate([mesh.face_rgb for mesh in meshes]),
        (),
    )


def centroid(weights: npt.ArrayLike) -> Array:
    weights = np.asarray(weights, dtype=np.float64)
    rows, columns = np.indices(weights.shape)
    return np.array([(weights * columns).sum(), (weights * rows).sum()]) / weights.sum()


def ray_cast_depth(mesh: Mesh, camera: Camera, near_m: float) -> Array:
    """Plain-numpy twin: nearest z along the ray of every pixel centre (Möller–Trumbore)."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = camera.rays(np.stack([columns.ravel(), rows.ravel()], axis=1))
    nearest = np.full(len(rays), np.inf)
    for a, b, c in mesh.vertices_m[mesh.faces]:
        across = np.cross(rays, c - a)
        scale = across @ (b - a)
        u = across @ -a / scale
        q = np.cross(-a, b - a)
        v, z = rays @ q / scale, (c - a) @ q / scale
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (z >= near_m)
        nearest = np.where(hit, np.minimum(nearest, z), nearest)
    return nearest.reshape(camera.height, camera.width)


def test_depth_is_that_of_the_nearest_triangle_on_each_pixels_ray() -> None:
    rng = np.random.default_rng(5)
    centres = rng.uniform([-2, -2, 0.0], [2, 2, 6], (40, 1, 3))
    corners = (centres + rng.uniform(-1.2, 1.2, (40, 3, 3))).reshape(-1, 3)
    soup = mesh_of(corners, np.arange(120).reshape(40, 3))
    crosses = (corners.reshape(40, 3, 3)[..., 2] < 0.3).any(axis=1)
    assert 3 < crosses.sum() < 30, "some triangles reach through the near plane, not all"
    picture = render(soup, CAMERA, HERE, TO_CAMERA, ShadingOptions(samples=1, near_m=0.3))
    truth = ray_cast_depth(soup, CAMERA, 0.3)
    agree = np.isclose(picture.depth_m, truth, rtol=1e-5)  # inf equals inf
    assert agree.mean() > 0.9995, f"{(~agree).sum()} pixels differ"
    np.testing.assert_array_equal(picture.coverage > 0, np.isfinite(picture.depth_m))


def test_edges_on_sample_borders_cover_exactly_their_share_of_each_pixel() -> None:
    # Left, right, top, bottom in pixels; 4 × 4 samples: quarters of a pixel are exact.
    left, right, top, bottom, z = 10.25, 20.75, 8.0, 15.5, 4.0
    corners = [
        [(u - CAMERA.cx) / CAMERA.fx * z, (v - CAMERA.cy) / CAMERA.fy * z, z]
        for u, v in ((left, top), (right, top), (right, bottom), (left, bottom))
    ]
    # 1e-9 keeps rounding from deciding; the samples are 0.125 px from the edges.
    cover = render(quad(corners), CAMERA, HERE, TO_CAMERA, ShadingOptions(samples=4)).coverage
    across = np.zeros(CAMERA.width)
    across[10], across[11:21], across[21] = 0.25, 1.0, 0.25
    down = np.zeros(CAMERA.height)
    down[8], down[9:16] = 0.5, 1.0
    np.testing.assert_allclose(cover, np.outer(down, across), atol=1e-6)


@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.31, -0.17), (-1.4, 0.83)])
def test_a_spheres_centroid_is_that_of_its_projected_outline(offset: tuple[float, float]) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.25)
    centre = np.array([*offset, 5.0])
    options = ShadingOptions(samples=6)
    mesh = mesh_of(ball.vertices, ball.faces)
    picture = render(mesh, CAMERA, Pose(np.eye(3), centre), TO_CAMERA, options)
    # The outline is an ellipse about (XZ, YZ) / (Z² − r²), a little outside the centre's image.
    outline = centre * (5.0, 5.0, (25.0 - 0.25**2) / 5.0)
    np.testing.assert_allclose(centroid(picture.coverage), CAMERA.project(outline), atol=0.02)
    if np.hypot(*offset) < 0.4:
        np.testing.assert_allclose(centroid(picture.coverage), CAMERA.project(centre), atol=0.03)


def test_a_distorted_camera_sees_the_square_where_it_projects_it() -> None:
    camera = Camera(96, 72, 110.0, 112.0, 46.3, 35.8, (-0.25, 0.06, 0.002, -0.001))
    for centre in ([1.05, -0.7, 4.0], [-1.1, 0.6, 4.0]):
        mesh = quad(square(centre, 0.1, 0.3))
        picture = render(mesh, camera, HERE, TO_CAMERA, ShadingOptions(samples=8))
        shift = np.linalg.norm(camera.project(np.array(centre)) - CAMERA.project(np.array(centre)))
        assert shift > 0.5, "the distortion is worth the test"
        np.testing.assert_allclose(
            centroid(picture.coverage), camera.project(np.array(centre)), atol=0.02
        )


def test_a_distortion_that_cannot_be_undone_is_refused() -> None:
    camera = Camera(96, 72, 40.0, 40.0, 47.5, 35.5, (-2.0, 0.0, 0.0, 0.0))
    with pytest.raises(RendezviewError, match="distortion"):
        render(quad(square([0, 0, 4], 0.4)), camera, HERE, TO_CAMERA)


def test_the_nearer_face_hides_the_farther_one_in_any_order() -> None:
    near, far = quad(square([0, 0, 3], 0.3), 0.2), quad(square([0, 0, 5], 1.5), 0.9)
    pictures = [
        render(mesh, CAMERA, HERE, TO_CAMERA, MATT)
        for mesh in (together(near, far), together(far, near))
    ]
    np.testing.assert_allclose(pictures[0].radiance, pictures[1].radiance, atol=1e-6)
    assert pictures[0].radiance[36, 46] == pytest.approx(0.2, abs=1e-5)
    assert pictures[0].radiance[36, 46 + 20] == pytest.approx(0.9, abs=1e-5)
    assert pictures[0].depth_m[36, 46] == pytest.approx(3.0, rel=1e-5)


def test_a_floor_that_runs_behind_the_camera_reaches_the_bottom_of_the_picture() -> None:
    floor = quad([[-50, 1, -50], [50, 1, -50], [50, 1, 1000], [-50, 1, 1000]])
    picture = render(floor, CAMERA, HERE, (0, -1, 0), ShadingOptions(shadows=False))
    horizon = CAMERA.fy * 1.0 / 1000.0 + CAMERA.cy
    below = np.arange(CAMERA.height) > horizon + 1.0
    columns = slice(20, 70)
    assert (picture.coverage[below, columns] == 1.0).all()
    assert (picture.coverage[np.arange(CAMERA.height) < horizon - 1.0] == 0.0).all()
    # z = fy · height / (v − cy), the mean over the pixel's rows being near the centre's
    assert picture.depth_m[70, 46] == pytest.approx(CAMERA.fy / (70 - CAMERA.cy), rel=1e-3)


def test_nothing_is_drawn_of_a_target_behind_the_camera() -> None:
    picture = render(quad(square([0, 0, -4], 0.5)), CAMERA, HERE, TO_CAMERA)
    assert not picture.coverage.any()
    assert not picture.radiance.any()
    assert np.isinf(picture.depth_m).all()


def test_winding_does_not_matter() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.8)
    faces = ball.faces.copy()
    faces[::3] = faces[::3, ::-1]
    pose, sun = Pose(np.eye(3), [0.1, 0.2, 4.0]), (0.5, -0.3, -0.8)
    straight = render(mesh_of(ball.vertices, ball.faces), CAMERA, pose, sun)
    mixed = render(mesh_of(ball.vertices, faces), CAMERA, pose, sun)
    np.testing.assert_allclose(mixed.radiance, straight.radiance, atol=1e-5)


@pytest.mark.parametrize("incidence_rad", [0.0, 0.5, 1.2])
def test_a_matt_face_follows_lamberts_cosine(incidence_rad: float) -> None:
    sun = (math.sin(incidence_rad), 0.0, -math.cos(incidence_rad))
    picture = render(quad(square([0, 0, 4], 1.0), 0.5), CAMERA, HERE, sun, MATT)
    assert picture.radiance[36, 46] == pytest.approx(0.5 * math.cos(incidence_rad), abs=1e-5)


def test_a_sheet_lit_from_behind_is_dark_but_for_ambient_light() -> None:
    options = ShadingOptions(ambient=0.02, shadows=False)
    picture = render(quad(square([0, 0, 4], 1.0), 0.5), CAMERA, HERE, (0.2, 0.0, 1.0), options)
    assert picture.radiance[36, 46] == pytest.approx(0.5 * 0.02, abs=1e-6)


def test_the_highlight_is_where_a_mirror_would_show_the_sun() -> None:
    options = ShadingOptions(specular=1.0, shininess=400.0, ambient=0.0, shadows=False)
    # The ray of pixel (60, 30) mirrored in a plane across the boresight.
    ray = CAMERA.rays(np.array([[60.0, 30.0]]))[0]
    sun = ray * (1.0, 1.0, -1.0)
    picture = render(quad(square([0, 0, 4], 3.0), 0.1), CAMERA, HERE, sun, options)
    np.testing.assert_allclose(
        np.unravel_index(picture.radiance.argmax(), picture.radiance.shape), (30, 60), atol=1
    )
    assert picture.radiance.max() > 0.9


def test_the_day_side_of_the_earth_lights_what_faces_it() -> None:
    sheet = quad(square([0, 0, 4], 1.0), 0.5)
    options = ShadingOptions(ambient=0.0, earthshine=0.2, shadows=False)
    behind_camera, sun = (0.0, 0.0, -1.0), (0.0, 0.0, 1.0)
    day = render(sheet, CAMERA, HERE, sun, options, behind_camera).radiance[36, 46]
    assert day == pytest.approx(0.5 * 0.2, abs=1e-6)
    night = render(sheet, CAMERA, HERE, (0.0, 0.9, 0.4), options, (0.0, 1.0, 0.0))
    assert not night.radiance.any()


def shaded(mesh: Mesh, sun: npt.ArrayLike, pose: Pose = HERE, samples: int = 4) -> Array:
    """(H, W) light that shadows take away."""
    lit, dark = (
        render(
            mesh, CAMERA, pose, sun,
            ShadingOptions(samples=samples, specular=0.0, ambient=0.0, shadows=shadows),
        ).radiance
        for shadows in (False, True)
    )  # fmt: skip
    return np.asarray(lit - dark, dtype=np.float64)


@pytest.mark.parametrize("plate_x_m", [-0.8, -2.6])  # in the picture, and left of it
def test_a_shadow_falls_where_the_suns_rays_carry_it(plate_x_m: float) -> None:
    wall = quad(square([0, 0, 5], 3.5), 0.8)
    plate_m, half_m = np.array([plate_x_m, -0.3, 4.0]), 0.3
    shadow_m = np.array([0.7, 0.25, 5.0])
    sun = plate_m - shadow_m
    lost = shaded(together(wall, quad(square(plate_m, half_m))), sun)
    # A plate parallel to the wall casts its own shape.
    corners = CAMERA.project(square(shadow_m, half_m))
    (left, top), (right, bottom) = corners.min(axis=0), corners.max(axis=0)
    full = 0.8 * sun[2] / np.linalg.norm(sun) * -1.0
    # The Sun is low (67° and more off the wall's normal at worst): a texel of the shadow
    # map, a quarter of a pixel wide, is drawn out to nearly a pixel.
    np.testing.assert_allclose(centroid(lost), CAMERA.project(shadow_m), atol=0.3)
    assert lost.sum() / full == pytest.approx((right - left) * (bottom - top), rel=0.05)


def test_a_convex_body_casts_no_shadow_on_itself() -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.9)
    mesh, pose = mesh_of(ball.vertices, ball.faces), Pose(np.eye(3), [0.0, 0.0, 4.0])
    for sun in ((0.3, 0.2, -0.9), (1.0, 0.1, -0.2), (0.1, -1.0, 0.3)):
        assert np.abs(shaded(mesh, sun, pose)).max() < 0.02, sun


def test_with_the_sun_behind_a_distant_camera_no_shadow_is_seen() -> None:
    plate, wall = quad(square([-8, 0, 90], 8)), quad(square([0, 0, 100], 30))
    mesh = together(wall, plate)
    behind_camera = sun_at_phase([0, 0, 100.0], 0.0, 1.0)
    seen = np.abs(shaded(mesh, behind_camera)) > 0.05
    # The camera is not quite at infinity: a sliver of one pixel beside the plate may show.
    assert seen.mean() < 0.005
    aside = np.abs(shaded(mesh, sun_at_phase([0, 0, 100.0], 0.8, 0.0))) > 0.05
    assert aside.mean() > 0.02, "the same plate does cast a shadow from aside"


@pytest.mark.parametrize("sun", [(0.0, 0.0, 0.0), (1.0, math.nan, 0.0), (1.0, 0.0)])
def test_a_sun_without_a_direction_is_a_value_error(sun: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="sun_direction_camera"):
        render(quad(square([0, 0, 4], 0.4)), CAMERA, HERE, sun)
