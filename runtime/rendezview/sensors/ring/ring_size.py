"""A ring of unknown size: its radius R and its distance D_f from the target's middle (Zhai et al.).

Of one frame by eq. 9–11; `size_circles` takes all frames of a pass together.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from rendezview.geometry.camera import Camera
from rendezview.sensors.ring.circle_pose import cones_of_shapes
from rendezview.sensors.ring.ellipse import Ellipse
from rendezview.sensors.ring.rectangle import Beam, rectangle_pose

Array = npt.NDArray[np.float64]

_STEP = 1e-4  # px and m, of slopes. Source: by construction, between rounding and curvature
_ROUNDS = 4  # of a distance and its weights. Source: by construction, the third changes nothing


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


def ring_size(camera: Camera, sight: RingSight) -> RingSize | None:
    """R and D_f from one frame (eq. 9–11), with uncertainty; None where they are not determined.

    The ring's axis meets the rectangle's middle. Its plane is the one in which every point of the
    ellipse is as far from that axis, by least squares with the errors of corners, ellipse and
    range. Head-on the ring gives little information on D_f, and the covariance shows it.
    """
    found = circle_line(camera, sight)
    if found is None:
        return None
    (start, rate), errors = found[0][:5].T, found[1][:5]  # of the ellipse alone
    slopes = np.column_stack([[0.0, 0.0, -1.0, 0.0, 0.0], rate])
    numbers = np.zeros(2)
    for _ in range(_ROUNDS):
        roots = errors[:, 0] + numbers[1] * errors[:, 1]
        weighted = np.linalg.solve(roots @ roots.T, slopes).T
        covariance = np.linalg.inv(weighted @ slopes)
        numbers = -covariance @ (weighted @ start)
    if not numbers[0] > 0.0:
        return None
    return RingSize(float(numbers[0]), float(numbers[1]), covariance)


def circle_line(camera: Camera, sight: RingSight) -> tuple[Array, Array] | None:
    """The circles whose picture an ellipse is, one for each distance D of a plane from the panel.

    Their numbers are linear in D: y and z of the middle, the radius, and two of what is not round,
    in metres. Three more are the panel's alone: its sides along y and z, and its skew.

    Returns:
        (8, 2) the numbers at D = 0 and their rates, and (8, 2, 14) errors of both: the square root
        of their covariance. None where the ellipse is no circle of such a plane.
    """
    base = sight.measured()
    line = _line(camera, base, sight.beam)
    if line is None:
        return None
    slopes = np.empty((*line.shape, 14))
    for k in range(14):
        pair = []
        for step in (_STEP, -_STEP):
            moved = base.copy()
            moved[k] += step
            found = _line(camera, moved, sight.beam)
            if found is None:
                return None
            pair.append(found)
        slopes[..., k] = (pair[0] - pair[1]) / (2.0 * _STEP)
    return line, slopes @ np.linalg.cholesky(sight.noise())


def _line(camera: Camera, measured: Array, beam: Beam) -> Array | None:
    """(8, 2) of `circle_line` from (14,) numbers of `RingSight.measured`."""
    corners_px = measured[:8].reshape(4, 2)
    found = rectangle_pose(camera, corners_px, float(measured[13]), beam)
    if found is None:
        return None
    pose, skew_rad = found
    turn = pose.rotation
    eye = -turn.T @ pose.translation_m
    rays = camera.rays(corners_px) @ turn
    corners = eye[1:] - eye[0] * rays[:, 1:] / rays[:, :1]
    cone = turn.T @ cones_of_shapes(camera, measured[None, 8:13])[0] @ turn
    # Where the cone meets the plane one metre before the camera: points (v - w)' A (v - w) = k.
    square, across = cone[1:, 1:], cone[1:, 0]
    middle = -np.linalg.solve(square, across)
    shape = -(cone[0, 0] + across @ middle) * np.linalg.inv(square)
    area = float(np.linalg.det(shape))
    if not (area > 0.0 and shape[0, 0] > 0.0):
        return None
    radius = area**0.25
    odd = 0.5 / radius * np.array([0.5 * (shape[0, 0] - shape[1, 1]), shape[0, 1]])
    size = np.array([radius, *odd])
    panel = [corners[0, 0] - corners[1, 0], corners[0, 1] - corners[2, 1], skew_rad]
    start = np.concatenate([eye[1:] - eye[0] * middle, eye[0] * size, panel])
    return np.column_stack([start, np.concatenate([middle, -size, np.zeros(3)])])
