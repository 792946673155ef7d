"""The camera model against OpenCV."""

import math

import cv2
import numpy as np
import pytest

from rendezview.geometry.camera import Camera, LensModel
from rendezview.geometry.lens import distorted, lens_vector

PLAIN = Camera(640, 480, 800.0, 810.0, 310.0, 245.0)
FOUR = Camera(640, 480, 800.0, 810.0, 310.0, 245.0, (-0.3, 0.1, 0.001, -0.002))
FIVE = Camera(640, 480, 800.0, 810.0, 310.0, 245.0, (-0.3, 0.1, 0.001, -0.002, 0.02))
EIGHT = Camera(
    640, 480, 800.0, 810.0, 310.0, 245.0, (0.1, -0.2, 0.001, -0.002, 0.03, 0.4, -0.1, 0.02)
)
PRISM = (*EIGHT.distortion, 0.01, -0.02, 0.005, 0.03)
TWELVE = Camera(640, 480, 800.0, 810.0, 310.0, 245.0, PRISM)
FOURTEEN = Camera(640, 480, 800.0, 810.0, 310.0, 245.0, (*PRISM, 0.04, -0.03))
FISHEYE = Camera(
    640, 480, 320.0, 325.0, 310.0, 245.0, (0.02, -0.01, 0.003, -0.001), LensModel.FISHEYE
)
POLYNOMIALS = (PLAIN, FOUR, FIVE, EIGHT, TWELVE, FOURTEEN)
ALL = pytest.mark.parametrize(
    "camera", [*POLYNOMIALS, FISHEYE], ids=["0", "4", "5", "8", "12", "14", "fisheye"]
)


def grid(camera):
    u, v = np.meshgrid(
        np.linspace(-0.5, camera.width - 0.5, 13), np.linspace(-0.5, camera.height - 0.5, 11)
    )
    return np.column_stack([u.ravel(), v.ravel()])


@pytest.mark.requirement("RV-CAM-1")
@pytest.mark.parametrize("camera", POLYNOMIALS)
def test_projection_is_that_of_opencv(camera):
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.3, 0.3, (200, 2)), np.ones(200)])
    points *= rng.uniform(1.0, 50.0, (200, 1))
    coefficients = np.array(camera.distortion) if camera.distortion else None
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, coefficients)
    np.testing.assert_allclose(camera.project(points), expected[:, 0], atol=1e-9)


def test_a_fisheye_is_that_of_opencv():
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-4.0, 4.0, (200, 2)), np.ones(200)])
    expected, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), FISHEYE.matrix, np.array(FISHEYE.distortion)
    )
    np.testing.assert_allclose(FISHEYE.project(points), expected[:, 0], atol=1e-9)


@ALL
def test_the_compiled_lens_is_the_cameras(camera):
    rng = np.random.default_rng(2)
    points = np.column_stack([rng.uniform(-0.4, 0.4, (100, 2)), np.ones(100)])
    points[0, :2] = 0.0
    lens = lens_vector(camera)
    through = np.array([distorted(x, y, lens) for x, y, _ in points])
    np.testing.assert_allclose(
        through * (camera.fx, camera.fy) + (camera.cx, camera.cy), camera.project(points), atol=1e-9
    )


def test_a_fisheye_that_turns_back_has_no_pixels_beyond():
    # θ (1 − 0.2 θ²) is largest at θ = 1.29 rad: directions beyond would fold back.
    lens = Camera(640, 480, 200.0, 200.0, 319.5, 239.5, (-0.2, 0.0, 0.0, 0.0), LensModel.FISHEYE)
    inside, outside = math.tan(1.25), math.tan(1.35)
    assert np.isfinite(lens.project([inside, 0.0, 1.0])).all()
    assert np.isnan(lens.project([outside, 0.0, 1.0])).all()
    assert np.isnan(distorted(outside, 0.0, lens_vector(lens))).all()
    np.testing.assert_allclose(
        lens.rays(lens.project([[inside, 0.0, 1.0]])), [[inside, 0.0, 1.0]], rtol=1e-9
    )
    assert np.isnan(lens.rays([[319.5 + 200.0, 239.5]])[0, :2]).all()


