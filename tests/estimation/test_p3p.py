"""Three points on three rays."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rendezview.estimation.p3p import solve_p3p_batch
from rendezview.geometry.pose import Pose
from rendezview.sensors.beacons.match.judgement import least_facing

TARGET = np.array([[0.0, 0.0, 0.1016], [-0.18415, 0.0, 0.0], [0.18415, 0.0, 0.0]])
HEAD_ON = np.diag([1.0, -1.0, -1.0])


def rays_of(rotation, translation, points=TARGET):
    return points @ rotation.T + translation


def solve_p3p(rays, points):
    """The poses of one set of rays."""
    rotations, translations, counts = solve_p3p_batch(rays[None], points)
    return [Pose(rotations[0, k], translations[0, k]) for k in range(counts[0])]


def error(pose, rotation, translation):
    return max(
        np.abs(pose.rotation - rotation).max(),
        np.linalg.norm(pose.translation_m - translation) / np.linalg.norm(translation),
    )


@pytest.mark.requirement("RV-REFL-2")
@pytest.mark.parametrize("range_m", [0.5, 1.0, 12.0, 100.0, 1000.0])
def test_head_on_is_exact(range_m):
    poses = solve_p3p(rays_of(HEAD_ON, np.array([0, 0, range_m])), TARGET)
    assert min(error(p, HEAD_ON, np.array([0, 0, range_m])) for p in poses) < 1e-12


@settings(deadline=None)  # the first call compiles
@given(
    st.floats(0.0, 0.7), st.floats(-np.pi, np.pi), st.floats(-np.pi, np.pi), st.floats(0.6, 100.0)
)
def test_the_guidance_target_is_found_with_its_post_towards_the_camera(tilt, way, roll, range_m):
    rotation = (
        Rotation.from_euler("z", roll)
        * Rotation.from_rotvec(tilt * np.array([np.cos(way), np.sin(way), 0.0]))
    ).as_matrix() @ HEAD_ON
    place = range_m * np.array([0.1, -0.2, 1.0])
    r, t, counts = solve_p3p_batch(rays_of(rotation, place)[None], TARGET)
    normals = np.tile([0.0, 0.0, 1.0], (3, 1))
    k = max(range(counts[0]), key=lambda k: least_facing(r[0, k], t[0, k], TARGET, normals))
    assert np.abs(r[0, k] - rotation).max() < 1e-9
    assert np.linalg.norm(t[0, k] - place) < 1e-9 * range_m


def test_every_root_sees_the_points_along_the_rays():
    rng = np.random.default_rng(0)
    for _ in range(200):
        points = rng.uniform(-1, 1, (3, 3))
        rays = rays_of(Rotation.random(rng=rng).as_matrix(), np.array([0.3, 0.2, 4.0]), points)
        for pose in solve_p3p(rays, points):
            seen = pose.apply(points)
            cosine = np.sum(seen * rays, axis=1) / np.linalg.norm(seen, axis=1)
            np.testing.assert_allclose(cosine, np.linalg.norm(rays, axis=1), rtol=1e-9)


def test_two_equal_poses_cost_half_the_digits_not_all():
    # The camera stands over a corner of the triangle, on the cylinder of its circle.
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    place = np.array([0.0, 0.0, 3.0])
    poses = solve_p3p(rays_of(HEAD_ON, place, points), points)
    assert min(error(p, HEAD_ON, place) for p in poses) < 1e-6


def test_the_length_of_rays_does_not_matter():
    rays = rays_of(HEAD_ON, np.array([0.1, 0.2, 3.0]))
    for a, b in zip(
        solve_p3p(rays, TARGET), solve_p3p(rays * [[2.0], [0.1], [7.0]], TARGET), strict=True
    ):
        np.testing.assert_allclose(a.translation_m, b.translation_m, rtol=1e-12)


def test_rays_that_no_triangle_fits_have_no_pose():
    # The outer rays at right angles with the middle one beyond: no such target.
    rays = np.array([[0.0, 3.0, 1.0], [-1.0, 0.0, 1.0], [1.0, 0.0, 1.0]])
    assert solve_p3p(rays, TARGET) == []


def test_wrong_input_is_refused():
    rays = rays_of(HEAD_ON, np.array([0.0, 0.0, 3.0]))
    assert solve_p3p(rays, np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0.0]])) == []
    assert solve_p3p(rays * 0.0, TARGET) == []
    with pytest.raises(ValueError, match="rays"):
        solve_p3p_batch(rays, TARGET)
    with pytest.raises(ValueError, match="points"):
        solve_p3p_batch(rays[None], TARGET[:2])


def test_a_batch_passes_what_is_not_a_number():
    rays = np.stack([rays_of(HEAD_ON, np.array([0.0, 0.0, 3.0]))] * 2)
    rays[0, 1, 0] = np.nan
    rotations, _, counts = solve_p3p_batch(rays, TARGET)
    assert counts[0] == 0
    assert counts[1] >= 2
    assert np.isnan(rotations[0]).all()
