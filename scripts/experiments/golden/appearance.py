"""Answers of recognizer, tracker and service: sequences, hard light, joints, photographs."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.frame import MODELS_CAD
from experiments.golden.answers import RIGHT_SHARE, Answers, trained
from experiments.integrity.draw import CAMERA, CONDITIONS, sequence
from experiments.pose.frames import random_pose
from experiments.pose.photo_accuracy import PRIOR_DEG, near
from experiments.pose.sketch_confidence import frame
from experiments.service.serving import serve
from rendezview import Client, Pose, Recognizer, Target, Tracker, ViewModel, open_sequence
from rendezview.geometry.joint import within
from rendezview.sensors.appearance.integrity.monitor import IntegrityOptions
from rendezview_ground.mesh.joints import posed, with_parts
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate import SceneOptions, render_frame, sun_at_phase
from rendezview_ground.simulate.command import default_camera
from rendezview_service.client import pose_of_state

_PRIOR_RAD = np.deg2rad(2.0 * PRIOR_DEG)  # as given
_TREES = (float(np.deg2rad(20.0)), RIGHT_SHARE)  # limits: there are few nodes
_FRAMES = 9  # of a sequence
_GAP = range(4, 6)  # frames without the target
_HARD = 28  # frames in hard light of a target

Models = dict[str, tuple[Mesh, ViewModel]]


def sequences(answers: Answers, models: Models, seed: int) -> None:
    """Frames in all conditions: alone, with a prior, by the trees, tracked; with integrity."""
    meshes = [mesh for mesh, _ in models.values()]
    for t, (name, (mesh, model)) in enumerate(models.items()):
        recognizer, trees = Recognizer(model, CAMERA), Recognizer(model, CAMERA, refine=False)
        for c, (kind, condition) in enumerate(CONDITIONS.items()):
            rng = np.random.default_rng([seed, t, c])
            shown = meshes[t - 1] if condition.other else mesh
            few = replace(condition, frames=_FRAMES)
            drawn = sequence(shown, model.centre_m, model.target_radius_m, few, rng)
            tracker = Tracker(recognizer, integrity=IntegrityOptions())
            for k, (image, pose) in enumerate(drawn):
                truth = None if condition.other else pose
                _both(answers, f"recognizer/{name}/{kind}", recognizer, image, pose, truth, rng)
                found = trees.recognize(image)
                _add(answers, f"trees/{name}/{kind}", found, truth, model, limits=_TREES)
                if k in _GAP:
                    image, truth = np.zeros_like(image), None
                seen = tracker.update(float(k), image)
                _add(answers, f"tracker/{name}/{kind}", seen, truth, model)
                if (level := seen.protection) is not None:
                    levels = (level.attitude_rad, level.position_m, level.wrong, *level.axes)
                    answers.add(f"integrity/{name}", ", ".join(level.alarms), levels=levels)


def hard_light(answers: Answers, models: Models, seed: int) -> None:
    """Frames like photographs: burnt out, black, mottled, hazy; the sketch finds most of them."""
    for name, (mesh, model) in models.items():
        for k in range(_HARD):
            rng = np.random.default_rng([seed, k])
            image, camera, truth = frame(mesh, rng)
            _both(answers, f"sketch/{name}", Recognizer(model, camera), image, truth, truth, rng)


def joints(answers: Answers, folder: Path, seed: int) -> None:
    """Solar arrays that turn: first poses, then one place in a sequence."""
    source, camera = MODELS_CAD / "hubble" / "arrays.toml", default_camera()
    rng = np.random.default_rng(seed)
    mesh, model = trained(folder / "arrays.rvm", source)
    parts, known = with_parts(mesh, Target.load(source)), model.joints
    recognizer = Recognizer(model, camera)
    tracker, later = Tracker(recognizer), random_pose(mesh, camera, rng)
    for k in range(24):
        alone = k < 6
        truth = random_pose(mesh, camera, rng) if alone else later
        turned = within(known, np.array([rng.uniform(0.0, 3.0) if alone else 1.0 + 0.02 * k]))
        sun = sun_at_phase(truth.apply(model.centre_m), 0.3, 1.0)
        image = render_frame(posed(parts, known, turned), camera, truth, sun, SceneOptions(), rng)
        seen = recognizer.recognize(image) if alone else tracker.update(float(k), image)
        _add(answers, f"joints/{'alone' if alone else 'tracked'}", seen, truth, model)


def photographs(answers: Answers, folder: Path, seed: int) -> None:
    """Real photographs in SPEED+'s form, from the folder that RENDEZVIEW_TEST_DATA names."""
    data = Path(os.environ.get("RENDEZVIEW_TEST_DATA", "DATA")) / "speedplus_lightbox"
    if not data.is_dir():
        print("photographs: left out, RENDEZVIEW_TEST_DATA names no folder that has them")
        return
    _, model = trained(folder / "tango.rvm", data / "tango_fix.obj", "cm")
    sequence, rng = open_sequence(data), np.random.default_rng(seed)
    recognizer = Recognizer(model, sequence.frames[0].camera)
    for one in sequence:
        truth = one.camera_from_target
        _both(answers, "photographs", recognizer, one.read(), truth, truth, rng)


def service(answers: Answers, path: Path, mesh: Mesh, model: ViewModel, seed: int) -> None:
    """A session of a service in its own processes, with a filter, over HTTP."""
    condition, rng = replace(CONDITIONS["low Sun"], frames=60), np.random.default_rng(seed)
    drawn = list(sequence(mesh, model.centre_m, model.target_radius_m, condition, rng))
    served = serve(path, "--workers", "1", spare_worker=False)
    try:
        with Client(served.url) as client:
            session = client.open(CAMERA, prior=drawn[0][1], record=False, name="golden")
            for k, (image, truth) in enumerate(drawn):
                state = session.track(image, 0.1 * k)
                answers.pose("service", state["status"], pose_of_state(state), truth, line=state,
                             middle_m=model.centre_m, covariance=state["covariance"],
                             confidence=state["confidence"])  # fmt: skip
            session.close()
    finally:
        served.stop()


def _both(
    answers: Answers, group: str, recognizer: Recognizer, image: Any, pose: Pose,
    truth: Pose | None, rng: np.random.Generator,
) -> None:  # fmt: skip
    """Without a prior, and with one near a pose."""
    alone, prior = recognizer.recognize(image), near(pose, rng)
    _add(answers, f"{group}/no prior", alone, truth, recognizer.model)
    found = recognizer.recognize(image, prior, _PRIOR_RAD)
    _add(answers, f"{group}/prior", found, truth, recognizer.model)


def _add(
    answers: Answers, group: str, seen: Any, truth: Pose | None, model: ViewModel, **more: Any
) -> None:
    alike = tuple(model.symmetries)
    answers.seen(group, seen, truth, middle_m=model.centre_m, symmetries=alike, **more)
