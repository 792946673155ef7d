"""The angles of joints over a sequence: a Kalman filter of angle and rate for each joint."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rendezview.geometry.joint import apart, within
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.appearance.model.joint_angles import JointAngles
from rendezview.sensors.appearance.observation import AppearanceObservation

# Drives turn evenly. Source: experiment pose-joints (0.1)
_RATE_WALK_RAD_S = np.deg2rad(0.02)  # one σ of the change of a rate in a second
_FIRST_RATE_RAD_S = np.deg2rad(3.0)  # one σ before two frames have shown it. Source: a fast drive
_OUTLIER = 5.0  # σ of an innovation; such an angle is another optimum. Source: by construction
_MOST_OUTLIERS = 3  # in a row; then the filter starts anew. Source: by construction


class JointFilter:
    """Follows the angles of one target's joints.

    A frame gives pose and angles together; what the filter expects of the angles then improves
    both, since their errors go together.
    """

    def __init__(self, joints: JointAngles, time_s: float) -> None:
        """A filter that starts from one frame's angles; the rates are unknown."""
        self._joints = joints.joints
        self._start(joints, time_s)

    def _start(self, joints: JointAngles, time_s: float) -> None:
        count = len(self._joints)
        self._time_s = time_s
        self._angles = joints.angles_rad.copy()
        self._rates = np.zeros(count)
        self._spread = np.zeros((count, 2, 2))  # covariance of angle and rate of each joint
        self._spread[:, 0, 0] = joints.sigma_rad**2
        self._spread[:, 1, 1] = _FIRST_RATE_RAD_S**2
        self._outliers = 0

    def predicted(self, time_s: float, longest_s: float) -> Array:
        """(J,) angles expected at a time; rates are held for so long."""
        return self._ahead(min(time_s - self._time_s, longest_s))[0]

    def followed(
        self, observation: AppearanceObservation, longest_s: float
    ) -> AppearanceObservation:
        """Take a frame's angles over; the observation with pose and angles improved by the filter.

        Args:
            observation: with a pose, a time and angles.
            longest_s: for which rates are held.
        """
        joints, pose, time_s = observation.joints, observation.pose, observation.time_s
        if joints is None or pose is None or time_s is None:
            return observation
        passed_s = time_s - self._time_s
        if passed_s > longest_s:
            self._start(joints, time_s)
            return observation
        angles, spread = self._ahead(passed_s)
        measured, covariance = joints.angles_rad, joints.covariance
        off = apart(self._joints, measured, angles)
        seen = covariance[6:, 6:]
        total = seen + np.diag(spread[:, 0, 0])
        if float(off @ np.linalg.solve(total, off)) > _OUTLIER**2 * len(off):
            self._outliers += 1
            if self._outliers >= _MOST_OUTLIERS or np.all(joints.sigma_rad**2 < spread[:, 0, 0]):
                self._start(joints, time_s)
                return observation
        else:
            self._outliers = 0
        # What is expected of the angles is one more measurement of the frame's unknowns.
        gain = covariance[:, 6:] @ np.linalg.inv(total)
        step = -gain @ off
        better = covariance - gain @ covariance[6:, :]
        self._update(time_s, angles, spread, off, np.diag(seen))
        return _moved(observation, joints, pose, step, 0.5 * (better + better.T))

    def _ahead(self, passed_s: float) -> tuple[Array, Array]:
        """Angles (J,) and covariances (J, 2, 2) after a time."""
        angles = within(self._joints, self._angles + passed_s * self._rates)
        move = np.array([[1.0, passed_s], [0.0, 1.0]])
        noise = _RATE_WALK_RAD_S**2 * np.array(
            [[passed_s**3 / 3.0, passed_s**2 / 2.0], [passed_s**2 / 2.0, passed_s]]
        )
        return angles, move @ self._spread @ move.T + noise

    def _update(
        self, time_s: float, angles: Array, spread: Array, off: Array, variance: Array
    ) -> None:
        """The state after measurements ``off`` the angles expected, (J,) each."""
        self._time_s = time_s
        gain = spread[:, :, 0] / (spread[:, 0, 0] + variance)[:, None]
        self._angles = within(self._joints, angles + gain[:, 0] * off)
        self._rates = self._rates + gain[:, 1] * off
        self._spread = spread - gain[:, :, None] * spread[:, None, 0]


def _moved(
    observation: AppearanceObservation,
    joints: JointAngles,
    pose: Pose,
    step: Array,
    covariance: Array,
) -> AppearanceObservation:
    """The observation after a step (6 + J,) of the target's origin, its attitude and the angles."""
    angles = within(joints.joints, joints.angles_rad + step[6:])
    return replace(
        observation,
        pose=pose.perturbed(step[:6]),
        covariance=covariance[:6, :6],
        joints=replace(joints, angles_rad=angles, covariance=covariance),
    )
