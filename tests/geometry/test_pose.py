"""Poses: group axioms, quaternions, left perturbation, least rotations, bad input."""

import copy
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Pose, minimal_rotation, nearest_rotation, rotation_angle

finite = st.floats(-1e3, 1e3)
vectors = arrays(np.float64, 3, elements=finite)
quaternions = arrays(np.float64, 4, elements=st.floats(-1, 1)).filter(
    lambda q: np.linalg.norm(q) > 1e-3
)
poses = st.builds(Pose.from_quat_wxyz, quaternions, vectors)
directions = vectors.filter(lambda v: np.linalg.norm(v) > 1e-3)


def assert_same(a: Pose, b: Pose, tolerance: float = 1e-9) -> None:
    np.testing.assert_allclose(a.rotation, b.rotation, atol=tolerance)
    np.testing.assert_allclose(a.translation_m, b.translation_m, atol=tolerance * 1e3)


@settings(deadline=None)
@given(poses)
def test_identity_changes_nothing(pose):
    assert_same(pose @ Pose.identity(), pose)
    assert_same(Pose.identity() @ pose, pose)


@settings(deadline=None)
@given(poses)
def test_inverse_undoes_on_both_sides(pose):
    assert_same(pose @ pose.inverse(), Pose.identity())
    assert_same(pose.inverse() @ pose, Pose.identity())


@pytest.mark.requirement("RV-POSE-1")
@settings(deadline=None)
@given(poses, poses, vectors)
def test_chaining_applies_the_right_pose_first(a, b, point):
    np.testing.assert_allclose((a @ b).apply(point), a.apply(b.apply(point)), atol=1e-7)


@pytest.mark.requirement("RV-POSE-1")
@settings(deadline=None)
@given(poses)
def test_quaternion_is_unit_scalar_first_not_negative_and_gives_the_pose_back(pose):
    quat = pose.quat_wxyz
    assert quat[0] >= 0.0
    assert np.linalg.norm(quat) == pytest.approx(1.0)
    assert_same(Pose.from_quat_wxyz(quat, pose.translation_m), pose)


@settings(deadline=None)
@given(
    poses,
    st.sampled_from([np.eye(3), *(np.diag(d) for d in ((1, -1, -1), (-1, 1, -1), (-1, -1, 1)))]),
)
def test_quaternion_is_scipys_of_any_rotation_half_turns_included(pose, half_turn):
    for rotation in (
        half_turn,
        half_turn @ pose.rotation,
        pose.rotation @ half_turn @ pose.rotation.T,
    ):
        theirs = Rotation.from_matrix(rotation).as_quat()[[3, 0, 1, 2]]
        ours = Pose(rotation, np.zeros(3)).quat_wxyz
        if abs(theirs[0]) < 1e-12:  # then the sign is rounding's
            assert min(np.abs(ours - theirs).max(), np.abs(ours + theirs).max()) < 1e-12
        else:
            np.testing.assert_allclose(ours, theirs * np.sign(theirs[0]), atol=1e-12)


def test_quaternion_of_a_rotation_rounded_in_a_file_is_that_of_the_nearest_rotation():
    pose = Pose.from_quat_wxyz([0.3, -0.5, 0.1, 0.8], np.zeros(3))
    rounded = Pose(np.round(pose.rotation, 7), np.zeros(3))
    nearest = Pose(nearest_rotation(rounded.rotation), np.zeros(3))
    np.testing.assert_allclose(rounded.quat_wxyz, nearest.quat_wxyz, atol=1e-15)
    assert np.linalg.norm(rounded.quat_wxyz) == pytest.approx(1.0, abs=1e-15)


def test_a_pose_as_a_dict_reads_back():
    pose = Pose.from_quat_wxyz([0.3, -0.5, 0.1, 0.8], [1.0, 2.0, 3.0])
    told = pose.as_dict()
    assert told["translation_m"] == [1.0, 2.0, 3.0]
    assert_same(Pose.from_quat_wxyz(**told), pose, 1e-15)


def test_negated_and_scaled_quaternions_are_the_same_pose():
    quat = np.array([0.3, -0.5, 0.1, 0.8])
    first = Pose.from_quat_wxyz(quat, np.zeros(3))
    assert_same(first, Pose.from_quat_wxyz(-7.0 * quat, np.zeros(3)), 1e-15)


