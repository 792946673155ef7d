"""Answers of ring, reflectors, lights, filter and trajectory."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import rendezview as rv
from experiments.benchmark.estimation import MEAN_MOTION_RAD_S, cloud_of
from experiments.frame import CLIENT, MODELS_CAD, tests_module
from experiments.fusion.drawn_readings import Draw, faulty
from experiments.fusion.faults import fly as fly_drawn
from experiments.fusion.trials import fly, load_run, make_run
from experiments.golden.answers import Answers
from experiments.reflectors.accuracy import CAMERA, OPTIONS, random_pose
from experiments.ring.accuracy import CAMERA as RING_CAMERA
from experiments.ring.accuracy import CASES, CLUTTERED, drawn, errors_of
from experiments.stereo.accuracy import leds_of, spots_of
from experiments.trajectory.accuracy import SHAPES, segment_errors, spin_errors, true_path
from rendezview.sensors.beacons import Acquirer, MotionOptions, Spots, TrackerOptions, find_spots
from rendezview.sensors.beacons.detect.led_spots import find_spots as find_lights
from rendezview.sensors.ring.ring_pass import ring_size_of_pass
from rendezview.sensors.ring.ring_size import ring_size
from rendezview.trajectory import (
    NoFit,
    PointCloud,
    Shape,
    fit_segment,
    fit_spin,
    fit_spin_of_directions,
)
from rendezview_ground.simulate.led_laboratory import Laboratory, LaboratoryOptions
from rendezview_ground.simulate.led_pictures import PictureOptions, draw, picture_rig
from rendezview_ground.simulate.reflector_frames import foil, glints, render_pair

passes = tests_module("sensors.ring.test_ring_size")

_TIMES_S = np.linspace(0.0, 200.0, 40)
_PATH = {"radius_m": np.array(10.0), "centre_m": np.zeros(3), "times_s": _TIMES_S}  # of a target
_NOISE, _TURN = 0.03, 2e-3  # m of places, rad of attitudes; one σ


def ring(answers: Answers, seed: int) -> None:
    """Drawn scenes, each without any prior, with its range, and with place and axis."""
    for number, (case, options) in enumerate((CASES | {"clutter": CLUTTERED}).items()):
        for scene, image in drawn(options, 26, [seed, number]):
            priors: dict[str, rv.RingPrior | None] = {"no prior": None}
            if scene.ring is not None:
                there, axis = scene.ring.centre_m, scene.ring.axis
                far = float(np.linalg.norm(there))
                priors["range"] = rv.RingPrior(range_m=far, range_sigma_m=0.01 * far)
                priors["attitude"] = rv.RingPrior(there, axis, range_sigma_m=0.01 * far)
            for name, prior in priors.items():
                seen = rv.RingSensor(RING_CAMERA, options.radius_m).update(0.0, image, prior)
                circles = () if seen.is_open else seen.circles  # an open choice is no answer
                off = None if scene.ring is None else errors_of(circles, scene.ring)
                answers.add(
                    f"ring/{case}/{name}", str(seen.status), line=seen.record(),
                    errors=None if off is None else (np.deg2rad(off[1]), off[0] / 100.0),
                    right=False if circles else None,
                    circles=[np.append(c.centre_m, c.axis) for c in seen.circles],
                    covariance=[c.covariance for c in seen.circles],
                )  # fmt: skip


def sizes(answers: Answers, seed: int) -> None:
    """A ring of unknown size from a fly-around: frame by frame, and the whole pass."""
    rng, camera = np.random.default_rng(seed), passes.CAMERA
    sights = [
        passes.sight(passes.pose_at(angle), 0.05, 0.1, 0.005, rng)
        for angle in np.linspace(-1.0, 1.0, 48)
    ]
    found = [("frame", ring_size(camera, sight)) for sight in sights]
    for kind, size in [*found, ("pass", ring_size_of_pass(camera, sights))]:
        if size is None:
            answers.add(f"ring size/{kind}", "none")
            continue
        true = (passes.DISTANCE_M, passes.RADIUS_M)
        errors = tuple(abs(np.array([size.distance_m, size.radius_m]) / true - 1.0))
        answers.add(f"ring size/{kind}", "ok", errors=errors, limits=(np.inf, 0.05),
                    size=(size.radius_m, size.distance_m),
                    covariance=size.covariance)  # fmt: skip


def reflectors(answers: Answers, seed: int) -> None:
    """Single pairs with foil, glints and hidden reflectors; then tracked runs."""
    pattern = rv.patterns_of(rv.Target.load(CLIENT), ("far",))[0]
    acquirer = Acquirer(CAMERA, [pattern])
    for k in range(100):
        rng = np.random.default_rng([seed, k])
        truth, _ = random_pose(rng, pattern, float(np.exp(rng.uniform(0.0, np.log(12.0)))))
        clutter = (foil(CAMERA, rng, int(rng.integers(12, 41))), glints(CAMERA, rng, k % 7))
        hidden = ((0,), (1,), (0, 2))[k // 3 % 3] if k % 3 == 0 else ()
        pair = render_pair(CAMERA, pattern, truth, OPTIONS, rng, hidden=hidden, clutter=clutter)
        found = acquirer.acquire(find_spots(rv.LitDark(*pair)))
        pose = None if found.refined is None else found.refined.camera_from_target
        answers.pose("reflectors/alone" + "/hidden" * bool(hidden), found.status, pose, truth,
                     middle_m=pattern.centre_m, line=found.reason, score=found.score)  # fmt: skip
    for run in range(12):
        rng = np.random.default_rng([seed, 100, run])
        start, _ = random_pose(rng, pattern, 1.5 + 0.8 * run)
        sensor = rv.ReflectorSensor(CAMERA, [pattern])
        step = rng.normal(0.0, [0.01, 0.01, 0.01, 0.01, 0.01, 0.03])
        for n in range(12):
            truth, hidden = start.perturbed(n * step), (1,) if n in (7, 8) else ()
            pair = render_pair(CAMERA, pattern, truth, OPTIONS, rng, hidden=hidden)
            seen = sensor.update(0.1 * n, rv.LitDark(*pair))
            answers.seen("reflectors/tracked", seen, truth, middle_m=pattern.centre_m)


def lights(answers: Answers, seed: int) -> None:
    """The laboratory's photodiodes with faults, unnamed spots of pictures, and a turning stage."""
    target, rng = rv.Target.load(MODELS_CAD / "scole"), np.random.default_rng(seed)
    leds = leds_of(target)
    laboratory = Laboratory(leds, LaboratoryOptions(distorted=False), seed)
    rig, pictures = laboratory.rig, picture_rig(laboratory, PictureOptions())

    def add(kind: str, rig: rv.Rig, spots: list[Spots], truth: rv.Pose, tracker: rv.StereoTracker,
            time_s: float = 0.0) -> None:  # fmt: skip
        seen = tracker.update(time_s, spots)
        answers.seen(f"stereo/{kind}", seen, rig.cameras[0].camera_from_rig @ truth)

    stage = laboratory.stage(np.deg2rad(30.0) * np.sin(0.05 * np.arange(70)))
    currents = laboratory.currents(stage, rng)
    for k, (reading, truth) in enumerate(zip(currents.copy(), stage, strict=True)):
        a, b, c = rng.choice(len(leds), 3, replace=False)
        if k % 5 == 1:
            reading[:, [a, b]] = np.nan
        elif k % 5 == 2:
            reading[0, [a, b, c]] = np.nan
        elif k % 5 == 3:
            reading[0, [a, b]] = reading[0, [b, a]]
        elif k % 5 == 4:
            reading[1] = np.nan
        fresh = rv.StereoTracker.of_target(rig, target)
        add("photodiodes", rig, spots_of(rig, reading), truth, fresh)
    for k, truth in enumerate(stage):
        fresh = rv.StereoTracker.of_target(pictures, target)
        views = []
        for camera in range(len(pictures)):  # up to one light hidden and two false ones
            false = rng.uniform(-1.0, 1.0, (k % 3, 3))
            places = np.vstack([rng.permutation(truth.apply(leds))[k % 2 :], false])
            views.append(find_lights(draw(pictures, camera, places, PictureOptions(), rng)))
        add("pictures", pictures, views, truth, fresh)
    currents[40:44] = np.nan
    for name, motion in (("alone", None), ("filter", MotionOptions())):
        tracker = rv.StereoTracker.of_target(rig, target, TrackerOptions(motion=motion))
        for k, reading in enumerate(currents):
            add(f"stage/{name}", rig, spots_of(rig, reading), stage[k], tracker, 0.1 * k)


