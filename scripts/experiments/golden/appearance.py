"""Answers of recognizer and tracker: first poses, hard light, sequences, joints, photographs."""

from __future__ import annotations

import json
import os
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from experiments.frame import MODELS_CAD
from experiments.golden.answers import Answers
from experiments.golden.models import SMALLEST, Trained, trained
from rendezview.geometry.camera import Camera
from rendezview.geometry.joint import within
from rendezview.geometry.pose import Array, Pose
from rendezview.io.sequences import open_sequence
from rendezview.sensors.appearance import Recognizer, Tracker
from rendezview.sensors.appearance.integrity import IntegrityOptions
from rendezview.simulation.background import Earth
from rendezview.simulation.hard_light import photograph
from rendezview.simulation.scene import SceneOptions, render_frame, sun_at_phase
from rendezview.simulation.shading import ShadingOptions, render
from rendezview.simulation.sketch_frames import draw_sky
from rendezview.training.joints import posed, with_parts

CAMERA = Camera.from_fov(640, 480, np.deg2rad(53.0))
SQUARE = Camera.from_fov(480, 480, np.deg2rad(40.0))
IN_SPACE = SceneOptions(sky_frame="camera", shading=ShadingOptions(samples=2))
PRIOR_RAD = np.deg2rad(10.0)  # what the recognizer is told of the prior's error
_PUSHED = (0.06, -0.05, 0.04)  # error of the prior, rad
_TREES_RAD = np.deg2rad(20.0)  # of so few nodes
_FIRST, _EARTH = 38, 12  # frames of a target: black sky, before the Earth
_GAP = range(20, 24)  # frames of a sequence without the target


def first_poses(answers: Answers, models: dict[str, Trained], seed: int) -> None:
    """Frames of any attitude, Sun 0–70°: without a prior, with one, and by the trees alone."""
    for number, (name, one) in enumerate(models.items()):
        recognizer, trees = Recognizer(one.model, CAMERA), _trees(one)
        for k in range(_FIRST + _EARTH):
            rng = np.random.default_rng([seed, number, k])
            truth, sun = drawn(one, rng, 70.0)
            earth = Earth(seed=k) if k >= _FIRST else None
            options = SceneOptions(sky_frame="camera", shading=IN_SPACE.shading, earth=earth)
            image = render_frame(one.mesh, CAMERA, truth, sun, options, rng)
            sky = "dark" if earth is None else "Earth"
            _looks(answers, f"recognizer/{name}/{sky}", recognizer, one, image, truth)
            group = f"recognizer/{name}/{sky}/trees alone"
            found = answers.timed(group, trees.recognize, image)
            _add(answers, group, found, truth, one, limit_rad=_TREES_RAD)


def hard_light(answers: Answers, models: dict[str, Trained], seed: int) -> None:
    """Frames like photographs: burnt out, black, mottled, hazy; the sketch finds most of them."""
    for number, name in enumerate(("hubble", "client")):
        one = models[name]
        recognizer = Recognizer(one.model, SQUARE)
        for k in range(28):
            rng = np.random.default_rng([seed, number, k])
            truth, sun = drawn(one, rng, 110.0)
            plain = ShadingOptions(samples=2, ambient=0.0, earthshine=0.0)
            even = ShadingOptions(samples=2, ambient=1.0, earthshine=0.0, shadows=False)
            sunlit = render(one.mesh, SQUARE, truth, sun, plain)
            ambient = render(one.mesh, SQUARE, truth, sun, even).radiance
            sky = cv2.resize(draw_sky(rng), None, fx=2.0, fy=2.0)
            grey = photograph(sunlit.radiance, ambient, sunlit.coverage, sky, rng)
            image = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
            _looks(answers, f"sketch/{name}", recognizer, one, image, truth)


def sequences(answers: Answers, models: dict[str, Trained], seed: int) -> None:
    """Turning targets through a tracker, with a gap; of one the integrity is watched."""
    for number, (name, one) in enumerate(models.items()):
        watched = IntegrityOptions() if name == "hubble" else None
        tracker = Tracker(Recognizer(one.model, CAMERA), integrity=watched)
        for k, (image, truth) in enumerate(turning(one, 48, [seed, number])):
            group = f"tracker/{name}"
            seen = answers.timed(group, tracker.update, float(k), image)
            _add(answers, group, seen, truth if k not in _GAP else None, one)
            levels = seen.protection
            if levels is not None:
                numbers = {"attitude": levels.attitude_rad, "position": levels.position_m,
                           "axes": levels.axes, "wrong": levels.wrong}  # fmt: skip
                answers.add("integrity", ", ".join(levels.alarms) or "none", numbers)


def turning(
    one: Trained, count: int, seed: list[int], gap: range = _GAP
) -> list[tuple[npt.NDArray[np.uint8], Pose]]:
    """Frames of a target that turns by 2.5° a frame, and its poses; black ones in the gap."""
    rng = np.random.default_rng(seed)
    first, sun = drawn(one, rng, 30.0)
    middle, axis, frames = first.apply(one.model.centre_m), rng.standard_normal(3), []
    axis *= np.deg2rad(2.5) / np.linalg.norm(axis)
    for k in range(count):
        rotation = Rotation.from_rotvec(k * axis).as_matrix() @ first.rotation
        truth = Pose(rotation, middle - rotation @ one.model.centre_m)
        image = render_frame(one.mesh, CAMERA, truth, sun, IN_SPACE, rng)
        frames.append((np.zeros_like(image) if k in gap else image, truth))
    return frames


