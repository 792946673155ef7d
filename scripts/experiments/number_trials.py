"""Small simulated data and their figures, for `experiments.number_effects`."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rendezview.simulation import SceneOptions, render_frame, sun_at_phase
from rendezview.simulation.background import Earth
from scipy.spatial.transform import Rotation

from experiments import sensor_trials
from experiments.frame import CLIENT, mesh_of, nees
from experiments.sensor_trials import Figures, Trial
from experiments.trajectory import methods
from rendezview.fusion import (
    BeamSurface,
    Fusion,
    PoseMeasurement,
    RangeMeasurement,
    RingCandidate,
    RingMeasurement,
)
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.geometry.symmetry import angle_between
from rendezview.io.target import Target
from rendezview.sensors.appearance import Recognizer, Tracker, ViewModel
from rendezview.trajectory import Method, Nothing, fit_spin


def fusion(seed: int) -> Trial:
    """Five minutes from 40 m to 3 m; the pose is 0.5 m off in the third quarter, a ring beside.

    Six runs, of pose (1 Hz), ring from the middle (1 Hz) and laser (2 Hz). All are silent for 20 s.
    """
    ring = Target.load(CLIENT).docking_ring
    assert ring is not None
    surface = BeamSurface(ring.centre_m, ring.axis)
    sigma = np.array([4e-3, 4e-3, 2e-3, 0.01, 0.01, 0.05])
    runs = []
    for k in range(6):
        rng = np.random.default_rng([seed, k])
        facing = Rotation.from_rotvec([0.0, -0.5 * np.pi, 0.0]).as_matrix()
        rate, drift = rng.normal(0.0, 3e-4, 3), rng.normal(0.0, 3e-3, 3)
        steps: list[tuple[Pose, list[Any]]] = []
        for n in range(600):
            t = 0.5 * n
            far = 40.0 * math.exp(-t / 115.0)
            turn = Rotation.from_rotvec(rate * t).as_matrix() @ facing
            truth = Pose(turn, np.array([0.1, -0.2, far]) + drift * min(t, 60.0))
            received: list[Any] = []
            if not 100.0 < t < 120.0:
                if n % 2 == 0:
                    noisy = truth.perturbed(sigma * (far / 20.0) * rng.standard_normal(6))
                    off = np.array([0.5, 0.0, 0.0]) * (150.0 < t < 225.0)
                    shifted = Pose(noisy.rotation, noisy.translation_m + off)
                    spread = np.diag((sigma * far / 20.0) ** 2)
                    received.append(PoseMeasurement(t, "camera", shifted, spread))
                elif t > 130.0:
                    received.append(_ring(t, truth, ring, rng, wrong=rng.random() < 0.1))
                normal = truth.rotation @ ring.axis
                distance = float(normal @ truth.apply(ring.centre_m)) / float(normal[2])
                echo = distance + 0.02 * rng.standard_normal()
                received.append(RangeMeasurement(t, "laser", echo, 0.02, (surface,)))
            steps.append((truth, received))
        runs.append(steps)

    def trial() -> Figures:
        off, squares, none, lockouts, starts = [], [], 0, 0, 0
        for steps in runs:
            filtered = Fusion()
            for n, (truth, received) in enumerate(steps):
                for measurement in received:
                    filtered.add(measurement)
                estimate = filtered.state_at(0.5 * n)
                if estimate.pose is None or estimate.covariance is None:
                    none += 1
                    continue
                turned = Rotation.from_matrix(estimate.pose.rotation @ truth.rotation.T).as_rotvec()
                shift = estimate.pose.translation_m - truth.translation_m
                off.append(100.0 * np.linalg.norm(shift) / truth.translation_m[2])
                squares.append(nees(np.append(turned, shift), estimate.covariance[:6, :6]))
            lockouts += sum(trust.lockouts for trust in filtered.trusts.values())
            starts += filtered.starts
        return {
            "error %": float(np.median(off)), "95 %": float(np.percentile(off, 95)),
            "NEES": float(np.median(squares)), "mean": float(np.mean(squares)), "none": none,
            "lockouts": lockouts, "starts": starts,
        }  # fmt: skip

    return trial


def _ring(t: float, truth: Pose, ring: Any, rng: np.random.Generator, wrong: bool) -> Any:
    normal = truth.rotation @ ring.axis
    centre = truth.apply(ring.centre_m)
    centre = centre * (1.06 if wrong else 1.0) + 5e-3 * rng.standard_normal(3)
    axis = normal + 5e-3 * rng.standard_normal(3)
    flat = 5e-3**2 * (np.eye(3) - np.outer(normal, normal))
    covariance = np.block([[5e-3**2 * np.eye(3), np.zeros((3, 3))], [np.zeros((3, 3)), flat]])
    candidates = tuple(
        RingCandidate(centre, a / np.linalg.norm(a), covariance)
        for a in (axis, axis + np.array([0.05, 0.0, 0.0]))
    )
    return RingMeasurement(t, "ring", candidates, ring)


def trajectory(seed: int) -> Trial:
    """64 clouds of four kinds of path, with outliers; 12 spins, half of them tumbling."""
    clouds = []
    for number, kind in enumerate(methods.PATHS):
        for count in (20, 60):
            for share in (0.0, 0.2):
                for k in range(4):
                    rng = np.random.default_rng([seed, number, count, round(100 * share), k])
                    flown = methods.path(kind, rng)
                    clouds.append((kind, methods.cloud_of(flown, count, share, rng), flown))
    turns = []
    for k in range(12):
        rng = np.random.default_rng([seed, k])
        times = np.linspace(0.0, 200.0, 40)
        rate = rng.normal(0.0, 0.006, 3)
        noise = Rotation.from_rotvec(rng.normal(0.0, 2e-3, (40, 3)))
        wobble = Rotation.from_rotvec(
            0.1 * np.outer(np.sin(0.03 * times), [0.0, float(k % 2), 0.0])
        )
        seen = (noise * wobble * Rotation.from_rotvec(np.outer(times, rate))).as_matrix()
        turns.append((times, seen, rate, bool(k % 2)))

    def trial() -> Figures:
        off, failed, rates, none = [], 0, [], 0
        for kind, cloud, flown in clouds:
            found = methods.by_us(cloud, kind, method=Method.BEST)
            truth = flown(cloud.times_s)
            far = np.linalg.norm(truth, axis=1)
            error = np.inf
            if found is not None:
                error = float(np.median(np.linalg.norm(found - truth, axis=1) / far))
            failed += error > methods.FAILED
            if error <= methods.FAILED:
                off.append(100.0 * error)
        for times, seen, rate, tumbling in turns:
            spread = np.tile(2e-3**2 * np.eye(3), (len(times), 1, 1))
            spin = fit_spin(times, seen, spread, tumbling=tumbling)
            if isinstance(spin, Nothing):
                none += 1
            elif not tumbling:
                rates.append(100.0 * abs(spin.speed_rad_s / np.linalg.norm(rate) - 1.0))
        return {
            "failed": failed, "error %": float(np.median(off)), "no spin": none,
            "rate %": float(np.median(rates)),
        }  # fmt: skip

    return trial


def appearance(seed: int, model: Path | None) -> Trial:
    """16 first poses, 6 before the Earth, a fly-around of 40 frames with a gap; 640 × 480."""
    assert model is not None, "give --model, of hubble"
    views = ViewModel.load(model)
    _, mesh = mesh_of("hubble")
    rng = np.random.default_rng(seed)
    camera = Camera.from_fov(640, 480, np.deg2rad(40.0))
    frames, sequence = [], []
    for k in range(22):
        rotation = Rotation.random(random_state=rng).as_matrix()
        centre = np.array([*rng.uniform(-0.1, 0.1, 2), 1.0]) * rng.uniform(4.0, 7.0)
        centre *= views.target_radius_m
        pose = Pose(rotation, centre - rotation @ views.centre_m)
        sun = sun_at_phase(centre, np.deg2rad(rng.uniform(0.0, 60.0)), rng.uniform(0.0, 6.28))
        options = SceneOptions(earth=Earth(seed=k) if k >= 16 else None, sky_frame="camera")
        frames.append((render_frame(mesh, camera, pose, sun, options, rng), pose))
    first = frames[0][1]
    sun = sun_at_phase([0.0, 0.0, 1.0], np.deg2rad(25.0), 1.0)
    for k in range(40):
        turn = Rotation.from_rotvec(np.deg2rad(3.0 * k) * np.array([0.3, 0.9, 0.1])).as_matrix()
        middle = first.apply(views.centre_m)
        rotation = turn @ first.rotation
        pose = Pose(rotation, middle - rotation @ views.centre_m)
        image = render_frame(mesh, camera, pose, sun, SceneOptions(sky_frame="camera"), rng)
        sequence.append((np.zeros_like(image) if 20 <= k < 24 else image, pose))

    def trial() -> Figures:
        recognizer = Recognizer(views, camera, sketch=False)
        counts = {"right": 0, "wrong": 0, "near": 0, "tracked": 0}
        errors: list[float] = []
        squares: list[float] = []
        pushed = np.array([0.05, -0.05, 0.03, 0.0, 0.0, 0.0])

        def judged(answer: Any, truth: Pose, what: str) -> None:
            if answer.pose is None:
                return
            degrees = np.rad2deg(angle_between(answer.pose, truth, views.symmetries))
            if degrees > 5.0:
                counts["wrong"] += 1
                return
            counts[what] += 1
            errors.append(float(degrees))
            if answer.covariance is not None:
                turn = Rotation.from_matrix(answer.pose.rotation @ truth.rotation.T).as_rotvec()
                shift = answer.pose.translation_m - truth.translation_m
                if np.linalg.norm(turn) < 0.1:
                    squares.append(nees(np.append(turn, shift), answer.covariance))

        for image, truth in frames:
            judged(recognizer.recognize(image), truth, "right")
            near = Pose(truth.rotation, truth.translation_m).perturbed(pushed)
            judged(recognizer.recognize(image, near), truth, "near")
        tracker = Tracker(recognizer)
        for k, (image, truth) in enumerate(sequence):
            judged(tracker.update(float(k), image), truth, "tracked")
        return {
            **counts, "error °": float(np.median(errors)), "95 %": float(np.percentile(errors, 95)),
            "NEES": float(np.median(squares)),
        }  # fmt: skip

    return trial


PARTS: dict[str, tuple[list[str], Callable[..., Trial]]] = {
    "fusion": (["fusion"], fusion),
    "reflectors": (["sensors/reflectors", "estimation/spot_centroid.py"], sensor_trials.reflectors),
    "ring": (["sensors/ring"], sensor_trials.ring),
    "stereo": (["sensors/stereo"], sensor_trials.stereo),
    "trajectory": (["trajectory"], trajectory),
    "appearance": (["sensors/appearance"], appearance),
}
