"""The radial signature (Cleghorn & Sternberg 1991, figure 2) and what it is invariant to."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance.model.signature import (
    UNIT,
    Signature,
    quantised,
    radial_maxima,
    roll_against,
    rolled,
    spokes_of,
    twist,
)
from rendezview.sensors.appearance.outline.silhouette import outlines_of_mask
from rendezview_ground.render.projection import Window
from rendezview_ground.render.rasterizer import NumbaRenderer

ABOUT_Z = np.array([0.0, 0.0, 1.0])


def roll_matrix(angle: float) -> np.ndarray:
    return Rotation.from_rotvec(angle * ABOUT_Z).as_matrix()


def polygon(radii: np.ndarray, scale: float = 0.01) -> np.ndarray:
    """Rays of a star-shaped outline with radii by angle, counter-clockwise on the screen."""
    angle = np.linspace(0.0, 2.0 * np.pi, len(radii), endpoint=False)
    x, y = scale * radii * np.cos(angle), -scale * radii * np.sin(angle)
    return np.stack([x, y, np.ones(len(radii))], axis=1)


def spiked(direction: float, count: int = 720) -> np.ndarray:
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    off = (angle - direction + np.pi) % (2.0 * np.pi) - np.pi
    return polygon(1.0 + 1.5 * np.exp(-((off / 0.05) ** 2)))


def seen(mesh, pose: Pose, focal: float = 700.0, size: int = 512, bins: int = 180) -> Signature:
    middle = 0.5 * (size - 1)
    mask = NumbaRenderer(mesh).draw(pose, Window(size, size, focal, middle, middle))
    camera = Camera(size, size, focal, focal, middle, middle)
    outlines = [camera.rays(points) for points in outlines_of_mask(mask)]
    signature = Signature.of_outlines(outlines, bins, 3)
    assert signature is not None
    return signature


@pytest.fixture(scope="module")
def attitude() -> np.ndarray:
    return Rotation.from_rotvec([0.7, -0.4, 1.1]).as_matrix()


@pytest.mark.parametrize("bins", [360, 294, 120])
@pytest.mark.parametrize("quarter", range(4))
def test_bin_0_is_east_and_bins_run_counter_clockwise_on_the_screen(bins, quarter):
    up_on_the_screen = spiked(0.0)
    turned = up_on_the_screen @ roll_matrix(-0.5 * np.pi * quarter).T  # y down: minus is ccw
    signature = Signature.of_outlines([turned], bins)
    peak = int(np.argmax(signature.readings))
    assert abs((peak - quarter * bins / 4 + bins / 2) % bins - bins / 2) <= 0.5


def test_a_spike_upwards_on_the_screen_peaks_at_a_quarter_of_the_bins():
    mask = np.zeros((101, 101), dtype=np.uint8)
    mask[40:61, 40:61] = 255
    mask[10:40, 49:52] = 255  # rows above the body
    camera = Camera(101, 101, 500.0, 500.0, 50.0, 50.0)
    outlines = [camera.rays(p) for p in outlines_of_mask(mask)]
    signature = Signature.of_outlines(outlines, 360)
    assert abs(int(np.argmax(signature.readings)) - 90) <= 3
    assert signature.readings[90] > 1.8 * signature.readings[270]


def test_readings_of_a_disc_are_its_radius_in_thousandths_of_the_root_of_its_area():
    signature = Signature.of_outlines([polygon(np.ones(1000))], 360)
    assert np.abs(signature.readings - UNIT / np.sqrt(np.pi)).max() <= 0.6
    assert signature.area_sr == pytest.approx(np.pi * 0.01**2, rel=1e-3)


def test_readings_do_not_change_with_size():
    radii = 1.0 + 0.4 * np.random.default_rng(1).random(500)
    large, small = (
        Signature.of_outlines([polygon(radii, scale)], 120).readings for scale in (0.02, 0.0002)
    )
    assert np.abs(large - small).max() <= 1.0


def test_readings_do_not_change_with_focal_length(bumpy_mesh, attitude):
    pose = Pose(attitude, [0.0, 0.0, 12.0])
    near, far = seen(bumpy_mesh, pose, 1200.0), seen(bumpy_mesh, pose, 600.0)
    assert np.sqrt(np.mean((near.readings - far.readings) ** 2)) < 8.0
    assert near.area_sr == pytest.approx(far.area_sr, rel=0.01)


@pytest.mark.parametrize("roll", [0.3, -1.234, 2.9, np.deg2rad(2.0 * 45)])
def test_rolled_undoes_the_roll_of_a_camera(bumpy_mesh, attitude, roll):
    translation = np.array([0.0, 0.0, 8.0])
    upright = seen(bumpy_mesh, Pose(attitude, translation))
    view = seen(bumpy_mesh, Pose(roll_matrix(roll) @ attitude, translation))
    apart = np.sqrt(np.mean((view.readings - upright.readings) ** 2))
    back = np.sqrt(np.mean((rolled(view.readings, roll) - upright.readings) ** 2))
    assert back < 12.0  # of readings about 500: the pixels of the outline
    assert apart > 5.0 * back
    # the centred cameras differ by the same roll
    measured = twist(
        view.centred_from_camera @ roll_matrix(roll) @ attitude,
        upright.centred_from_camera @ attitude,
    )
    assert float(measured) == pytest.approx(roll, abs=2e-3)


@pytest.mark.parametrize("bearing", [(0.25, 0.0, 0.0), (0.0, -0.3, 0.0), (0.2, 0.22, 0.0)])
def test_a_target_off_the_boresight_has_the_signature_it_has_on_it(bumpy_mesh, attitude, bearing):
    sight = np.array([0.0, 0.0, 14.0])
    turn = Rotation.from_rotvec(bearing).as_matrix()
    ahead = seen(bumpy_mesh, Pose(attitude, sight))
    aside = seen(bumpy_mesh, Pose(turn @ attitude, turn @ sight), size=900)
    assert aside.area_sr == pytest.approx(ahead.area_sr, rel=0.01)
    roll = twist(aside.centred_from_camera @ turn @ attitude, ahead.centred_from_camera @ attitude)
    apart = np.abs(rolled(aside.readings, float(roll)) - ahead.readings)
    assert np.quantile(apart, 0.95) < 8.0  # the others stand where the outline is radial
    # ... and the centroid is put on the boresight
    assert np.linalg.norm((aside.centred_from_camera @ turn @ sight)[:2]) / 14.0 < 0.03


def test_twist_is_the_angle_of_a_pure_roll_and_zero_for_a_pure_tilt():
    rng = np.random.default_rng(2)
    node = Rotation.random(random_state=rng).as_matrix()
    for angle in (-3.0, -0.5, 0.0, 0.02, 3.1):
        assert float(twist(roll_matrix(angle) @ node, node)) == pytest.approx(angle, abs=1e-12)
    for _ in range(10):
        tilt = Rotation.from_rotvec([*rng.normal(0.0, 0.7, 2), 0.0]).as_matrix()
        assert float(twist(tilt @ node, node)) == pytest.approx(0.0, abs=1e-12)
        # a roll after or before a tilt is still that roll
        both = np.stack([roll_matrix(0.4) @ tilt @ node, tilt @ roll_matrix(0.4) @ node])
        assert np.allclose(twist(both, node), 0.4, atol=1e-12)
        assert roll_against(both[0], node) == pytest.approx(0.4, abs=1e-12)


def farthest_crossings(points: np.ndarray, bins: int) -> np.ndarray:
    """Plain twin of `radial_maxima`: every ray against every segment, y up."""
    result = np.zeros(bins)
    for b in range(bins):
        u = np.array([np.cos(2 * np.pi * b / bins), np.sin(2 * np.pi * b / bins)])
        for p, q in zip(points, np.roll(points, -1, axis=0), strict=True):
            system = np.column_stack([u, p - q])
            if abs(np.linalg.det(system)) < 1e-14:
                continue
            distance, along = np.linalg.solve(system, p)
            if -1e-9 <= along <= 1.0 + 1e-9:
                result[b] = max(result[b], distance)
    return result


def test_readings_are_the_farthest_crossings_of_each_ray_with_any_polygon():
    rng = np.random.default_rng(4)
    for count in (3, 5, 12, 40):
        for _ in range(4):
            points = rng.normal(0.0, 0.1, size=(count, 2)) + 0.013  # tangled and concave
            rays = np.column_stack([points[:, 0], -points[:, 1], np.ones(count)])
            maxima = np.zeros(61)
            radial_maxima(rays, np.eye(3), spokes_of(len(maxima)), maxima)
            assert np.allclose(maxima, farthest_crossings(points, 61), atol=1e-9)


def test_readings_keep_what_an_earlier_outline_had_farther_out():
    maxima = np.zeros(90)
    radial_maxima(polygon(np.full(100, 2.0)), np.eye(3), spokes_of(len(maxima)), maxima)
    radial_maxima(polygon(np.ones(100)), np.eye(3), spokes_of(len(maxima)), maxima)
    assert maxima.min() > 0.0199


def test_an_edge_along_a_ray_does_not_reach_farther_than_its_end():
    rng = np.random.default_rng(5)
    bins = 36
    for _ in range(2000):
        angle = 2.0 * np.pi * rng.integers(bins) / bins
        along = np.array([np.cos(angle), -np.sin(angle), 0.0])
        edge = rng.uniform(0.1, 1.0, size=(3, 1)) * along + ABOUT_Z
        maxima = np.zeros(bins)
        radial_maxima(edge, np.eye(3), spokes_of(len(maxima)), maxima)
        assert maxima.max() <= np.linalg.norm(edge[:, :2], axis=1).max() * (1.0 + 1e-6)


@pytest.mark.parametrize("pixels", [9, 16, 60])
def test_no_bin_of_a_small_star_shaped_blob_is_zero(pixels):
    side = round(np.sqrt(pixels))
    mask = np.zeros((20, 20), dtype=np.uint8)
    mask[6 : 6 + side, 7 : 7 + side] = 255
    camera = Camera(20, 20, 100.0, 100.0, 9.5, 9.5)
    rays = [camera.rays(p) for p in outlines_of_mask(mask)]
    readings = Signature.of_outlines(rays, 360).readings
    assert readings.min() > 0.4 * UNIT  # half the side of a square, less pixels
    assert readings.max() < 0.8 * UNIT


def test_outlines_that_enclose_nothing_have_no_signature():
    line = np.array([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0]])
    assert Signature.of_outlines([], 36) is None
    assert Signature.of_outlines([line], 36) is None


@pytest.mark.parametrize("smooth", [1, 3, 9, 35])
def test_smoothing_is_the_circular_mean_of_an_odd_number_of_bins(smooth):
    maxima = np.random.default_rng(6).random(72)
    half = smooth // 2
    mean = np.mean([np.roll(maxima, k) for k in range(-half, half + 1)], axis=0)
    readings = quantised(maxima, 5000.0, smooth)
    assert readings.dtype == np.float32
    assert np.array_equal(readings, np.rint(5000.0 * mean))
