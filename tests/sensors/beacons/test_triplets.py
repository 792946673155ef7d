"""The search for triplets in a crowd leaves out nothing that the plain tests would keep."""

import itertools
import math

import numpy as np

from rendezview.sensors.beacons import Acquirer, SixNumbers, pose_of
from rendezview.sensors.beacons.detect.discs import camera_numbers
from rendezview.sensors.beacons.match.acquisition_options import AcquisitionOptions
from rendezview.sensors.beacons.match.judgement import judge
from rendezview.sensors.beacons.match.matching import expect_spots
from rendezview.sensors.beacons.match.triplets import search


def crowd(camera, rng, count, size_px):
    """Directions, flat places, sizes and peaks of false spots that are much alike."""
    rays = camera.rays(rng.uniform((10, 10), (500, 370), (count, 2)))
    directions = rays / np.linalg.norm(rays, axis=1)[:, None]
    flat = np.ascontiguousarray(rays[:, :2] * camera.fx)
    sizes = size_px * np.exp(rng.normal(0.0, 0.05, count))
    return directions, flat, sizes, rng.uniform(100.0, 200.0, count)


def triplets_of(acquirer, spots, tolerance=0.14):
    camera, triangle, options = acquirer.camera, acquirer._triangles[0], acquirer.options
    directions, flat, sizes, peaks = spots
    out = np.empty((20_000, 3), np.int64)
    near = math.cos(options.tilt_rad)
    limits = (
        1.0, 1e4, tolerance, options.peak_limit, options.blur_sigma, near, triangle.longest_side,
    )  # fmt: skip
    count = search(
        directions, flat, sizes, peaks, np.argsort(flat[:, 0]), triangle.glass, triangle.base_m,
        triangle.diameters_m, camera.fx, options.blur_px, limits, True, out,
    )  # fmt: skip
    assert count >= 0
    return out[:count]


def test_the_search_finds_every_centre_spot_that_the_hourglass_holds(paper_camera, three):
    acquirer = Acquirer(paper_camera, [three], AcquisitionOptions(tilt_rad=math.radians(45.0)))
    spots = crowd(paper_camera, np.random.default_rng(3), 40, 1.6)
    # A tolerance of ln 40 lets any size stand for any base: the shape alone decides.
    found = {tuple(row) for row in triplets_of(acquirer, spots, tolerance=math.log(40.0)).tolist()}
    x0, y0, slope, wide, high = acquirer._triangles[0].glass
    directions, flat = spots[:2]
    wanted = set()
    for left, right in itertools.permutations(range(40), 2):
        a, b = directions[left], directions[right]
        middle, base = 0.5 * (a + b), b - a
        across = np.cross(middle, base) / np.linalg.norm(middle)
        for centre in set(range(40)) - {left, right}:
            e = (directions[centre] - middle) / (base @ base)
            x, y = e @ base, e @ across
            inside = abs(x - x0) <= wide and abs(y - y0) <= slope * abs(x - x0) + high
            alike = abs(math.log(spots[2][left] / spots[2][right])) <= 0.3
            if inside and alike:
                wanted.add((left, centre, right))
    assert len(flat) == 40
    assert len(wanted) > 500
    assert found == wanted


def test_true_spots_are_judged_by_their_sizes_and_brightness_at_the_true_pose(paper_camera, three):
    pose = pose_of(SixNumbers(4.0, 0.1, -0.05, 0.4, 0.2, -0.1), three)
    places = pose.apply(three.positions_m)
    directions = places / np.linalg.norm(places, axis=1)[:, None]
    expected, options = np.empty((3, 3)), Acquirer(paper_camera, [three]).options
    expect_spots(
        camera_numbers(paper_camera), three.positions_m, three.normals, three.diameters_m,
        pose.rotation.copy(), pose.translation_m.copy(), paper_camera.fx, 0.75, expected,
    )  # fmt: skip

    def judged(sizes, peaks):
        scores, poses = np.empty((1, 4)), np.empty((1, 4, 12))
        judge(
            np.array([[0, 1, 2]]), directions, sizes.copy(), peaks,
            three.positions_m, three.normals, three.diameters_m, paper_camera.fx, 0.75,
            (0.035, 0.03, 0.12, 0.08, 0.5, 0.5, 5.7),
            np.array([0.3, 150.0]), options.score_limit, scores, poses,
        )  # fmt: skip
        k = int(np.argmin(scores[0]))
        return scores[0, k], poses[0, k]

    score, found = judged(expected[:, 2], np.full(3, 150.0))
    assert score < 1.0
    np.testing.assert_allclose(found[9:], pose.translation_m, atol=1e-6)
    for factor, least in ((np.array([1.0, 1.05, 1.0]), 1.0), (np.full(3, 0.5), np.inf)):
        assert judged(factor * expected[:, 2], np.full(3, 150.0))[0] >= least
    assert judged(expected[:, 2], np.array([150.0, 110.0, 150.0]))[0] > 8.0