def test_a_fisheye_of_half_the_sky_has_a_finite_cone():
    wide = Camera(640, 480, 150.0, 150.0, 319.5, 239.5, (0.0,) * 4, LensModel.FISHEYE)
    assert wide.half_fov_rad == pytest.approx(math.radians(80.0))
    narrow = Camera(640, 480, 600.0, 600.0, 319.5, 239.5, (0.0,) * 4, LensModel.FISHEYE)
    assert narrow.half_fov_rad == pytest.approx(240.0 / 600.0)


@ALL
def test_a_region_and_binned_pixels_see_the_same_directions(camera):
    region = camera.cropped(40, 30, 500, 400)
    pixels = np.array([[10.0, 20.0], [300.0, 200.5], [499.0, 399.0]])
    np.testing.assert_allclose(
        region.rays(pixels), camera.rays(np.add(pixels, (40.0, 30.0))), atol=1e-12
    )
    binned = camera.binned(4, 2)
    assert (binned.width, binned.height) == (160, 240)
    # The middle of binned pixel (0, 0) is between columns 1 and 2, rows 0 and 1.
    np.testing.assert_allclose(
        binned.rays([[0.0, 0.0], [3.0, 5.0]]), camera.rays([[1.5, 0.5], [13.5, 10.5]]), atol=1e-12
    )


def test_regions_outside_the_picture_are_refused():
    for region in ((-1, 0, 10, 10), (0, 0, 641, 10), (600, 0, 41, 10), (0, 0, 0, 10)):
        with pytest.raises(ValueError, match="is not inside a picture of 640 × 480"):
            PLAIN.cropped(*region)
    with pytest.raises(ValueError, match="binning must be"):
        PLAIN.binned(0)


def test_the_pinhole_of_a_camera_has_no_lens():
    assert FISHEYE.is_distorted
    assert FISHEYE.pinhole == Camera(640, 480, 320.0, 325.0, 310.0, 245.0)


@ALL
def test_projecting_the_ray_of_a_pixel_gives_the_pixel(camera):
    pixels = grid(camera)
    rays = camera.rays(pixels)
    assert (rays[:, 2] == 1.0).all()
    np.testing.assert_allclose(camera.project(7.0 * rays), pixels, atol=1e-8)


@pytest.mark.requirement("RV-CAM-1")
def test_pixel_zero_is_the_centre_of_the_top_left_pixel():
    camera = Camera.from_fov(4, 2, math.pi / 2)
    assert (camera.cx, camera.cy, camera.fx, camera.fy) == pytest.approx((1.5, 0.5, 2.0, 2.0))
    left_border = camera.rays([[-0.5, 0.5]])[0]
    assert math.atan(left_border[0]) == pytest.approx(-math.pi / 4)
    np.testing.assert_allclose(camera.project([-1.0, 0.0, 1.0]), [-0.5, 0.5], atol=1e-12)


@ALL
def test_points_at_and_behind_the_camera_plane_are_nan(camera):
    points = np.array([[[0.1, 0.1, 0.0], [0.1, 0.1, -1.0]], [[0.0, 0.0, 0.0], [0.1, 0.1, 1.0]]])
    pixels = camera.project(points)
    assert pixels.shape == (2, 2, 2)
    assert np.isnan(pixels[0]).all()
    assert np.isnan(pixels[1, 0]).all()
    assert np.isfinite(pixels[1, 1]).all()


@ALL
def test_no_points_give_no_pixels_and_no_rays(camera):
    assert camera.project(np.empty((0, 3))).shape == (0, 2)
    assert camera.rays(np.empty((0, 2))).shape == (0, 3)


def test_a_pixel_that_no_ray_reaches_gives_nan():
    barrel = Camera(640, 480, 300.0, 300.0, 319.5, 239.5, (-0.3, 0.0, 0.0, 0.0))
    # r (1 - 0.3 r²) is at most 0.7027, so no ray comes further than 211 px from the centre.
    rays = barrel.rays([[319.5 + 205.0, 239.5], [319.5 + 216.0, 239.5]])
    assert np.isfinite(rays[0]).all()
    assert np.isnan(rays[1, :2]).all()


