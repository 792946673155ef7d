"""A ring of unknown size: its radius R and its distance D_f from the target's middle (Zhai et al.).

Of one frame by eq. 9–11; `ring_pass` takes all frames of a pass together.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from rendezview.geometry.camera import Camera
from rendezview.sensors.ring.ellipse import Ellipse
from rendezview.sensors.ring.rectangle import Beam, rectangle_pose

Array = npt.NDArray[np.float64]

_POINTS = 36  # of the ellipse. Source: Zhai et al., its ring points


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
    beam: Beam = field(default_factory=Beam)

    def measured(self) -> Array:
        """(14,) corners px, shape of the ellipse px, range m."""
        return np.concatenate([np.ravel(self.corners_px), self.ellipse.shape, [self.range_m]])

    def noise(self) -> Array:
        """(14, 14) their covariance.

        Raises:
            ValueError: the ellipse has no covariance.
        """
        shape = self.ellipse.shape_covariance
        if shape is None:
            raise ValueError("the ellipse of a sight needs its shape_covariance")
        noise = np.zeros((14, 14))
        noise[:8, :8] = np.eye(8) * self.corner_sigma_px**2
        noise[8:13, 8:13] = shape
        noise[13, 13] = self.range_sigma_m**2
        return noise


@dataclass(frozen=True, slots=True, eq=False)
class RingSize:
    """Radius and distance of a ring, with their covariance."""

    radius_m: float
    distance_m: float  # of the ring's plane from the origin along target x
    covariance: Array  # (2, 2) of the two, m²
    skew_rad: float  # of the rectangle's sides before they were made square


def ring_size(camera: Camera, sight: RingSight) -> RingSize | None:
    """R and D_f from one frame (eq. 9–11), with uncertainty; None where they are not determined.

    The ray of every ring point meets the plane x = D_f of the target frame at (y, z), R² = y² + z².
    The ring's own plane is the one in which R is the same for all. Head-on the ring gives little
    information on D_f, and the covariance shows it.
    """
    base = sight.measured()
    solved = _single(camera, base, sight.beam)
    if solved is None:
        return None
    radius, distance, skew = solved
    jacobian = np.empty((2, 14))
    for k in range(14):
        size = 1e-4 if k < 13 else 1e-5 * sight.range_m
        pair = []
        for sign in (1.0, -1.0):
            moved = base.copy()
            moved[k] += sign * size
            found = _single(camera, moved, sight.beam)
            if found is None:
                return None
            pair.append(found[:2])
        jacobian[:, k] = (np.array(pair[0]) - np.array(pair[1])) / (2.0 * size)
    return RingSize(radius, distance, jacobian @ sight.noise() @ jacobian.T, skew)


def _single(camera: Camera, measured: Array, beam: Beam) -> tuple[float, float, float] | None:
    """R, D_f and the skew of the rectangle's sides from (14,) numbers of `RingSight.measured`."""
    shape = measured[8:13]
    found = rectangle_pose(camera, measured[:8].reshape(4, 2), float(measured[13]), beam)
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
    cone = cone_of(camera, shape)
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


def cone_of(camera: Camera, shape: Array) -> Array:
    """(3, 3) C of the cone q' C q = 0 of the rays q through an ellipse; negative within.

    Args:
        camera: without distortion.
        shape: (5,) shape vector of the ellipse, px.
    """
    matrix = np.array([[shape[2], shape[3]], [shape[3], shape[4]]])
    x, y = shape[:2] - (camera.cx, camera.cy)
    scale = np.diag([camera.fx, camera.fy])
    inner = scale @ np.linalg.inv(matrix @ matrix) @ scale
    place = np.array([x / camera.fx, y / camera.fy])
    cone = np.zeros((3, 3))
    cone[:2, :2], cone[:2, 2] = inner, -inner @ place
    cone[2, :2], cone[2, 2] = cone[:2, 2], place @ inner @ place - 1.0
    return cone
