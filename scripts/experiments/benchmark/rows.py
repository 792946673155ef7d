"""Groups of the benchmark: each measures its rows with the calls of the speed scripts.

Times are the least of medians taken in turns (turns); the accuracy rows are counts and errors of
the same inputs and come out alike in every run.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from rendezview.sensors.reflectors import Acquirer, find_spots, patterns_of, solve_p3p_batch
from rendezview.sensors.stereo import StereoTracker, TrackerOptions, reprocess
from rendezview.training.mesh import Mesh

from experiments.benchmark.check import Row, times
from experiments.flight_code.check import LIMIT_BYTES, perturbed
from experiments.flight_code.driver import FlightCode, build, compiler, object_bytes
from experiments.frame import MODELS_CAD
from experiments.fusion import speed as fusion_speed
from experiments.peers import opencv_contrib
from experiments.peers import visp as visp_driver
from experiments.pose import speed as pose_speed
from experiments.pose import visp_tracking
from experiments.recognition import speed as recognition_speed
from experiments.reflectors import solvers as reflector_solvers
from experiments.reflectors import speed as reflector_speed
from experiments.reflectors.run import CAMERA
from experiments.ring import speed as ring_speed
from experiments.stereo import speed as stereo_speed
from experiments.timing import Way, race
from experiments.trajectory import speed as trajectory_speed
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.geometry.symmetry import angle_between
from rendezview.io.target import Target
from rendezview.sensors.appearance import Recognizer, ViewModel
from rendezview.sensors.appearance.outline.votes import Matcher
from rendezview.sensors.ring import RingDetector
from rendezview.trajectory import Shape

MODELS = MODELS_CAD


@dataclass(frozen=True)
class Bench:
    """Data of all groups. ``frames``, ``problems``: of each kind; ``seconds``: of each race."""

    mesh: Mesh
    model_path: Path
    frames: int
    problems: int
    seconds: float
    seed: int
    peer_python: Path | None  # an interpreter with opencv-contrib

    @cached_property
    def model(self) -> ViewModel:
        return ViewModel.load(self.model_path)

    def race(self, ways: dict[str, Callable[[], object] | Way]) -> dict[str, float]:
        entered = {n: w if isinstance(w, Way) else Way(w) for n, w in ways.items()}
        return race(entered, self.seconds)


def poses(bench: Bench) -> Iterator[Row]:
    """Poses of frames beside the floor, the nearest view, and scikit-learn's loop."""
    command = "pose-speed hubble"
    full, fast = pose_speed.recognizers(bench.model)
    table: dict[str, list[float]] = {}
    errors: dict[str, list[float]] = {"with a prior": [], "first pose": [], pose_speed.NEAREST: []}
    for frame, prior, truth in pose_speed.scene(bench.mesh, full.camera, bench.frames, bench.seed):

        def degrees_off(pose: Pose | None, truth: Pose = truth) -> float:
            if pose is None:
                return math.inf
            return math.degrees(angle_between(pose, truth, bench.model.symmetries))

        calls = pose_speed.calls(full, frame)
        ways = pose_speed.tracked(full, fast, frame, prior) | calls
        for name, spent in bench.race(dict(ways)).items():
            table.setdefault(name, []).append(spent)
        for name, observation in (
            ("with a prior", fast.recognize(frame, prior)),
            ("first pose", full.recognize(frame)),
        ):
            errors[name].append(degrees_off(observation.pose))
        nearest = calls[pose_speed.NEAREST]()
        errors[pose_speed.NEAREST].append(degrees_off(Pose(nearest, truth.translation_m)))
    spent = {name: float(np.median(values)) for name, values in table.items()}
    yield from times(
        command,
        spent,
        {
            pose_speed.TRACKING: (pose_speed.FLOOR, pose_speed.NEAREST),
            pose_speed.WITH_NODES: (pose_speed.FLOOR, pose_speed.NEAREST),
            pose_speed.FIRST: (pose_speed.FLOOR, pose_speed.NEAREST),
        },
    )
    for name in ("with a prior", "first pose"):
        for what, unit, measure in (
            ("attitude error, median", "°", np.median),
            (
                "no pose or over 10° off, frames",
                "",
                lambda degrees: np.sum(np.array(degrees) > 10.0),
            ),
        ):
            ours, peer = float(measure(errors[name])), float(measure(errors[pose_speed.NEAREST]))
            yield Row(f"{what}, {name}", ours, pose_speed.NEAREST, peer, unit, command)


