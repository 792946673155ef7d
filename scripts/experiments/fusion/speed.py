"""Time of a filter step: prediction, gate, trust and update, as Fusion.add does them."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from experiments.frame import MODELS_CAD
from rendezview.fusion import (
    BeamSurface,
    Fusion,
    FusionOptions,
    Measurement,
    PoseMeasurement,
    RangeMeasurement,
    RingCandidate,
    RingMeasurement,
    SensorOptions,
)
from rendezview.geometry.pose import Pose
from rendezview.io.target import Target

CLIENT = MODELS_CAD / "client"
STEPS = 400


def measurements(seed: int) -> dict[str, list[Measurement]]:
    """Good measurements of a target at rest, of each kind, 10 a second."""
    rng = np.random.default_rng(seed)
    ring = Target.load(CLIENT).docking_ring
    assert ring is not None
    rotation = Rotation.from_rotvec([0.0, -0.5 * np.pi, 0.0]).as_matrix()
    truth = Pose(rotation, np.array([0.1, -0.2, 12.0]))
    sigma = np.array([2e-3, 2e-3, 1e-3, 5e-3, 5e-3, 2e-2])
    surface = BeamSurface(ring.centre_m, ring.axis)
    normal = rotation @ ring.axis
    distance = float(normal @ truth.apply(ring.centre_m)) / float(normal[2])
    found: dict[str, list[Measurement]] = {"pose": [], "ring": [], "range": []}
    for k in range(STEPS):
        t = 0.1 * k
        noisy = truth.perturbed(sigma * rng.standard_normal(6))
        found["pose"].append(PoseMeasurement(t, "camera", noisy, np.diag(sigma**2)))
        centre = truth.apply(ring.centre_m) + 5e-3 * rng.standard_normal(3)
        axis = normal + 5e-3 * rng.standard_normal(3)
        flat = 5e-3**2 * (np.eye(3) - np.outer(normal, normal))
        covariance = np.block([[5e-3**2 * np.eye(3), np.zeros((3, 3))], [np.zeros((3, 3)), flat]])
        other = axis + np.array([0.02, 0.0, 0.0])
        candidates = tuple(
            RingCandidate(centre, a / np.linalg.norm(a), covariance) for a in (axis, other)
        )
        found["ring"].append(RingMeasurement(t, "ring", candidates, ring))
        echo = distance + 0.02 * rng.standard_normal()
        found["range"].append(RangeMeasurement(t, "laser", echo, 0.02, (surface,)))
    return found


WHITE = SensorOptions(bias_share=0.1)  # as these are made
OPTIONS = FusionOptions(pose=WHITE, ring=WHITE, range=WHITE)


def started(kinds: dict[str, list[Measurement]]) -> Fusion:
    """All three sensors have reported: the state has its full size."""
    fusion = Fusion(OPTIONS)
    for kind in ("pose", "ring", "range"):
        fusion.add(kinds[kind][0])
    return fusion


def plain_numpy() -> Callable[[], None]:
    """One step of a 12-state Kalman filter."""
    step, noise = np.eye(12), 1e-6 * np.eye(12)
    step[:6, 6:] = 0.1 * np.eye(6)
    design = np.hstack([np.eye(6), np.zeros((6, 6))])
    white, value = 1e-4 * np.eye(6), 1e-3 * np.ones(6)
    identity = np.eye(12)

    def run() -> None:
        state, covariance = np.zeros(12), np.eye(12)
        state = step @ state
        covariance = step @ covariance @ step.T + noise
        across = covariance @ design.T
        gain = np.linalg.solve(design @ across + white, across.T).T
        state = state + gain @ (value - design @ state)
        covariance = (identity - gain @ design) @ covariance

    return run


def run(*, seed: int = 0, repeats: int = 15) -> None:
    """Time of a filter step: prediction, gate, trust and update, as Fusion.add does them.

    Beside it, in the same run, a 12-state Kalman filter in plain numpy: prediction and update
    with six numbers, no gate, no attitude, no biases.
    """
    kinds = measurements(seed)
    spent_us: dict[str, list[float]] = {kind: [] for kind in (*kinds, "state_at", "late", "numpy")}
    for _ in range(repeats):
        plain = plain_numpy()
        start = time.perf_counter()
        for _ in range(STEPS):
            plain()
        spent_us["numpy"].append(1e6 * (time.perf_counter() - start) / STEPS)
        for kind, series in kinds.items():
            fusion = started(kinds)
            start = time.perf_counter()
            for measurement in series[1:]:
                fusion.add(measurement)
            spent_us[kind].append(1e6 * (time.perf_counter() - start) / (STEPS - 1))
        start = time.perf_counter()
        for k in range(STEPS):
            fusion.state_at(0.1 * STEPS + 1e-3 * k)
        spent_us["state_at"].append(1e6 * (time.perf_counter() - start) / STEPS)
        late = kinds["pose"]
        fusion = Fusion(OPTIONS)
        for k in range(0, STEPS - 12, 12):  # the second of each dozen comes ten steps late
            for j in (0, *range(2, 12)):
                fusion.add(late[k + j])
            start = time.perf_counter()
            fusion.add(late[k + 1])
            spent_us["late"].append(1e6 * (time.perf_counter() - start))
    names = {
        "pose": "pose, six numbers",
        "ring": "ring, five numbers, two candidates",
        "range": "range, one number",
        "late": "pose, ten measurements late",
        "state_at": "estimate at a time",
        "numpy": "plain numpy, 12 states",
    }
    print(f"seed {seed}; best and median of {repeats} runs, µs a step")
    for kind, name in names.items():
        values = np.array(spent_us[kind])
        print(f"{name:36s} {values.min():7.1f} {np.median(values):7.1f}")