def test_points_of_any_leading_shape_are_mapped_one_by_one():
    rng = np.random.default_rng(1)
    pose = Pose.from_quat_wxyz(rng.normal(size=4), rng.normal(size=3))
    points = rng.normal(size=(2, 4, 3))
    mapped = pose.apply(points)
    assert mapped.shape == (2, 4, 3)
    np.testing.assert_allclose(
        mapped[1, 2], pose.rotation @ points[1, 2] + pose.translation_m, atol=1e-15
    )


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, np.pi - 1e-9, np.pi])
def test_angle_between_poses_is_exact_near_zero_and_near_pi(angle):
    rng = np.random.default_rng(2)
    axis = rng.normal(size=3)
    turn = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
    first = Pose.from_quat_wxyz(rng.normal(size=4), rng.normal(size=3))
    second = Pose(turn @ first.rotation, np.zeros(3))
    assert first.angle_to(second) == pytest.approx(angle, abs=1e-14)
    assert rotation_angle(turn) == pytest.approx(angle, abs=1e-14)


@pytest.mark.requirement("RV-POSE-2")
def test_perturbation_is_on_the_left_in_the_camera_frame():
    rng = np.random.default_rng(3)
    pose = Pose.from_quat_wxyz(rng.normal(size=4), rng.normal(size=3))
    delta = np.array([0.2, -0.1, 0.3, 1.0, 2.0, 3.0])
    turn = Rotation.from_rotvec(delta[:3]).as_matrix()
    perturbed = pose.perturbed(delta)
    np.testing.assert_allclose(perturbed.rotation, turn @ pose.rotation, atol=1e-15)
    assert np.abs(perturbed.rotation - pose.rotation @ turn).max() > 0.01  # not on the right
    np.testing.assert_allclose(perturbed.translation_m, pose.translation_m + delta[3:])


@settings(deadline=None)
@given(directions, directions)
def test_minimal_rotation_turns_one_direction_into_the_other(a, b):
    rotation = minimal_rotation(a, b)
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    np.testing.assert_allclose(rotation @ a, b, atol=1e-13)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(rotation) > 0.0
    # No rotation that does so turns by less than the angle between them.
    angle = np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)
    assert rotation_angle(rotation) == pytest.approx(angle, abs=1e-13)


@pytest.mark.parametrize("offset", [0.0, 1e-16, 1e-12, 1e-9, 1e-7, 1.4e-6, 1e-5, 1e-3])
def test_minimal_rotation_is_orthonormal_for_nearly_opposite_directions(offset):
    rng = np.random.default_rng(5)
    for _ in range(50):
        a = rng.normal(size=3)
        a /= np.linalg.norm(a)
        b = -a + offset * rng.normal(size=3)
        b /= np.linalg.norm(b)
        rotation = minimal_rotation(a, b)
        np.testing.assert_allclose(rotation @ a, b, atol=1e-13)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
        Pose(rotation, np.zeros(3))  # accepted as a rotation


def test_minimal_rotation_takes_directions_of_any_length():
    tiny, huge = np.array([1e-200, 0.0, 0.0]), np.array([0.0, 1e200, 0.0])
    np.testing.assert_allclose(minimal_rotation(tiny, huge) @ [1, 0, 0], [0, 1, 0], atol=1e-15)


@pytest.mark.parametrize("bad", [[0, 0, 0], [np.nan, 0, 1], [np.inf, 0, 0], [1, 0], [[1, 0, 0]]])
def test_minimal_rotation_refuses_what_is_no_direction(bad):
    with pytest.raises(ValueError, match="direction"):
        minimal_rotation(bad, [1, 0, 0])
    with pytest.raises(ValueError, match="direction"):
        minimal_rotation([1, 0, 0], bad)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_what_overflows_is_no_rotation(sign):
    huge = 1e300 * np.array([[1.0, 1.0, 0.0], [1.0, sign, 0.0], [0.0, 0.0, 1.0]])
    with pytest.raises(ValueError, match="not a rotation"):
        nearest_rotation(huge)


def test_nearest_rotation_mends_rounding_and_leaves_a_rotation_as_it_is():
    exact = Rotation.random(rng=np.random.default_rng(6)).as_matrix()
    assert (nearest_rotation(exact) == exact).all()
    mended = nearest_rotation(exact.round(4))
    assert np.abs(mended - exact).max() < 1e-4
    np.testing.assert_allclose(mended @ mended.T, np.eye(3), atol=1e-15)


@pytest.mark.parametrize(
    "bad", [2.0 * np.eye(3), np.diag([1.0, 1.0, -1.0]), np.eye(2), np.full((3, 3), np.nan)]
)
def test_nearest_rotation_refuses_what_is_no_rounding(bad):
    with pytest.raises(ValueError, match="rotation"):
        nearest_rotation(bad)


