"""Node decisions and direction of view on held-out frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
from scipy.spatial.transform import Rotation

from experiments.frame import mesh_of, show, table_of, unit
from rendezview import Camera, Pose, Recognizer, TrainingOptions, ViewModel
from rendezview.geometry.geodesic import angle_between
from rendezview.geometry.pose import Array, rotation_angle
from rendezview.sensors.appearance.model.signature import Signature, twist
from rendezview.sensors.appearance.outline.silhouette import Missing, Silhouette, find_silhouette
from rendezview.sensors.appearance.outline.votes import Matcher
from rendezview_ground.learn.jobs.open_executor import open_executor
from rendezview_ground.learn.options import view_geometry
from rendezview_ground.learn.trees.node_trees import IN_EDGES, OUT_EDGES
from rendezview_ground.learn.views.views import clean_views, look_from
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.render.renderers import make_renderer
from rendezview_ground.simulate import SceneOptions, SensorOptions, ShadingOptions, render_frame
from rendezview_ground.simulate.scene import sun_at_phase

WIDTH, HEIGHT = 640, 480
WRONG_DEG = 8.0  # rotation error of an answer that is not one
PRIOR_DEG = 20.0
PHASES_DEG = ((0.0, 0.0), (0.0, 30.0), (30.0, 60.0))  # of the Sun
REAL = ("(b) real frames", "(c) 20° prior", "(d) 20° prior, Sun 0–30°", "(e) 20° prior, Sun 30–60°")


def tally(
    model: ViewModel, direction: Array, on: Array, *, seen: Array | None = None,
    rotation_deg: float = np.nan, range_percent: float = np.nan,
) -> Array:  # fmt: skip
    """(8,) in right and all, out right and all, nodes on, and errors; ∞: none, NaN: not asked.

    ``direction``: (3,) true one of the view; ``on``: the nodes that are on; ``seen``: (3,) the
    direction that was found; the other errors are those of the whole recognizer.
    """
    edge, nodes = model.geodesic.mean_edge_rad, within(model, direction)
    distance = angle_between(model.geodesic.nodes[nodes], direction) / edge
    inside = distance <= IN_EDGES
    outside = (distance >= OUT_EDGES[0]) & (distance <= OUT_EDGES[1])
    here = np.isin(nodes, on)
    off = np.inf if seen is None else np.rad2deg(angle_between(seen, direction))
    counts = [(inside & here).sum(), inside.sum(), (outside & ~here).sum(), outside.sum(), len(on)]
    return np.array([*counts, off, rotation_deg, range_percent])


def within(model: ViewModel, direction: Array) -> Array:
    """The nodes within three edges."""
    return model.geodesic.within(direction, OUT_EDGES[1] * model.geodesic.mean_edge_rad)


def flight_camera(mesh: Mesh) -> Camera:
    """640 × 480, the target filling it at the sphere radius."""
    focal = view_geometry(mesh, TrainingOptions(), None).flight_focal_px
    return Camera(WIDTH, HEIGHT, focal, focal, 0.5 * (WIDTH - 1), 0.5 * (HEIGHT - 1))


def random_pose(model: ViewModel, camera: Camera, rng: np.random.Generator) -> tuple[Array, Pose]:
    """Direction of view (3,) and camera_from_target, uniform, the target inside the picture."""
    direction = unit(rng)
    range_m = model.sphere_radius_m * rng.uniform(1.0, 3.0)
    half = np.arctan(0.5 * np.array([camera.width, camera.height]) / camera.fx)
    room = np.maximum(half - np.arcsin(model.target_radius_m / range_m), 0.0)
    bearing = 0.95 * room * rng.uniform(-1.0, 1.0, size=2)
    turn = Rotation.from_rotvec([-bearing[1], bearing[0], 0.0]).as_matrix()
    rotation = turn @ look_from(direction, rng.uniform(0.0, 2.0 * np.pi))
    centre = turn @ np.array([0.0, 0.0, range_m])
    return direction, Pose(rotation, centre - rotation @ model.centre_m)


def frame_of(
    mesh: Mesh, model: ViewModel, camera: Camera, pose: Pose, phases_deg: tuple[float, float],
    rng: np.random.Generator,
) -> np.ndarray:  # fmt: skip
    """A shaded frame with hard shadows, blur of 0.7 px and noise of 3 grey levels."""
    phase = np.deg2rad(rng.uniform(*phases_deg))
    sun = sun_at_phase(pose.apply(model.centre_m), phase, rng.uniform(0.0, 2.0 * np.pi))
    options = SceneOptions(
        shading=ShadingOptions(samples=2, shadows=True),
        sensor=SensorOptions(blur_sigma_px=0.7, noise_sigma_grey=3.0),
    )
    return render_frame(mesh, camera, pose, sun, options, rng)


def clean(mesh: Mesh, model: ViewModel, views: int, seed: int) -> list[Array]:
    """Condition (a): the renderer of the training, other directions."""
    rng = np.random.default_rng([seed, 0])
    directions = rng.normal(size=(views, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    options = TrainingOptions(bins=model.bins, smooth_bins=model.smooth_bins)
    geometry = replace(view_geometry(mesh, options, None), sphere_radius_m=model.sphere_radius_m)
    seen = clean_views(make_renderer(options.renderer, mesh), geometry, options, directions)
    parts = (seen.readings, seen.area_sr, seen.centred_from_target, directions)
    return [
        decide(model, Signature(readings, float(area), np.eye(3)), attitude, direction, 0.0)
        for readings, area, attitude, direction in zip(*parts, strict=True)
    ]


def decide(
    model: ViewModel, signature: Signature | None, attitude: Array, direction: Array,
    roll_error_rad: float,
) -> Array:  # fmt: skip
    """Ask the nodes within three edges, the roll known but for an error."""
    if signature is None:
        return tally(model, direction, np.empty(0, np.intp))
    nodes, matcher = within(model, direction), Matcher(model)
    rolls = twist(attitude, model.views.centred_from_target[nodes]) + roll_error_rad
    trust = matcher.decided(nodes, signature.readings, rolls)
    on = trust > 0.0
    seen = matcher.consensus(nodes[on], trust[on])[0] if on.any() else None
    return tally(model, direction, nodes[on], seen=seen)


def one_real(mesh: Mesh, model: ViewModel, camera: Camera, seed: int, k: int) -> list[Array]:
    """One pose under (b), attitude known but for its roll; then (c), (d) and (e) end to end."""
    rng = np.random.default_rng([seed, 1, k])
    direction, pose = random_pose(model, camera, rng)
    roll_error = float(np.deg2rad(rng.normal()))
    frames = [frame_of(mesh, model, camera, pose, phases, rng) for phases in PHASES_DEG]
    silhouette, signature, attitude = find_silhouette(frames[0]), None, pose.rotation
    if not isinstance(silhouette, Missing):
        signature = signature_of(silhouette, camera, model)
    if signature is not None:
        attitude = signature.centred_from_camera @ pose.rotation
    found = [decide(model, signature, attitude, direction, roll_error)]
    error = unit(rng) * np.deg2rad(rng.uniform(0.0, PRIOR_DEG))
    prior = Pose(Rotation.from_rotvec(error).as_matrix() @ pose.rotation, pose.translation_m)
    recognizer = Recognizer(model, camera, refine=False)
    return found + [end_to_end(recognizer, f, prior, pose, direction) for f in frames]


def signature_of(silhouette: Silhouette, camera: Camera, model: ViewModel) -> Signature | None:
    """As the model reads it."""
    rays = [camera.rays(outline) for outline in silhouette.outlines_px]
    return Signature.of_outlines(rays, model.bins, model.smooth_bins)


def end_to_end(
    recognizer: Recognizer, frame: np.ndarray, prior: Pose, truth: Pose, direction: Array
) -> Array:
    """Conditions (c) to (e): the whole recognizer on one frame."""
    model, observation = recognizer.model, recognizer.recognize(frame, prior)
    on = observation.active_nodes
    if observation.pose is None:
        return tally(model, direction, on, rotation_deg=np.inf, range_percent=np.inf)
    camera_m = observation.pose.inverse().translation_m - model.centre_m
    range_m, true_m = np.linalg.norm(camera_m), np.linalg.norm(truth.apply(model.centre_m))
    turn = np.rad2deg(rotation_angle(observation.pose.rotation @ truth.rotation.T))
    far = 100.0 * abs(range_m / true_m - 1.0)
    seen = camera_m / range_m
    return tally(model, direction, on, seen=seen, rotation_deg=turn, range_percent=far)


def row(found: Array) -> list[str]:
    """Decisions, active nodes and errors of views (N, 8)."""
    (in_right, inside, out_right, outside), on = found[:, :4].sum(axis=0), found[:, 4]

    def quantiles(errors: Array) -> str:
        if np.isnan(errors).any():
            return "–"
        return " / ".join(f"{np.quantile(errors, q, method='higher'):.2f}" for q in (0.5, 0.95))

    turn, refused = found[:, 6], "–"
    if not np.isnan(turn).any():
        wrong = np.isfinite(turn) & (turn > WRONG_DEG)
        refused = f"{100 * np.mean(np.isinf(turn)):.1f} / {100 * np.mean(wrong):.1f}"
    return [
        f"{100 * (in_right + out_right) / (inside + outside):.2f}",
        f"{100 * in_right / inside:.2f}", f"{100 * out_right / outside:.2f}",
        f"{np.mean(on):.2f}", f"{100 * np.mean(on == 0):.2f}",
        *(quantiles(errors) for errors in found[:, 5:].T), refused,
    ]  # fmt: skip


def run(
    target: Annotated[Path, "target.toml, its folder, or a mesh"],
    *, model: Annotated[Path, "trained before"], views: int = 2000,
    seed: Annotated[int, "of the test frames"] = 1,
) -> None:  # fmt: skip
    """Node decisions and direction of view on held-out frames.

    Every node within three edges of random views that the model was not trained on:

    (a) the paper's conditions: a clean silhouette at the sphere radius, roll known;
    (b) real frames: 640 × 480, shaded, blurred, σ = 3 grey levels, range 1–3 sphere radii,
    off-centre bearing, roll known to 1° (one σ), light from behind the camera;
    (c) the same frames end to end: only a prior that is off by up to 20° about a random axis;
    (d) as (c), with the Sun up to 30° from behind the camera, hard shadows;
    (e) as (d), with the Sun 30–60° from behind the camera.

    In-views lie within one edge of a node, out-views between 1.32 and 3 edges. A frame without a
    silhouette has all its in-decisions wrong and its out-decisions right.
    """
    (name, mesh), loaded = mesh_of(target), ViewModel.load(model)
    shared = (mesh, loaded, flight_camera(mesh), seed)
    with open_executor(-1, None) as workers:
        done = dict(workers.results(one_real, shared, [(k,) for k in range(views)]))
    conditions = {"(a) clean": clean(mesh, loaded, views, seed)}
    for place, condition in enumerate(REAL):
        conditions[condition] = [done[k][place] for k in range(views)]
    columns = ("condition", "right %", "in %", "out %", "nodes on", "none on %",
               "direction °, median / 95 %", "rotation °, median / 95 %",
               "range %, median / 95 %", "no pose / wrong %")  # fmt: skip
    rows = table_of(f"{name}: {views} random views, seed {seed}", columns)
    for condition, found in conditions.items():
        rows.add_row(condition, *row(np.array(found)))
    show(rows, width=160)
