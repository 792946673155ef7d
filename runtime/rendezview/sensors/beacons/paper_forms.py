"""The papers' own solutions beside the sensor's pose: closed form, and Bales' iterations."""

from __future__ import annotations

from typing import Any

import numpy as np

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array
from rendezview.sensors.beacons.closed_form import ClosedFormCalibration, closed_form, post_of
from rendezview.sensors.beacons.constellation import Face, ReflectorPattern
from rendezview.sensors.beacons.observation import ReflectorObservation, rates_record
from rendezview.sensors.beacons.rates import RateEstimator
from rendezview.sensors.beacons.triangulation import (
    Iteration,
    alternate_iteration,
    newton_raphson,
    pose_from_distances,
)


class PaperForms:
    """What a log has besides the pose; rates are those of one run, in order of time.

    Args:
        calibration: of the closed form (Book et al.); None: without it.
        iteration: of the distances (Bales); None: without it.
    """

    def __init__(
        self, calibration: ClosedFormCalibration | None = None, iteration: Iteration | None = None
    ) -> None:
        self.calibration, self.iteration = calibration, iteration
        self._rates = RateEstimator()

    def of(
        self, camera: Camera, reading: ReflectorObservation, patterns: list[ReflectorPattern]
    ) -> dict[str, Any]:
        """``closed_form`` and ``triangulation``, as far as they are asked for."""
        pattern = next((p for p in patterns if p.name == reading.group), None)
        three = None if pattern is None else outer_and_centre(pattern, reading)
        found: dict[str, Any] = {}
        if self.calibration is not None:
            found["closed_form"] = None
            if pattern is not None and three is not None and reading.pose is not None:
                found["closed_form"] = closed_form(camera, pattern, three, self.calibration)
        if self.iteration is not None:
            found["triangulation"] = self._triangulated(camera, reading, pattern, three)
        return found

    def _triangulated(
        self, camera: Camera, reading: ReflectorObservation, pattern: ReflectorPattern | None,
        three: Array | None,
    ) -> dict[str, Any] | None:  # fmt: skip
        """Six numbers and their rates by one of Bales' iterations; errors are taken as the pose's.

        ``None`` where the post or an outer reflector is not visible.
        """
        if pattern is None or three is None or reading.pose is None or reading.covariance is None:
            self._rates.clear()
            return None
        left, right = pattern.base
        centre = post_of(pattern)
        assert centre is not None
        order = [centre, left, right]
        rays = camera.rays(three[[1, 0, 2]])
        post_m = float(pattern.target_from_face.inverse().apply(pattern.positions_m[centre])[2])
        solve = newton_raphson if self.iteration is Iteration.NEWTON else alternate_iteration
        answer = solve(rays, pattern.base_m, post_m)
        found: dict[str, Any] = {
            "method": str(self.iteration),
            "converged": answer.converged,
            "iterations": answer.iterations,
            "residual": answer.residual,
            "distances_m": {
                pattern.names[k]: float(d) for k, d in zip(order, answer.distances_m, strict=True)
            },
        }
        if not answer.converged:
            self._rates.clear()
            return found | {"pose": None, "six": None, "rates": None}
        pose = pose_from_distances(rays, answer.distances_m, pattern.positions_m[order])
        face, rates = Face.of(pattern), None
        if reading.time_s is not None:
            rates = self._rates.add(reading.time_s, pose, reading.covariance, face)
        return found | {
            "pose": pose, "six": face.six_numbers(pose), "rates": rates_record(rates)
        }  # fmt: skip


def outer_and_centre(pattern: ReflectorPattern, reading: ReflectorObservation) -> Array | None:
    """(3, 2) spots of left, post and right reflector; None where one is not visible."""
    left, right = pattern.base
    centre = post_of(pattern)
    if centre is None:
        return None
    rows = []
    for k in (left, centre, right):
        if pattern.names[k] not in reading.reflectors:
            return None
        rows.append(reading.spots.centroids_px[reading.reflectors.index(pattern.names[k])])
    return np.array(rows)