def approached(answers: Answers, model: rv.ViewModel, folder: Path, seed: int) -> None:
    """An approach to the client's ring: three sensors, and the filter without and with faults."""
    make_run(folder, seed, model)
    for name in ("appearance", "ring", "laser"):
        for line in rv.read_json_lines(folder / f"{name}.jsonl"):
            answers.add(f"approach/{name}/log", line.get("status", ""), line=line)
    for sample in fly(load_run(folder, model)).samples:
        for name, four in ({"fused": sample.fused} | sample.single).items():
            errors = (four[2], four[0] / sample.range_m) if np.isfinite(four[0]) else None
            status = "ok" if np.isfinite(four[1]) else "none"  # a ranger has the depth only
            answers.add(f"approach/{name}", status, errors=errors, four=four, nees=sample.nees)
    for fault in ("offset", "dead camera", "thrust"):
        for drawn_one in fly_drawn(Draw(faulty(fault), seed)).samples[::10]:
            place, turn, squared = drawn_one.fused
            answers.add(
                f"fused/{fault}", "ok", errors=(turn, place / drawn_one.range_m), nees=squared
            )


def segments(answers: Answers, seed: int) -> None:
    """Paths through clouds of poses and of nodes, fitted and predicted; a fifth is wild."""
    for kind, k in product(SHAPES, range(20)):
        rng, nodes = np.random.default_rng([seed, k]), k % 4 == 3
        flown, _ = true_path(kind, float(_PATH["radius_m"]), _PATH["centre_m"], k)
        sigma_m = (80.0 if nodes else 1.0) * _NOISE
        places = flown(_TIMES_S) + sigma_m * rng.standard_normal((40, 3))
        wild = rng.choice(40, 8 * (k % 2), replace=False)
        places[wild] += 100.0 * _NOISE * rng.standard_normal((len(wild), 3))
        spread = np.tile(_NOISE**2 * np.eye(3), (40, 1, 1))
        cloud = (PointCloud.of_nodes(_TIMES_S, places) if nodes
                 else PointCloud.of_places(_TIMES_S, places, spread))  # fmt: skip
        group, found = f"trajectory/{kind}" + "/nodes" * nodes, fit_segment(cloud, SHAPES[kind])
        if isinstance(found, NoFit):
            answers.add(group, found.reason)
            continue
        fitted, predicted, squared = segment_errors(found, _PATH, kind, k)
        limits = (0.15, 0.5) if nodes else (0.03, 0.1)
        answers.add(group, "ok", errors=(fitted / 100.0, predicted / 100.0), limits=limits,
                    parameters=found.parameters, covariance=found.covariance,
                    nees=squared)  # fmt: skip
    found = fit_segment(cloud_of(Shape.ORBIT)[0], Shape.ORBIT, mean_motion_rad_s=MEAN_MOTION_RAD_S)
    answers.add("trajectory/orbit", type(found).__name__, parameters=found.parameters)