def nodes(bench: Bench) -> Iterator[Row]:
    """From a frame to its active nodes, and the trees by themselves."""
    model = bench.model
    count = max(3, bench.frames // 2)
    camera, frames, priors = recognition_speed.scene(bench.mesh, model, count)
    recognizer = Recognizer(model, camera, refine=False)
    pose, floor = "frame to active nodes and rough pose", "threshold, contours, binning"
    table: dict[str, list[float]] = {}
    for frame, prior in zip(frames, priors, strict=True):
        stages = recognition_speed.floor_calls(frame, camera, model.bins)
        spent = bench.race(
            {
                pose: lambda f=frame, p=prior: recognizer.recognize(f, p),
                floor: lambda s=stages: [stage() for stage in s],
            }
        )
        for name, value in spent.items():
            table.setdefault(name, []).append(value)
    medians = {name: float(np.median(values)) for name, values in table.items()}
    command = "recognition-speed"
    yield from times(command, medians, {pose: (floor,)})
    signature = recognizer.recognize(frames[0], priors[0]).signature
    assert signature is not None  # a rendered frame of the whole target
    trees = f"all {len(model.forest)} trees"
    ask = recognition_speed.all_trees(model, signature, priors[0])
    spent = bench.race(
        {
            trees: Way(lambda: [ask() for _ in range(100)], 100),
            "scikit-learn, a call a tree": pose_speed.looped_trees(model),
        }
    )
    yield from times(command, spent, {trees: ("scikit-learn, a call a tree",)})
    if bench.peer_python is not None:
        peer = opencv_contrib.linemod_ms(bench.peer_python, frames)
        ours = race({pose: Way(lambda: recognizer.recognize(frames[0], priors[0]))}, bench.seconds)
        for templates, ms in peer.items():
            name = f"linemod, templates: {templates}"
            yield Row(pose, ours[pose], name, 1e-3 * ms, "s", "recognition-speed")


def flight_code(bench: Bench) -> Iterator[Row]:
    """The trees as C beside the runtime's compiled loop, and whether they decide alike."""
    command = "export-c-check hubble.rvm models_cad/hubble"
    model, rng = bench.model, np.random.default_rng(bench.seed)
    matcher, trees = Matcher(model), np.arange(len(model.forest))
    picked = rng.integers(len(model.views.readings), size=bench.problems)
    readings = [perturbed(model.views.readings[k].astype(np.float32), rng) for k in picked]
    rolls = rng.uniform(-math.pi, math.pi, (bench.problems, len(trees)))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with FlightCode(build(model, folder, ["-O2"]), model) as code:
            differ = 0
            for view, roll in zip(readings, rolls, strict=True):
                trust = matcher.trust_of(model.forest.leaves(view, trees, roll))
                differ += not np.array_equal(code.trees(view, roll), trust)
            stacked, few = np.array(readings)[:40], rolls[:40]
            spent = bench.race(
                {
                    "all trees in C": Way(
                        lambda: 1e-9 * float(np.median(code.trees_ns(stacked, few))), own_clock=True
                    ),
                    "the runtime's loop": Way(
                        lambda: [
                            model.forest.leaves(view, trees, roll)
                            for view, roll in zip(stacked, few, strict=True)
                        ],
                        answers=len(stacked),
                    ),
                }
            )
        yield from times(command, spent, {"all trees in C": ("the runtime's loop",)})
        yield Row("signatures that C decides otherwise", differ, "none may", 0, "", command)
        size = sum(object_bytes(model, folder).values())
    yield Row("object files of C", size / 1e3, "limit", LIMIT_BYTES / 1e3, "kB", command)


def reflectors(bench: Bench) -> Iterator[Row]:
    """A reading of the reflectors beside what OpenCV needs for three centroids."""
    rng = np.random.default_rng(41)
    pattern = patterns_of(Target.load(MODELS / "client"), ("far",))[0]
    acquirer = Acquirer(CAMERA, [pattern])
    pairs = reflector_speed.pairs_at(rng, pattern, 6.0)
    first = pairs[0]
    floor = "difference, threshold, contours, moments"
    spent = bench.race(
        {
            "reflectors, acquisition": lambda: acquirer.acquire(find_spots(first)),
            "reflectors, tracking": reflector_speed.tracking(pattern, pairs),
            floor: lambda: reflector_speed.floor(first.lit, first.dark),
        }
    )
    rows = {name: (floor,) for name in spent if name != floor}
    yield from times("reflector-speed", spent, rows)


def three_points(bench: Bench) -> Iterator[Row]:
    """P3P beside poselib's and OpenCV's: time a call, and true poses missed."""
    rng = np.random.default_rng(11)
    samples = {
        name: reflector_solvers.problems(rng, name, bench.problems)
        for name in reflector_solvers.SHARES
    }
    solvers = {"P3P": reflector_solvers.this_one, **reflector_solvers.peers()}
    _, _, points, rays = samples["random triangles"]  # SQPNP refuses the small ones
    corners = [(rays[k].copy(), np.array(points[k])) for k in range(min(50, len(rays)))]
    ways = {
        name: Way(lambda s=solve: [s(ray, corner) for ray, corner in corners], len(corners))
        for name, solve in solvers.items()
    }
    ways["P3P in a batch"] = Way(lambda: solve_p3p_batch(rays, points), len(rays))
    peers = tuple(name for name in solvers if name != "P3P")
    command = "reflector-solvers"
    yield from times(command, bench.race(dict(ways)), {"P3P": peers, "P3P in a batch": peers})
    missed = {
        name: sum(
            len(s[3]) - reflector_solvers.ask(solve, s, bench.problems)[0] for s in samples.values()
        )
        for name, solve in solvers.items()
    }
    for peer in peers:
        if missed[peer]:
            what = f"P3P, true pose missed, of {len(samples) * bench.problems}"
            yield Row(what, missed["P3P"], peer, missed[peer], "", command)


def rings(bench: Bench) -> Iterator[Row]:
    """The ring detector beside OpenCV's edges with an ellipse through each, and EdgeDrawing."""
    for width, height in ring_speed.SIZES[: 2 if bench.peer_python else 1]:
        camera = Camera.from_fov(width, height, math.radians(40.0))
        frames = ring_speed.make_frames(camera, max(3, bench.frames // 2), 81)
        detector = RingDetector(camera)
        ours, floor = f"ring, {width} × {height}", "Canny, an ellipse through each chain"
        count = len(frames)
        spent = bench.race(
            {
                ours: Way(lambda d=detector, s=frames: [d.detect(f) for f in s], count),
                floor: Way(lambda s=frames: [ring_speed.floor(f) for f in s], count),
            }
        )
        yield from times("ring-speed", spent, {ours: (floor,)})
        if bench.peer_python is not None:
            theirs = opencv_contrib.ellipse_ms(bench.peer_python, frames, 15)
            best, _ = ring_speed.ours(camera, frames, 30)
            for name, values in opencv_contrib.ellipse_ms(bench.peer_python, frames, 15).items():
                peer_ms = float(np.mean(np.minimum(theirs[name], values)))
                ours_ms = float(np.mean(best))
                yield Row(ours, 1e-3 * ours_ms, name, 1e-3 * peer_ms, "s", "ring-speed")


def stereo(bench: Bench) -> Iterator[Row]:
    """Readings of lights, one by one and all at once, beside the paper's iteration in numpy."""
    target = Target.load(MODELS / "scole")
    lights = np.array([light.position_m for light in target.leds])
    rig, currents = stereo_speed.laboratory_run(lights, 21)
    few = currents[:100]
    tracker = StereoTracker.of_target(rig, target)
    plain = "the paper's iteration in plain numpy"
    spent = bench.race(
        {
            "stereo, a reading": Way(
                stereo_speed.following(rig, target, few, TrackerOptions(motion=None)), len(few)
            ),
            "stereo, a log at once": Way(lambda: reprocess(tracker, currents), len(currents)),
            plain: Way(lambda: stereo_speed.plain(rig, lights, few), len(few)),
        }
    )
    rows = {name: (plain,) for name in spent if name != plain}
    yield from times("stereo-speed", spent, rows)


def fusion(bench: Bench) -> Iterator[Row]:
    """One step of the filter beside one of 12 states in plain numpy."""
    kinds = fusion_speed.measurements(0)
    plain, numpy = fusion_speed.plain_numpy(), "plain numpy, 12 states, no gate"

    def added(kind: str) -> Way:
        def add() -> None:
            state = fusion_speed.started(kinds)
            for measurement in kinds[kind][1:101]:
                state.add(measurement)

        return Way(add, 103)

    def plain_steps() -> None:
        for _ in range(100):
            plain()

    ways: dict[str, Callable[[], object] | Way] = {f"fusion, {kind}": added(kind) for kind in kinds}
    spent = bench.race(ways | {numpy: Way(plain_steps, 100)})
    yield from times("fusion-speed", spent, dict.fromkeys(ways, (numpy,)))


def segments(bench: Bench) -> Iterator[Row]:
    """Fits of segments: our simplex beside scipy's and nlopt's, one cost for all."""
    for shape in (Shape.CIRCULAR, Shape.ORBIT):
        fit = trajectory_speed.problem(shape, 0)
        spent = bench.race({f"{shape}: {name}": run for name, run in fit.ways.items()})
        ours, scipy = f"{shape}: simplex, ours", f"{shape}: simplex, scipy"
        peers = tuple(name for name in spent if name not in (ours, f"{shape}: Gauss–Newton, ours"))
        rows = {ours: peers, f"{shape}: Gauss–Newton, ours": (scipy,)}
        yield from times("trajectory-speed", spent, rows)


def visp(bench: Bench) -> Iterator[Row]:
    """Tracking beside ViSP's model-based tracker: near priors, far ones, and a sequence."""
    command = "visp-tracking hubble --model hubble.rvm"
    with tempfile.TemporaryDirectory() as folder:
        program = visp_driver.build(Path(folder))
        singles, length = 3 * bench.frames, 5 * bench.frames
        labels = {"sequence": "sequence, 1.5° a frame"}
        for task, scores in visp_tracking.tasks(
            bench.mesh, bench.model, program, singles, length, bench.seed
        ):
            what = labels.get(task, f"prior {task} off")
            ours = scores.pop(visp_tracking.OURS)
            for peer, theirs in scores.items():
                if peer != visp_tracking.EDGES and task not in labels:
                    continue  # its other ways: of the sequence only
                yield Row(f"tracking, {what}", 1e-3 * ours.ms, peer, 1e-3 * theirs.ms, "s", command)
                name = f"attitude error, median, {what}"
                yield Row(name, ours.degrees, peer, theirs.degrees, "°", command)
            wrong = scores[visp_tracking.EDGES].wrong
            name = f"no pose or over 5° off, of {len(ours.rotation_rad)}, {what}"
            yield Row(name, ours.wrong, visp_tracking.EDGES, wrong, "", command)


def groups(short: bool = False) -> list[Callable[[Bench], Iterator[Row]]]:
    """All that this machine can run; the short form is without ViSP, which CI need not have."""
    found = [poses, nodes, reflectors, three_points, rings, stereo, fusion, segments]
    if not short and visp_driver.missing() is None:
        found.insert(1, visp)
    if compiler() is not None:
        found.insert(found.index(reflectors), flight_code)
    return found
