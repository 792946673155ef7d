"""Answers of recognizer and tracker: first poses, hard light, sequences, joints, photographs."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from experiments.frame import MODELS_CAD
from experiments.golden.answers import RIGHT_SHARE, Answers
from experiments.golden.models import Trained, trained
from rendezview.geometry.camera import Camera
from rendezview.geometry.joint import within
from rendezview.geometry.pose import Array, Pose
from rendezview.io.sequences import open_sequence
from rendezview.sensors.appearance import Recognizer, Tracker
from rendezview.sensors.appearance.integrity.monitor import IntegrityOptions
from rendezview_ground.mesh.joints import posed, with_parts
from rendezview_ground.simulate.background import Earth
from rendezview_ground.simulate.hard_light import photograph
from rendezview_ground.simulate.scene import SceneOptions, render_frame, sun_at_phase
from rendezview_ground.simulate.shading import ShadingOptions, render
from rendezview_ground.simulate.sketch_frames import draw_sky

CAMERA = Camera.from_fov(640, 480, np.deg2rad(53.0))
IN_SPACE = SceneOptions(sky_frame="camera", shading=ShadingOptions(samples=2))
_SQUARE = Camera.from_fov(480, 480, np.deg2rad(40.0))
_PUSHED_RAD, _PRIOR_RAD = (0.06, -0.05, 0.04), np.deg2rad(10.0)  # error of the prior; as given
_TREES = (float(np.deg2rad(20.0)), RIGHT_SHARE)  # limits: there are few nodes
_DARK, _EARTH = 38, 12  # frames of a target
_GAP = range(20, 24)  # frames of a sequence without the target


def first_poses(answers: Answers, models: dict[str, Trained], seed: int) -> None:
    """Frames of any attitude, Sun 0–70°: without a prior, with one, and by the trees alone."""
    for number, (name, one) in enumerate(models.items()):
        recognizer, trees = (
            Recognizer(one.model, CAMERA),
            Recognizer(one.model, CAMERA, refine=False),
        )
        for k in range(_DARK + _EARTH):
            rng = np.random.default_rng([seed, number, k])
            truth, sun = _drawn(one, rng, 70.0)
            earth = Earth(seed=k) if k >= _DARK else None
            options = SceneOptions(sky_frame="camera", shading=IN_SPACE.shading, earth=earth)
            image = render_frame(one.mesh, CAMERA, truth, sun, options, rng)
            group = f"recognizer/{name}/{'dark' if earth is None else 'Earth'}"
            _both(answers, group, recognizer, one, image, truth)
            found = answers.timed(f"{group}/trees alone", trees.recognize, image)
            _add(answers, f"{group}/trees alone", found, truth, one, limits=_TREES)


def hard_light(answers: Answers, models: dict[str, Trained], seed: int) -> None:
    """Frames like photographs: burnt out, black, mottled, hazy; the sketch finds most of them."""
    plain = ShadingOptions(samples=2, ambient=0.0, earthshine=0.0)
    even = ShadingOptions(samples=2, ambient=1.0, earthshine=0.0, shadows=False)
    for number, name in enumerate(("hubble", "client")):
        one = models[name]
        recognizer = Recognizer(one.model, _SQUARE)
        for k in range(28):
            rng = np.random.default_rng([seed, number, k])
            truth, sun = _drawn(one, rng, 110.0)
            sunlit = render(one.mesh, _SQUARE, truth, sun, plain)
            ambient = render(one.mesh, _SQUARE, truth, sun, even).radiance
            sky = cv2.resize(draw_sky(rng), None, fx=2.0, fy=2.0)
            grey = photograph(sunlit.radiance, ambient, sunlit.coverage, sky, rng)
            image = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
            _both(answers, f"sketch/{name}", recognizer, one, image, truth)


def sequences(answers: Answers, models: dict[str, Trained], seed: int) -> None:
    """Turning targets through a tracker, with a gap; of one the integrity is watched."""
    for number, (name, one) in enumerate(models.items()):
        watched = IntegrityOptions() if name == "hubble" else None
        tracker = Tracker(Recognizer(one.model, CAMERA), integrity=watched)
        for k, (image, truth) in enumerate(turning(one, 48, [seed, number])):
            seen = answers.timed(f"tracker/{name}", tracker.update, float(k), image)
            _add(answers, f"tracker/{name}", seen, truth if k not in _GAP else None, one)
            if (level := seen.protection) is not None:
                levels = (level.attitude_rad, level.position_m, level.wrong, *level.axes)
                answers.add("integrity", ", ".join(level.alarms), levels=levels)


def turning(one: Trained, count: int, seed: list[int]) -> list[tuple[npt.NDArray[np.uint8], Pose]]:
    """Frames of a target that turns by 2.5° a frame, and its poses; black ones in the gap."""
    rng = np.random.default_rng(seed)
    first, sun = _drawn(one, rng, 30.0)
    middle, axis, frames = first.apply(one.model.centre_m), rng.standard_normal(3), []
    axis *= np.deg2rad(2.5) / np.linalg.norm(axis)
    for k in range(count):
        rotation = Rotation.from_rotvec(k * axis).as_matrix() @ first.rotation
        truth = Pose(rotation, middle - rotation @ one.model.centre_m)
        image = render_frame(one.mesh, CAMERA, truth, sun, IN_SPACE, rng)
        frames.append((np.zeros_like(image) if k in _GAP else image, truth))
    return frames


def joints(answers: Answers, folder: Path, seed: int) -> None:
    """Solar arrays that turn: first poses, then a sequence."""
    one = trained(folder, "arrays", MODELS_CAD / "hubble" / "arrays.toml")
    parts, known = with_parts(one.mesh, one.target), one.model.joints
    recognizer, rng = Recognizer(one.model, CAMERA), np.random.default_rng(seed)
    tracker, later = Tracker(recognizer), _drawn(one, rng, 30.0)
    for k in range(24):
        truth, sun = _drawn(one, rng, 30.0) if k < 6 else later
        turned = within(known, np.array([rng.uniform(0.0, 3.0) if k < 6 else 1.0 + 0.02 * k]))
        image = render_frame(posed(parts, known, turned), CAMERA, truth, sun, IN_SPACE, rng)
        if k < 6:
            seen = answers.timed("joints/no prior", recognizer.recognize, image)
        else:
            seen = answers.timed("joints/tracked", tracker.update, float(k), image)
        _add(answers, f"joints/{'no prior' if k < 6 else 'tracked'}", seen, truth, one)


def photographs(answers: Answers, folder: Path) -> None:
    """Real photographs in SPEED+'s form, from the folder that RENDEZVIEW_TEST_DATA names."""
    data = _third_party("speedplus_lightbox")
    if data is None:
        return
    one = trained(folder, "tango", data / "tango_fix.obj", "cm")
    record = json.loads((data / "camera.json").read_text())
    (fx, _, cx), (_, fy, cy), _ = record["cameraMatrix"]
    lens = tuple(record["distCoeffs"])
    recognizer = Recognizer(one.model, Camera(record["Nu"], record["Nv"], fx, fy, cx, cy, lens))
    for label in json.loads((data / "test.json").read_text()):
        image = cv2.imread(str(data / "images" / label["filename"]), cv2.IMREAD_GRAYSCALE)
        rotation = Rotation.from_quat(np.array(label["q_vbs2tango_true"])[[1, 2, 3, 0]])
        truth = Pose(rotation.as_matrix(), np.array(label["r_Vo2To_vbs_true"]))
        _both(answers, "photographs", recognizer, one, image, truth)


