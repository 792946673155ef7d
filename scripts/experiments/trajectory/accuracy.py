"""Errors of segments, predictions and spin."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from scipy.spatial.transform import Rotation

from experiments.frame import kept, mesh_of, nees, show, table_of
from rendezview import Camera, Pose, Recognizer, Tracker, ViewModel, trajectory
from rendezview.geometry.pose import Array
from rendezview.sensors.appearance import AppearanceObservation
from rendezview.sensors.appearance.outline.interpolation import Interpolator
from rendezview.sensors.appearance.outline.votes import Match
from rendezview.trajectory import NoFit, PointCloud, Shape, fit_segment
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate import SceneOptions, render_frame, sun_at_phase
from rendezview_ground.simulate.trajectories import looking_at, torque_free

KINDS = ("circular", "spiral", "vbar", "spin", "tumble")
FRAMES = 100
STEP_S = 2.0
SPAN_S = FRAMES * STEP_S
RATE_RAD_S = 1.0 / SPAN_S
JITTER_RAD = np.deg2rad(0.3)
INERTIA = (1.0, 1.6, 2.0)
CAMERA = Camera.from_fov(1024, 768, float(np.deg2rad(53.0)))
SHAPES = {"circular": Shape.CIRCULAR, "spiral": Shape.SPIRAL, "vbar": Shape.VBAR}


def true_path(
    kind: str, radius_m: float, centre_m: Array, seed: int
) -> tuple[Callable[[Array], Array], Callable[[Array], tuple[Array, Array]]]:
    """Where the camera is, and how the target turns, at any times; without jitter.

    Returns:
        Times (N,) to camera places (N, 3), target frame; times to ``reference_from_target``
        (N, 3, 3) and the target's angular velocity (N, 3) in its own axes. The reference is a
        frame in which the target's centre is fixed on +z, as the camera's does.
    """
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    axes = Rotation.random(random_state=rng).as_matrix()
    ahead, across, normal = axes
    if kind in ("spin", "tumble"):
        direction = rng.standard_normal(3)
        rate = RATE_RAD_S * direction / np.linalg.norm(direction)
        inertia = INERTIA if kind == "tumble" else (1.0, 1.0, 1.0)
        place = centre_m + 3.5 * radius_m * ahead
        first = looking_at(place, centre_m, normal).rotation

        def turn(times_s: Array) -> tuple[Array, Array]:
            grid = np.concatenate([[0.0], times_s])
            unique, back = np.unique(grid, return_inverse=True)
            inertial_from_body, rates = torque_free(inertia, rate, unique)
            return first @ inertial_from_body[back][1:], rates[back][1:]

        def places(times_s: Array) -> Array:
            turned, _ = turn(times_s)
            away = np.array([0.0, 0.0, -3.5 * radius_m])
            return np.asarray(centre_m + np.einsum("nji,j->ni", turned, away))

        return places, turn

    hop_s, hop_phase = SPAN_S / 3.0, rng.uniform(0.0, SPAN_S / 3.0)

    def flown(times_s: Array) -> Array:
        t = np.asarray(times_s, np.float64)[:, None]
        if kind == "vbar":
            distance = radius_m * (6.0 - t / SPAN_S)
            height = 0.03 * distance * np.abs(np.sin(math.pi * (t - hop_phase) / hop_s))
            return np.asarray(centre_m + distance * ahead + height * across)
        distance = radius_m * (3.5 if kind == "circular" else 4.5 - 0.5 * t / SPAN_S)
        angle = RATE_RAD_S * t
        return np.asarray(centre_m + distance * (np.cos(angle) * ahead + np.sin(angle) * across))

    def turned(times_s: Array) -> tuple[Array, Array]:
        up = across if kind == "vbar" else normal
        poses = np.stack([looking_at(p, centre_m, up).rotation for p in flown(times_s)])
        rates = np.tile(-RATE_RAD_S * normal, (len(times_s), 1))
        return poses, (np.zeros_like(rates) if kind == "vbar" else rates)

    return flown, turned


def observations(model: ViewModel, mesh: Mesh, kind: str, seed: int) -> dict[str, np.ndarray]:
    """One segment through the renderer and both trackers, as arrays."""
    centre_m = model.centre_m
    places, turns = true_path(kind, model.target_radius_m, centre_m, seed)
    times_s = STEP_S * np.arange(FRAMES)
    rotations, truth = turns(times_s)[0], places(times_s)
    rng = np.random.default_rng([seed, KINDS.index(kind), 1])
    jitter = Rotation.from_rotvec(JITTER_RAD * rng.standard_normal((FRAMES, 3))).as_matrix()
    poses = [Pose(j @ r, -(j @ r) @ t) for j, r, t in zip(jitter, rotations, truth, strict=True)]
    both = (Recognizer(model, CAMERA), Recognizer(model, CAMERA, refine=False))
    trackers = [Tracker(recognizer, poses[0]) for recognizer in both]
    between = Interpolator(model)
    refined, nodes, interpolated = [], [], []
    for k, (time_s, pose) in enumerate(zip(times_s.tolist(), poses, strict=True)):
        sun = sun_at_phase(pose.apply(centre_m), 0.0, 0.0)
        frame = render_frame(mesh, CAMERA, pose, sun, SceneOptions(), rng, time_s)
        fine, rough = (tracker.update(time_s, frame) for tracker in trackers)
        refined += [(k, fine.pose, fine.covariance)] * (fine.pose is not None)
        if len(rough.points_m):
            nodes.append((k, rough.points_m, rough.weights))
        if len(rough.points_m) and rough.pose is not None and rough.signature is not None:
            interpolated.append((k, *between_nodes(between, rough, centre_m)))
    return {
        "centre_m": centre_m, "radius_m": np.array(model.target_radius_m), "times_s": times_s,
        "truth_m": truth, "true_rotation": rotations, "jitter": jitter,
        "pose_frame": np.array([k for k, _, _ in refined]),
        "rotation": np.array([pose.rotation for _, pose, _ in refined]),
        "translation_m": np.array([pose.translation_m for _, pose, _ in refined]),
        "covariance": np.array([spread for _, _, spread in refined]),
        **points_of("node", nodes), **points_of("between", interpolated),
    }  # fmt: skip


def points_of(name: str, found: list[tuple[int, Array, Array]]) -> dict[str, np.ndarray]:
    """Points, their weights and frames, of lists by frame."""
    return {
        f"{name}_frame": np.concatenate([np.full(len(points), k) for k, points, _ in found]),
        f"{name}_m": np.concatenate([points for _, points, _ in found]),
        f"{name}_weight": np.concatenate([weights for _, _, weights in found]),
    }


def between_nodes(
    between: Interpolator, rough: AppearanceObservation, centre_m: Array
) -> tuple[Array, Array]:
    """Points and weights, from the signature and the active nodes of a frame only."""
    away, trust = rough.points_m - centre_m, rough.weights
    mean = trust @ (away / np.linalg.norm(away, axis=1)[:, None])
    attitude = rough.signature.centred_from_camera @ rough.pose.rotation
    match = Match(rough.active_nodes, trust, mean / np.linalg.norm(mean), attitude)
    return between.points(match, rough.signature, 1.0 / CAMERA.fx)


def weighted(name: str, data: dict[str, Array]) -> tuple[Array, Array, Array]:
    """Times, points about the centre and weights."""
    times_s = data["times_s"][data[f"{name}_frame"]]
    return times_s, data[f"{name}_m"] - data["centre_m"], data[f"{name}_weight"]


def clouds(data: dict[str, Array]) -> dict[str, PointCloud]:
    """Of active nodes; of refined poses, by the target's attitude and by the chaser's own."""
    posed_s = data["times_s"][data["pose_frame"]]
    # The camera's axes known to the chaser, so that the target's attitude takes no part.
    known = np.swapaxes(data["jitter"] @ data["true_rotation"], 1, 2)[data["pose_frame"]]
    places, spreads = placed(trajectory.centre_place, data)
    own = (np.einsum("nij,nj->ni", known, places), known @ spreads @ np.swapaxes(known, 1, 2))
    return {
        "nodes": PointCloud.of_nodes(*weighted("node", data)),
        "refined": PointCloud.of_places(posed_s, *placed(trajectory.camera_place, data)),
        "refined, own attitude": PointCloud.of_places(posed_s, *own),
        "between nodes": PointCloud.of_nodes(*weighted("between", data)),
    }


def placed(
    place_of: Callable[[Pose, Array, Array], tuple[Array, Array]], data: dict[str, Array]
) -> tuple[Array, Array]:
    """Places (N, 3) and covariances (N, 3, 3) of the refined poses."""
    poses = zip(data["rotation"], data["translation_m"], data["covariance"], strict=True)
    parts = [place_of(Pose(turn, move), spread, data["centre_m"]) for turn, move, spread in poses]
    places, spreads = (np.array(part) for part in zip(*parts, strict=True))
    return places, spreads


def spins(data: dict[str, Array], kind: str) -> dict[str, trajectory.Spin | NoFit]:
    """From directions of active nodes, from attitudes with the chaser's own known."""
    frames, times = data["pose_frame"], data["times_s"]
    back = np.swapaxes(data["jitter"][frames], 1, 2)
    attitudes = back @ data["rotation"]
    spreads = back @ data["covariance"][:, :3, :3] @ np.swapaxes(back, 1, 2)
    tumbling = kind == "tumble"
    nodes, between = weighted("node", data), weighted("between", data)
    return {
        "nodes": trajectory.fit_spin_of_directions(*nodes, tumbling=tumbling),
        "refined": trajectory.fit_spin(times[frames], attitudes, spreads, tumbling=tumbling),
        "between nodes": trajectory.fit_spin_of_directions(*between, tumbling=tumbling),
    }