@pytest.mark.parametrize(
    ("rotation", "translation", "message"),
    [
        (np.eye(2), np.zeros(3), "shape|needs"),
        (np.eye(3), np.zeros(2), "needs"),
        (np.eye(3), [0.0, np.nan, 0.0], "finite"),
        (np.full((3, 3), np.inf), np.zeros(3), "finite"),
        (np.diag([1.0, 1.0, -1.0]), np.zeros(3), "orthonormal"),
        (1.001 * np.eye(3), np.zeros(3), "orthonormal"),
    ],
)
def test_a_pose_refuses_parts_that_are_no_rigid_transform(rotation, translation, message):
    with pytest.raises(ValueError, match=message):
        Pose(rotation, translation)


@pytest.mark.parametrize("quat", [[0, 0, 0, 0], [1, 0, 0], [np.nan, 0, 0, 1]])
def test_a_bad_quaternion_is_refused(quat):
    with pytest.raises(ValueError, match="quat_wxyz"):
        Pose.from_quat_wxyz(quat, np.zeros(3))


@pytest.mark.parametrize("delta", [np.zeros(5), np.zeros(7), np.zeros((6, 1)), 0.0])
def test_a_perturbation_that_is_not_six_numbers_is_refused(delta):
    with pytest.raises(ValueError, match="delta"):
        Pose.identity().perturbed(delta)


def test_a_pose_owns_its_arrays_and_cannot_be_written_to():
    translation = np.zeros(3)
    pose = Pose(np.eye(3), translation)
    translation[0] = 5.0
    assert pose.translation_m[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        pose.rotation[0, 0] = 2.0


def test_a_pose_survives_pickle_and_copy():
    pose = Pose.from_quat_wxyz([1, 2, 3, 4], [1, 2, 3])
    for twin in (pickle.loads(pickle.dumps(pose)), copy.deepcopy(pose)):
        assert_same(twin, pose, 0.0)


@settings(deadline=None)
@given(poses)
def test_a_pose_and_its_matrix_are_the_same(pose):
    matrix = pose.as_matrix()
    assert_same(Pose.from_matrix(matrix), pose, 1e-12)
    assert_same(Pose.from_matrix(matrix[:3]), pose, 1e-12)
    assert_same(Pose.from_matrix(matrix.round(5)), pose, 1e-4)
    np.testing.assert_allclose(pose.inverse().as_matrix() @ matrix, np.eye(4), atol=1e-9)


@settings(deadline=None)
@given(poses, vectors)
def test_a_pose_at_points_is_its_product_with_them(pose, point):
    homogeneous = pose.as_matrix() @ [*point, 1.0]
    np.testing.assert_allclose(pose @ point, homogeneous[:3], atol=1e-9)
    many = np.stack([point, -point]).reshape(2, 1, 3)
    np.testing.assert_array_equal(pose @ many, pose.apply(many))
    np.testing.assert_array_equal(pose @ point.tolist(), pose.apply(point))


def test_poses_are_equal_where_their_numbers_are():
    pose = Pose.from_quat_wxyz([1, 2, 3, 4], [1, 2, 3])
    same = Pose(pose.rotation.copy(), pose.translation_m.copy())
    other = Pose(pose.rotation, [1, 2, 4])
    assert pose == same
    assert hash(pose) == hash(same)
    assert pose != other
    assert pose != pose.inverse()
    assert (pose == 3) is False
    assert len({pose, same, other}) == 2
    assert copy.deepcopy(pose) == pose


def test_matrices_that_are_no_poses_are_named():
    matrix = Pose.from_quat_wxyz([1, 2, 3, 4], [1, 2, 3]).as_matrix()
    for wrong, words in [
        (matrix.T, "it is transposed"),
        (2.0 * matrix, "last row"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "determinant"),
        (np.diag([2.0, 2.0, 2.0, 1.0]), "not a rotation"),
        (matrix[:3, :3], r"\(4, 4\) or \(3, 4\), not \(3, 3\)"),
        (matrix * np.nan, "last row|finite"),
    ]:
        with pytest.raises(ValueError, match=words):
            Pose.from_matrix(wrong)
    for points in (3.0, [1.0, 2.0], np.zeros((3, 4))):
        with pytest.raises(ValueError, match=r"points_m must be \(\.\.\., 3\)"):
            Pose.identity() @ points


def test_the_step_from_one_pose_to_another_is_the_perturbation_that_leads_there() -> None:
    one = Pose.from_quat_wxyz([0.4, -0.3, 0.2, 0.8], [1.0, -2.0, 30.0])
    delta = np.array([0.5, -0.2, 1.1, 0.3, 2.0, -4.0])
    other = one.perturbed(delta)
    assert other.delta_from(one) == pytest.approx(delta)
    assert one.delta_from(other) == pytest.approx(-delta)
