"""Answers of filter, trajectory and service."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from experiments.golden.answers import Answers
from experiments.golden.appearance import CAMERA, IN_SPACE, turning
from experiments.golden.models import Trained
from experiments.golden.sensors import add_ring
from experiments.service.serving import Served
from rendezview.fusion import BeamSurface, Fusion, RangeMeasurement
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.appearance import Recognizer, Tracker
from rendezview.sensors.ring import RingPrior, RingSensor
from rendezview.trajectory import (
    NoFit,
    PointCloud,
    Shape,
    fit_segment,
    fit_spin,
    fit_spin_of_directions,
)
from rendezview_ground.simulate.approach import ApproachOptions, approach, echo
from rendezview_ground.simulate.ring_frames import Circle
from rendezview_ground.simulate.scene import render_frame, sun_at_phase
from rendezview_ground.simulate.trajectories import torque_free
from rendezview_service.client import Client, pose_of_state

_SPAN_S, _RANGE_M, _MEAN_MOTION_RAD_S = 200.0, 30.0, 0.0011


def approached(answers: Answers, one: Trained, seed: int) -> None:
    """Frames of an approach to the client's ring, through three sensors into one filter.

    All are silent for 10 s, and the camera's pose is 0.5 m off for 15 s.
    """
    ring, rng = one.target.docking_ring, np.random.default_rng(seed)
    surface, beside = BeamSurface(ring.centre_m, ring.axis, 0.15), np.array([0.3, 0.0, 0.0])
    options = ApproachOptions(start_m=30.0, end_m=1.2, duration_s=96.0, dt_s=1.0)
    poses = approach(ring, options, rng)
    sun = poses[0][1].rotation.T @ sun_at_phase([0.0, 0.0, 1.0], 0.5, 1.0)
    tracker = Tracker(Recognizer(one.model, CAMERA), poses[0][1])
    sensor, filtered = RingSensor(CAMERA, ring.radius_m, circles=ring.circles), Fusion()
    for k, (time_s, truth) in enumerate(poses):
        image = render_frame(one.mesh, CAMERA, truth, truth.rotation @ sun, IN_SPACE, rng)
        seen = answers.timed("approach/tracker", tracker.update, time_s, image)
        answers.seen("approach/tracker", seen, truth, middle_m=ring.centre_m)
        known, prior = filtered.state_at(time_s), None
        if known.pose is not None:
            axis = known.pose.rotation @ ring.axis
            prior = RingPrior(centre_m=known.pose.apply(ring.centre_m), axis=axis)
        found = answers.timed("approach/ring", sensor.update, time_s, image, prior)
        there = Circle(truth.apply(ring.centre_m), truth.rotation @ ring.axis, ring.radius_m, True)
        add_ring(answers, "approach/ring", found, there)
        pose, echoed = seen.measurement("camera"), echo(one.mesh, truth, beside, [0.0, 0.0, 1.0])
        if pose is not None and 60 <= k < 75:
            off = Pose(pose.pose.rotation, pose.pose.translation_m + np.array([0.5, 0.0, 0.0]))
            pose = replace(pose, pose=off)
        range_m = None if echoed is None else echoed + 0.02 * rng.standard_normal()
        laser = range_m and RangeMeasurement(time_s, "laser", range_m, 0.02, (surface,), beside)
        for measurement in (pose, found.measurement("ring", ring=ring), laser):
            if not 30 <= k < 40:
                answers.timed("approach/fused", filtered.add, measurement)
        state = filtered.state_at(time_s)
        spread = None if state.covariance is None else state.covariance[:6, :6]
        line = [state.reason, state.rates, state.covariance]
        answers.pose("approach/fused", state.status, state.pose, truth, line=line,
                     middle_m=ring.centre_m, covariance=spread)  # fmt: skip


def segments(answers: Answers, seed: int) -> None:
    """Paths of four kinds through clouds of poses and of nodes: fitted, and a span ahead."""
    shapes = (Shape.CIRCULAR, Shape.SPIRAL, Shape.VBAR, Shape.ORBIT)
    times = np.linspace(0.0, _SPAN_S, 40)
    for number, shape in enumerate(shapes):
        for k in range(20):
            rng = np.random.default_rng([seed, number, k])
            flown, nodes = _path(shape, rng), k % 4 == 3
            places = flown(times) + 1e-3 * _RANGE_M * rng.standard_normal((40, 3))
            wild = rng.choice(40, 8 * (k % 2), replace=False)
            places[wild] += 0.1 * _RANGE_M * rng.standard_normal((len(wild), 3))
            if nodes:
                places += 0.08 * _RANGE_M * rng.standard_normal((40, 3))
                cloud = PointCloud.of_nodes(times, places)
            else:
                cloud = PointCloud.of_places(
                    times, places, np.tile((1e-3 * _RANGE_M) ** 2 * np.eye(3), (40, 1, 1))
                )
            group = f"trajectory/{shape}" + ("/nodes" if nodes else "")
            fit = partial(fit_segment, mean_motion_rad_s=_MEAN_MOTION_RAD_S)
            found = answers.timed(group, fit, cloud, shape)
            if isinstance(found, NoFit):
                answers.add(group, found.reason)
                continue
            for name, at, limit in (("", times, 0.03), ("/predicted", times + _SPAN_S, 0.1)):
                there, answer = flown(at), found.places(at)
                far = np.linalg.norm(there, axis=1)
                off = float(np.median(np.linalg.norm(answer - there, axis=1) / far))
                limit *= 5.0 if nodes else 1.0
                answers.add(group + name, "ok", line=[answer, found.covariance], errors=(off, off),
                            limits=(limit, limit), parameters=found.parameters,
                            variances=np.diag(found.covariance), places=answer[::13])  # fmt: skip


def _path(shape: Shape, rng: np.random.Generator) -> Callable[[Array], Array]:
    axes, phase = Rotation.random(random_state=rng).as_matrix(), rng.uniform(0.0, _SPAN_S / 3.0)

    def flown(times_s: Array) -> Array:
        t = times_s[:, None]
        along = t / _SPAN_S
        if shape is Shape.ORBIT:  # Clohessy–Wiltshire: an ellipse of two to one, and its height
            a = _MEAN_MOTION_RAD_S * t + phase
            return np.hstack([5.0 * np.sin(a), _RANGE_M + 10.0 * np.cos(a), 3.0 * np.cos(a)])
        if shape is Shape.VBAR:
            distance = _RANGE_M * (1.0 - 0.17 * along)
            hop = np.abs(np.sin(np.pi * (t - phase) / (_SPAN_S / 3.0)))
            return distance * axes[0] + 0.03 * distance * hop * axes[1]
        distance = _RANGE_M * (1.0 - (0.11 * along if shape is Shape.SPIRAL else 0.0))
        return distance * (np.cos(along) * axes[0] + np.sin(along) * axes[1])

    return flown


def spins(answers: Answers, seed: int) -> None:
    """Constant and tumbling spin, from attitudes and from directions."""
    times = np.linspace(0.0, _SPAN_S, 40)
    for k in range(20):
        rng, tumbling = np.random.default_rng([seed, k]), k % 2 == 1
        start = 0.012 * rng.standard_normal(3)
        turned, rates = torque_free((1.0, 1.6, 2.0) if tumbling else (1.0, 1.0, 1.0), start, times)
        noise = Rotation.from_rotvec(rng.normal(0.0, 2e-3, (40, 3))).as_matrix()
        seen, spread = noise @ turned, np.tile(2e-3**2 * np.eye(3), (40, 1, 1))
        away = -seen[:, 2] + 0.1 * rng.standard_normal((40, 3))
        for name, fit in (
            ("attitudes", partial(fit_spin, times, seen, spread, tumbling=tumbling)),
            ("directions", partial(fit_spin_of_directions, times, away, tumbling=tumbling)),
        ):
            found = answers.timed(f"spin/{name}", fit)
            if isinstance(found, NoFit):
                answers.add(f"spin/{name}", found.reason)
                continue
            true = rates[20]
            cosine = float(found.axis @ true / np.linalg.norm(true))
            errors = (float(np.arccos(np.clip(cosine, -1.0, 1.0))),
                      abs(found.speed_rad_s / float(np.linalg.norm(true)) - 1.0))  # fmt: skip
            limit = 0.1 if name == "attitudes" else 1.0
            answers.add(f"spin/{name}", "ok", line=found.moments, errors=errors,
                        limits=(limit, limit), attitude=found.rotation, rate=found.rate_rad_s,
                        covariance=found.covariance)  # fmt: skip


def service(answers: Answers, one: Trained, seed: int) -> None:
    """A session of a service in its own processes, with a filter, over HTTP."""
    frames = turning(one, 60, [seed])
    served = Served(one.path, "--workers", "1", spare_worker=False)
    try:
        served.await_ready()
        with Client(served.url) as client:
            session = client.open(CAMERA, prior=frames[0][1], record=False, name="golden")
            for k, (image, truth) in enumerate(frames):
                state = session.track(image, 0.1 * k)
                answers.pose("service", state["status"], pose_of_state(state), truth, line=state,
                             middle_m=one.model.centre_m, covariance=state["covariance"],
                             confidence=state["confidence"])  # fmt: skip
            session.close()
    finally:
        served.stop()