def test_zero_coefficients_are_no_distortion():
    camera = Camera(640, 480, 800.0, 810.0, 310.0, 245.0, (0.0,) * 5)
    assert not camera.is_distorted
    assert (camera.rays(grid(camera)) == PLAIN.rays(grid(PLAIN))).all()


def test_half_field_of_view_is_that_of_the_nearest_border():
    assert Camera.from_fov(100, 100, 0.7).half_fov_rad == pytest.approx(0.35)
    assert Camera.from_fov(200, 100, 1.0).half_fov_rad == pytest.approx(
        math.atan(0.5 * math.tan(0.5))
    )
    assert PLAIN.half_fov_rad == pytest.approx(math.atan((479.5 - 245.0) / 810.0))
    off_centre = Camera(100, 100, 100.0, 100.0, 9.5, 49.5)
    assert off_centre.half_fov_rad == pytest.approx(math.atan(0.1))
    assert Camera(100, 100, 100.0, 100.0, -20.0, 49.5).half_fov_rad == 0.0


@pytest.mark.parametrize("camera", [FOUR, FIVE, EIGHT, TWELVE, FOURTEEN, FISHEYE])
def test_the_cone_of_a_distorted_camera_lies_in_the_picture_and_touches_it(camera):
    def inside(half_angle):
        turn = np.linspace(0.0, 2.0 * np.pi, 2000)
        tangent = np.tan(half_angle)
        ring = np.column_stack([tangent * np.cos(turn), tangent * np.sin(turn), np.ones_like(turn)])
        u, v = camera.project(ring).T
        return (
            u.min() > -0.5
            and v.min() > -0.5
            and u.max() < camera.width - 0.5
            and v.max() < camera.height - 0.5
        )

    assert inside(camera.half_fov_rad * 0.999)
    assert not inside(camera.half_fov_rad * 1.001)


def test_cameras_are_equal_by_value_and_fields_become_plain_numbers():
    camera = Camera(np.int64(640), 480.0, np.float32(800), 810, 310, 245, np.zeros(4))
    assert type(camera.width) is int
    assert type(camera.fx) is float
    assert camera == Camera(640, 480, 800.0, 810.0, 310.0, 245.0, (0.0,) * 4)
    assert hash(PLAIN) == hash(Camera(640, 480, 800.0, 810.0, 310.0, 245.0))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 0}, "width"),
        ({"height": -1}, "height"),
        ({"width": 1.5}, "width"),
        ({"width": True}, "width"),
        ({"fx": 0.0}, "fx must be positive"),
        ({"fy": -1.0}, "fy must be positive"),
        ({"cx": math.nan}, "cx must be finite"),
        ({"fx": math.inf}, "fx"),
        ({"distortion": (1.0, 2.0)}, "distortion must be 0, 4, 5, 8, 12 or 14"),
        ({"lens_model": "fisheye"}, "4 finite numbers"),
        ({"lens_model": "cylinder"}, "cylinder"),
        ({"bit_depth": 11}, "bit_depth must be one of"),
        ({"distortion": (1.0, 2.0, 3.0, math.nan)}, "finite"),
    ],
)
def test_impossible_cameras_are_refused(change, message):
    fields = {"width": 640, "height": 480, "fx": 8.0, "fy": 8.0, "cx": 3.0, "cy": 2.0}
    with pytest.raises(ValueError, match=message):
        Camera(**{**fields, **change})


@pytest.mark.parametrize("fov", [0.0, math.pi, -1.0, math.nan])
def test_an_impossible_field_of_view_is_refused(fov):
    with pytest.raises(ValueError, match="horizontal_fov_rad"):
        Camera.from_fov(640, 480, fov)


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match="points_px"):
        PLAIN.rays([1.0, 2.0])
    with pytest.raises(ValueError, match="points_m"):
        PLAIN.project(np.zeros((2, 2)))