def joints(answers: Answers, folder: Path, seed: int) -> None:
    """Solar arrays that turn: first poses, then a sequence."""
    one = trained(folder, "arrays", MODELS_CAD / "hubble" / "arrays.toml", SMALLEST)
    parts = with_parts(one.mesh, one.target)
    recognizer = Recognizer(one.model, CAMERA)
    tracker, rng = Tracker(recognizer), np.random.default_rng(seed)
    known, later = one.model.joints, drawn(one, rng, 30.0)
    for k in range(24):
        truth, sun = drawn(one, rng, 30.0) if k < 6 else later
        turned = within(known, np.array([rng.uniform(0.0, 3.0) if k < 6 else 1.0 + 0.02 * k]))
        image = render_frame(posed(parts, known, turned), CAMERA, truth, sun, IN_SPACE, rng)
        group = "joints/no prior" if k < 6 else "joints/tracked"
        if k < 6:
            seen = answers.timed(group, recognizer.recognize, image)
        else:
            seen = answers.timed(group, tracker.update, float(k), image)
        _add(answers, group, seen, truth, one)


def photographs(answers: Answers, folder: Path) -> None:
    """Real photographs in SPEED+'s form, from the folder that RENDEZVIEW_TEST_DATA names."""
    data = third_party("speedplus_lightbox")
    if data is None:
        return
    one, record = trained(folder, "tango", data / "tango_fix.obj"), json.loads(
        (data / "camera.json").read_text()
    )  # fmt: skip
    k = record["cameraMatrix"]
    camera = Camera(record["Nu"], record["Nv"], k[0][0], k[1][1], k[0][2], k[1][2],
                    tuple(record["distCoeffs"]))  # fmt: skip
    recognizer = Recognizer(one.model, camera)
    for label in json.loads((data / "test.json").read_text()):
        image = cv2.imread(str(data / "images" / label["filename"]), cv2.IMREAD_GRAYSCALE)
        rotation = Rotation.from_quat(np.array(label["q_vbs2tango_true"])[[1, 2, 3, 0]])
        truth = Pose(rotation.as_matrix(), np.array(label["r_Vo2To_vbs_true"]))
        _looks(answers, "photographs", recognizer, one, image, truth)


def mitsuba_frames(answers: Answers, models: dict[str, Trained]) -> None:
    """An approach that another renderer drew, tracked from a true first pose."""
    data = third_party("approach_mitsuba")
    if data is None:
        return
    one, sequence = models["client"], open_sequence(data)
    first = sequence.frames[0]
    tracker = Tracker(Recognizer(one.model, first.camera), first.camera_from_target)
    for frame in sequence:
        image = frame.read()
        seen = answers.timed("tracker/Mitsuba", tracker.update, frame.time_s, image)
        _add(answers, "tracker/Mitsuba", seen, frame.camera_from_target, one)


def third_party(name: str) -> Path | None:
    """A folder of third-party data; a line where it is not there."""
    root = os.environ.get("RENDEZVIEW_TEST_DATA")
    if root is not None and (Path(root) / name).is_dir():
        return Path(root) / name
    print(f"{name}: left out, RENDEZVIEW_TEST_DATA does not name a folder with it")
    return None


def drawn(one: Trained, rng: np.random.Generator, phase_deg: float) -> tuple[Pose, Array]:
    """Any attitude, 3.5–7 radii away, with a Sun at most so far from the line of sight."""
    rotation = Rotation.random(random_state=rng).as_matrix()
    centre = np.array([*rng.uniform(-0.1, 0.1, 2), 1.0]) * rng.uniform(3.5, 7.0)
    centre *= one.model.target_radius_m
    phase, azimuth = np.deg2rad(rng.uniform(0.0, phase_deg)), rng.uniform(0.0, 2.0 * np.pi)
    sun = sun_at_phase(centre, phase, azimuth)
    return Pose(rotation, centre - rotation @ one.model.centre_m), sun


def _trees(one: Trained) -> Recognizer:
    return Recognizer(one.model, CAMERA, refine=False)


def _looks(
    answers: Answers, group: str, recognizer: Recognizer, one: Trained, image: Array, truth: Pose
) -> None:
    """Without a prior, and with one that is 5° off."""
    middle = one.model.centre_m
    turn = Rotation.from_rotvec(_PUSHED).as_matrix() @ truth.rotation
    prior = Pose(turn, 1.01 * truth.apply(middle) - turn @ middle)
    for name, given, error_rad in (("no prior", None, None), ("prior", prior, PRIOR_RAD)):
        whole = f"{group}/{name}"
        seen = answers.timed(whole, recognizer.recognize, image, given, error_rad)
        _add(answers, whole, seen, truth, one)


def _add(
    answers: Answers, group: str, seen: object, truth: Pose | None, one: Trained, **more: float
) -> None:
    answers.pose(group, seen, truth, middle_m=one.model.centre_m,
                 symmetries=tuple(one.model.symmetries), **more)  # fmt: skip