def mitsuba_frames(answers: Answers, one: Trained) -> None:
    """An approach that another renderer drew, tracked from a true first pose."""
    data = _third_party("approach_mitsuba")
    if data is None:
        return
    sequence = open_sequence(data)
    first = sequence.frames[0]
    tracker = Tracker(Recognizer(one.model, first.camera), first.camera_from_target)
    for frame in sequence:
        seen = answers.timed("tracker/Mitsuba", tracker.update, frame.time_s, frame.read())
        _add(answers, "tracker/Mitsuba", seen, frame.camera_from_target, one)


def _third_party(name: str) -> Path | None:
    """A folder of third-party data; a line where it is not there."""
    folder = Path(os.environ.get("RENDEZVIEW_TEST_DATA", "DATA")) / name
    if folder.is_dir():
        return folder
    print(f"{name}: left out, RENDEZVIEW_TEST_DATA names no folder that has it")
    return None


def _drawn(one: Trained, rng: np.random.Generator, phase_deg: float) -> tuple[Pose, Array]:
    """Any attitude, 3.5–7 radii away, with a Sun at most so far from the line of sight."""
    rotation = Rotation.random(random_state=rng).as_matrix()
    centre = np.array([*rng.uniform(-0.1, 0.1, 2), 1.0]) * rng.uniform(3.5, 7.0)
    centre *= one.model.target_radius_m
    phase, azimuth = np.deg2rad(rng.uniform(0.0, phase_deg)), rng.uniform(0.0, 2.0 * np.pi)
    return Pose(rotation, centre - rotation @ one.model.centre_m), sun_at_phase(
        centre, phase, azimuth
    )


def _both(
    answers: Answers, group: str, recognizer: Recognizer, one: Trained, image: Any, truth: Pose
) -> None:
    """Without a prior, and with one that is 5° and 1 % of the range off."""
    middle = one.model.centre_m
    turn = Rotation.from_rotvec(_PUSHED_RAD).as_matrix() @ truth.rotation
    prior = Pose(turn, 1.01 * truth.apply(middle) - turn @ middle)
    for name, given, error_rad in (("no prior", None, None), ("prior", prior, _PRIOR_RAD)):
        whole = f"{group}/{name}"
        seen = answers.timed(whole, recognizer.recognize, image, given, error_rad)
        _add(answers, whole, seen, truth, one)


def _add(
    answers: Answers, group: str, seen: Any, truth: Pose | None, one: Trained, **more: Any
) -> None:
    alike = tuple(one.model.symmetries)
    answers.seen(group, seen, truth, middle_m=one.model.centre_m, symmetries=alike, **more)
