"""A ring of unknown size: its radius R and its distance D_f from the target's middle (Zhai et al.).

Of one frame by eq. 9–11; of a whole pass by least squares over all frames at once, where the
rectangle's sides, R and D_f are the same in every frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.ring.circle_pose import shape_of_circle
from rendezview.sensors.ring.ellipse import Ellipse
from rendezview.sensors.ring.rectangle import rectangle_pose

Array = npt.NDArray[np.float64]

_POINTS = 36  # of the ellipse. Source: Zhai et al., its ring points
_PASS_STEPS = 12


@dataclass(frozen=True, slots=True, eq=False)
class RingSight:
    """What one frame measures: a rectangle's corners, the ring's ellipse and a laser range.

    The rectangle's frame is the target's: the ring's axis is its x axis, the origin its middle.
    """

    corners_px: Array  # (4, 2), in the order of `rectangle.rectangle_attitude`
    ellipse: Ellipse  # with its shape covariance
    range_m: float  # along the beam to the rectangle's plane
    corner_sigma_px: float
    range_sigma_m: float


@dataclass(frozen=True, slots=True, eq=False)
class RingSize:
    """Radius and distance of a ring, with their covariance."""

    radius_m: float
    distance_m: float  # of the ring's plane from the origin along target x
    covariance: Array  # (2, 2) of the two, m²
    frames: int
    skew_rad: float | None = None  # of the rectangle's sides in the one frame


def ring_size(
    camera: Camera, sight: RingSight, beam: npt.ArrayLike = (0.0, 0.0, 1.0)
) -> RingSize | None:
    """R and D_f from one frame (eq. 9–11), with uncertainty; None where they are not determined.

    The ray of every ring point meets the plane x = D_f of the target frame at (y, z), R² = y² + z².
    The ring's own plane is the one in which R is the same for all. Head-on the ring gives little
    information on D_f, and the covariance shows it.
    """
    shape = sight.ellipse.shape
    solved = _single(camera, sight.corners_px, shape, sight.range_m, beam)
    if solved is None:
        return None
    radius, distance, skew = solved
    jacobian = np.empty((2, 14))
    base = np.concatenate([np.ravel(sight.corners_px), shape, [sight.range_m]])
    for k in range(14):
        size = 1e-4 if k < 13 else 1e-5 * sight.range_m
        pair = []
        for sign in (1.0, -1.0):
            moved = base.copy()
            moved[k] += sign * size
            found = _single(camera, moved[:8].reshape(4, 2), moved[8:13], float(moved[13]), beam)
            if found is None:
                return None
            pair.append(found[:2])
        jacobian[:, k] = (np.array(pair[0]) - np.array(pair[1])) / (2.0 * size)
    noise = _noise(sight)
    return RingSize(radius, distance, jacobian @ noise @ jacobian.T, 1, skew)


def ring_size_of_pass(
    camera: Camera, sights: Sequence[RingSight], beam: npt.ArrayLike = (0.0, 0.0, 1.0)
) -> RingSize | None:
    """R and D_f from all frames of a pass together; None where too few frames have a solution.

    Unknown are the rectangle's two sides, R and D_f, and the pose of every frame; each frame gives
    fourteen numbers (corners, ellipse, range). Gauss–Newton, the poses eliminated frame by frame.
    """
    direction = np.asarray(beam, dtype=np.float64)
    direction = direction / np.linalg.norm(direction)
    poses: list[Pose] = []
    used: list[RingSight] = []
    guesses = []
    for sight in sights:
        size = ring_size(camera, sight, direction)
        found = rectangle_pose(camera, sight.corners_px, sight.range_m, direction)
        if size is None or found is None or not np.isfinite(size.covariance).all():
            continue
        pose, _ = found
        rays = camera.rays(sight.corners_px)
        plane = float(pose.rotation[:, 0] @ pose.translation_m)
        corners = rays * (plane / (rays @ pose.rotation[:, 0]))[:, None]
        sides = [np.linalg.norm(corners[0] - corners[k]) for k in (1, 2)]
        weight = np.linalg.inv(size.covariance)
        guesses.append((sides, size, weight))
        poses.append(pose)
        used.append(sight)
    if len(used) < 3:
        return None
    both = np.linalg.solve(
        sum(weight for *_, weight in guesses),
        sum(weight @ [size.radius_m, size.distance_m] for _, size, weight in guesses),
    )
    common = np.array([*np.median([sides for sides, *_ in guesses], axis=0), *both])
    weights = [np.linalg.inv(_noise(sight)) for sight in used]
    normal: Array = np.eye(4)
    for _ in range(_PASS_STEPS):
        normal, right = np.zeros((4, 4)), np.zeros(4)
        back: list[tuple[Array, Array, Array]] = []
        for pose, sight, weight in zip(poses, used, weights, strict=True):
            predict = _predictor(camera, pose, common, direction)
            base = predict(np.zeros(10))
            if base is None:
                return None
            slopes = np.empty((14, 10))
            for k in range(10):
                step = np.zeros(10)
                step[k] = 1e-6
                ahead, behind = predict(step), predict(-step)
                if ahead is None or behind is None:
                    return None
                slopes[:, k] = (ahead - behind) / 2e-6
            measured = np.concatenate(
                [np.ravel(sight.corners_px), sight.ellipse.shape, [sight.range_m]]
            )
            own, shared = slopes[:, :6], slopes[:, 6:]
            residual = measured - base
            inner = np.asarray(np.linalg.inv(own.T @ weight @ own), dtype=np.float64)
            across = own.T @ weight @ shared
            normal += shared.T @ weight @ shared - across.T @ inner @ across
            right += shared.T @ weight @ residual - across.T @ inner @ (own.T @ weight @ residual)
            back.append((inner, across, own.T @ weight @ residual))
        move = np.linalg.solve(normal, right)
        poses = [
            pose.perturbed(inner @ (side - across @ move))
            for pose, (inner, across, side) in zip(poses, back, strict=True)
        ]
        common = common + move
        if np.abs(move).max() < 1e-8:
            break
    covariance = np.asarray(np.linalg.inv(normal)[2:, 2:], dtype=np.float64)
    return RingSize(float(common[2]), float(common[3]), covariance, len(used))


def _noise(sight: RingSight) -> Array:
    """(14, 14) covariance of corners, shape and range."""
    noise = np.zeros((14, 14))
    noise[:8, :8] = np.eye(8) * sight.corner_sigma_px**2
    shape = sight.ellipse.shape_covariance
    if shape is None:
        raise ValueError("the ellipse of a sight needs its shape_covariance")
    noise[8:13, 8:13] = shape
    noise[13, 13] = sight.range_sigma_m**2
    return noise


def _single(
    camera: Camera, corners_px: Array, shape: Array, range_m: float, beam: npt.ArrayLike
) -> tuple[float, float, float] | None:
    found = rectangle_pose(camera, corners_px, range_m, beam)
    if found is None:
        return None
    pose, skew = found
    angles = 2.0 * np.pi * np.arange(_POINTS) / _POINTS
    matrix = np.array([[shape[2], shape[3]], [shape[3], shape[4]]])
    points = shape[:2] + np.column_stack([np.cos(angles), np.sin(angles)]) @ matrix
    rays = np.column_stack(
        [(points - (camera.cx, camera.cy)) / (camera.fx, camera.fy), np.ones(_POINTS)]
    )
    # Target axes: p = R'(x1c q - T), eq. 11; on the plane x = D_f the point is linear in D_f.
    turned, origin = rays @ pose.rotation, pose.rotation.T @ pose.translation_m
    if np.abs(turned[:, 0]).min() < 1e-9:
        return None
    slope = turned[:, 1:] / turned[:, :1]
    start = slope * origin[0] - origin[1:]  # (y, z) of every ray at x = 0
    # First the plane whose circle's middle comes nearest to the target's x axis: the middle is seen
    # in the direction C⁻¹ n, C the cone over the ellipse.
    inverse = np.linalg.inv(matrix @ matrix)
    x, y = shape[:2] - (camera.cx, camera.cy)
    scale = np.diag([camera.fx, camera.fy])
    inner = scale @ inverse @ scale
    place = np.array([x / camera.fx, y / camera.fy])
    cone = np.zeros((3, 3))
    cone[:2, :2], cone[:2, 2] = inner, -inner @ place
    cone[2, :2], cone[2, 2] = cone[:2, 2], place @ inner @ place - 1.0
    middle = np.linalg.solve(cone, pose.rotation[:, 0])
    (_, distance), *_ = np.linalg.lstsq(
        np.column_stack([middle / np.linalg.norm(middle), -pose.rotation[:, 0]]),
        pose.translation_m, rcond=None,
    )  # fmt: skip
    # Then that in which all points are equally far from it (eq. 9, 10): the least spread of log R.
    longest = 0.1 * float(np.linalg.norm(origin))
    for _ in range(30):
        places = start + distance * slope
        squares = np.sum(places * places, axis=1)
        rates = np.sum(places * slope, axis=1) / squares
        spread = rates - rates.mean()
        power = float(spread @ spread)
        if power < 1e-14:
            return None
        move = -0.5 * float(spread @ np.log(squares)) / power
        distance += min(max(move, -longest), longest)
        if abs(move) < 1e-12:
            break
    else:
        return None
    radius = float(np.linalg.norm(start + distance * slope, axis=1).mean())
    return radius, distance, skew


def _predictor(
    camera: Camera, pose: Pose, common: Array, beam: Array
) -> Callable[[Array], Array | None]:
    """The predicted measurements of a frame after a step (10,) of its pose and the common four."""

    def predict(step: Array) -> Array | None:
        moved = pose.perturbed(step[:6])
        across, up, radius, distance = common + step[6:]
        y, z = 0.5 * across, 0.5 * up
        corners = np.array([[0, y, z], [0, -y, z], [0, y, -z], [0, -y, -z]])
        places_px = camera.project(moved.apply(corners))
        axis = moved.rotation[:, 0]
        shape = shape_of_circle(camera, moved.apply([distance, 0.0, 0.0]), axis, radius)
        along = float(axis @ beam)
        if shape is None or not np.isfinite(places_px).all() or abs(along) < 1e-9:
            return None
        range_m = float(axis @ moved.translation_m) / along
        return np.concatenate([places_px.ravel(), shape, [range_m]])

    return predict