def segment_errors(fit: trajectory.Segment, data: dict[str, Array], kind: str, seed: int) -> Array:
    """Median error of the fit, % of range; of the prediction; NEES; within 10 % of range."""
    flown, _ = true_path(kind, float(data["radius_m"]), data["centre_m"], seed)
    times = data["times_s"]
    errors = []
    for at in (times, times + SPAN_S):
        truth = flown(at) - data["centre_m"]
        off = np.linalg.norm(fit.places(at) - truth, axis=1) / np.linalg.norm(truth, axis=1)
        errors.append(100.0 * float(np.median(off)))
    middle = np.array([fit.middle_s])
    miss = fit.places(middle)[0] - (flown(middle)[0] - data["centre_m"])
    return np.array([*errors, nees(miss, fit.place_covariance(fit.middle_s))])


def spin_errors(spin: trajectory.Spin, data: dict[str, Array], kind: str, seed: int) -> Array:
    """Rate, %; axis, degrees; camera's place as the spin puts it, % of range, fitted, predicted."""
    _, turn = true_path(kind, float(data["radius_m"]), data["centre_m"], seed)
    true_rate = turn(np.array([spin.time_s]))[1][0]
    size = float(np.linalg.norm(true_rate))
    rate = 100.0 * abs(spin.speed_rad_s / size - 1.0)
    cosine = np.clip(spin.axis @ true_rate / size, -1.0, 1.0)
    off = []
    for at in (data["times_s"], data["times_s"] + SPAN_S):
        true_turn, _ = turn(at)
        found, _ = spin.at(at)
        # The camera is on −z of the reference: its direction in target axes.
        moved = np.linalg.norm(true_turn[:, 2] - found[:, 2], axis=1)
        off.append(100.0 * float(np.median(moved)))
    return np.array([rate, float(np.rad2deg(np.arccos(cosine))), *off])