def spins(answers: Answers, seed: int) -> None:
    """Constant and tumbling spin, from attitudes and from directions."""
    for kind, k in product(("spin", "tumble"), range(20)):
        rng, tumbling = np.random.default_rng([seed, k]), kind == "tumble"
        _, turn = true_path(kind, float(_PATH["radius_m"]), _PATH["centre_m"], k)
        noise = Rotation.from_rotvec(rng.normal(0.0, _TURN, (40, 3))).as_matrix()
        seen, spread = noise @ turn(_TIMES_S)[0], np.tile(_TURN**2 * np.eye(3), (40, 1, 1))
        away = -seen[:, 2] + 0.1 * rng.standard_normal((40, 3))
        fits = {
            "attitudes": fit_spin(_TIMES_S, seen, spread, tumbling=tumbling),
            "directions": fit_spin_of_directions(_TIMES_S, away, tumbling=tumbling),
        }
        for name, found in fits.items():
            if isinstance(found, NoFit):
                answers.add(f"spin/{name}", found.reason)
                continue
            rate, axis, *_ = spin_errors(found, _PATH, kind, k)
            limit = 0.1 if name == "attitudes" else 1.0
            answers.add(f"spin/{name}", "ok", errors=(np.deg2rad(axis), rate / 100.0),
                        limits=(limit, limit), line=found.moments, attitude=found.rotation,
                        rate=found.rate_rad_s, covariance=found.covariance)  # fmt: skip