def judge(
    columns: str, kinds: Sequence[str], drawn: dict[tuple[str, int], dict[str, Array]],
    errors: Callable[..., Array], fits: Callable[[dict[str, Array], str], Mapping[str, Any]],
) -> None:  # fmt: skip
    """A row for each kind of path and source of points: median, 90 % and largest over seeds."""
    table = table_of("median / 90 % / largest over seeds", columns)
    for kind in kinds:
        found = {seed: fits(data, kind) for (one, seed), data in drawn.items() if one == kind}
        for source in next(iter(found.values()), ()):
            values = []
            for seed, each in found.items():
                fit = each[source]
                if isinstance(fit, NoFit):
                    print(f"{kind} {source} seed {seed}: {fit.reason}")
                else:
                    values.append(errors(fit, drawn[kind, seed], kind, seed))
            spread = np.percentile(values, [50.0, 90.0, 100.0], axis=0).T if values else []
            cells = [" / ".join(f"{value:.3f}" for value in each) for each in spread]
            table.add_row(f"{kind}, {source}", f"{len(values)} of {len(found)}", *cells)
    show(table, width=120)


def run(
    folder: Annotated[Path, "of the observations, kept"],
    model: Annotated[Path, "of client, with far readings"], *, seeds: tuple[int, int] = (0, 20),
) -> None:  # fmt: skip
    """Draw paths of the client, recognise their frames, and judge segments, predictions and spin.

    FOLDER keeps segments of 100 frames, 2 s apart: 1024 × 768, 53° across, the Sun behind the
    camera. Two trackers read each frame: one with refinement, one with the trees only. circular:
    one radian at 3.5 target radii. spiral: the same from 4.5 to 4 radii. vbar: from 6 to 5 radii,
    with three hops of 3 % of the distance. spin, tumble: the camera is fixed at 3.5 radii, the
    target turns through one radian about a fixed axis, or freely with moments 1 : 1.6 : 2.

    Position errors are medians over the segment, and over the next one predicted. "nodes": the
    trees only. "between nodes": the signatures stored around the nodes. "own attitude": the chaser
    knows its own attitude (a star tracker), and the target's is not used for the place. For
    circular and spiral, the spin is that of the target in the frame of the line of sight. NEES is
    of the place in the middle: 3 is right. Rows: median, 90 % and largest over seeds.
    """
    views, (_, mesh) = ViewModel.load(model), mesh_of("client")
    drawn: dict[tuple[str, int], dict[str, Array]] = {}
    for kind, seed in product(KINDS, range(*seeds)):
        made = partial(observations, views, mesh, kind, seed)
        drawn[kind, seed] = kept(folder / f"{views.name}-{kind}-{seed}.npz", made)
    judge(
        "segments | fitted | position, % of range | predicted, % of range | NEES",
        tuple(SHAPES), drawn, segment_errors,
        lambda data, kind: {
            source: fit_segment(cloud, SHAPES[kind]) for source, cloud in clouds(data).items()
        },
    )  # fmt: skip
    columns = "spin | fitted | rate, % | axis, ° | position, % of range | predicted, %"
    judge(columns, ("spin", "tumble", "circular", "spiral"), drawn, spin_errors, spins)
