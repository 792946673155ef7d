"""Camera frames with truth: a single frame, or a scene on disk."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt
from joblib import Parallel, delayed

from rendezview.errors import RendezviewError, explained
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.zbuffer import Float32s
from rendezview_ground.limits import check
from rendezview_ground.mesh.insulation import MOST_INSULATION, insulated
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate.background import (
    GROUND_RATE_RAD_S,
    Earth,
    Stars,
    earth_radiance,
    ground_rotation,
    star_radiance,
)
from rendezview_ground.simulate.bop_writer import BopSceneWriter
from rendezview_ground.simulate.dust import add_dust
from rendezview_ground.simulate.joint_motion import JointMotion
from rendezview_ground.simulate.mesh_error import MOST_MESH_ERROR, deformed
from rendezview_ground.simulate.mitsuba_renderer import MitsubaOptions, render_mitsuba
from rendezview_ground.simulate.sensor import SensorOptions, UInt8s, automatic_exposure, expose
from rendezview_ground.simulate.shading import ShadingOptions, render, unit
from rendezview_ground.simulate.trajectories import TimedPose, Triple

Progress = Callable[[int, int], None]
Light = Callable[[int, Pose], Float32s]  # number and pose of a frame → grey levels (H, W)
Picture = tuple[Float32s, Float32s]  # radiance, premultiplied by coverage, and coverage

_METERED_FRAMES = 5  # frames rendered for the automatic exposure of a scene
_MASK_COVERAGE = 0.5  # least coverage of a pixel in the mask
_MOST_DUST = 10_000  # specks a frame
# Random numbers of the deformed mesh and of the blanket, beside those of the frames.
_MESH_STREAM, _BLANKET_STREAM, PARTS_STREAM = 1, 2, 3  # of the seed


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneOptions:
    """Light, sky and detector of a scene.

    Stars, Earth and a fixed Sun do not move in the *sky frame*. It is the target frame for a target
    with a constant attitude, or the camera frame for a tumbling target and a fixed camera.
    """

    sky_frame: Literal["target", "camera"] = "target"
    sun_phase_rad: float = math.radians(45.0)  # angle Sun–target–camera, held in every frame
    sun_azimuth_rad: float | None = None  # in the picture, from right to down; None: seeded
    sun_azimuth_each_frame: bool = (
        False  # a new random azimuth for every frame (independent frames)
    )
    sun_direction_sky: Triple | None = None  # a fixed Sun instead, towards it, in the sky frame
    earth: Earth | None = None
    # Towards the Earth's centre, in the sky frame. None: behind the target as seen from the
    # target's +X axis, where trajectories begin, or along the camera's boresight.
    earth_direction_sky: Triple | None = None
    stars: Stars | None = None
    shading: ShadingOptions = field(default_factory=ShadingOptions)
    mitsuba: MitsubaOptions | None = None  # render with Mitsuba instead of our own renderer
    sensor: SensorOptions = field(default_factory=SensorOptions)
    sky_level_grey: float = 0.0  # glow of the sky: grey levels behind the target, not before it
    dust: int = 0  # specks before the camera, new in each frame
    mesh_error: float = 0.0  # RMS displacement of the surface, share of the target's radius
    insulation: float = 0.0  # mean thickness of a blanket over half of it, share of the radius
    masks: bool = False  # write mask_visib/ too

    def __post_init__(self) -> None:
        if self.sky_frame not in ("target", "camera"):
            raise RendezviewError(f"sky_frame must be target or camera, not {self.sky_frame!r}")
        check(self, 0.0, math.pi, "sun_phase_rad")
        check(self, -math.inf, math.inf, "sun_azimuth_rad")
        check(self, 0.0, 254.0, "sky_level_grey")
        check(self, 0, _MOST_DUST, "dust")
        check(self, 0.0, MOST_MESH_ERROR, "mesh_error")
        check(self, 0.0, MOST_INSULATION, "insulation")
        for name in ("sun_direction_sky", "earth_direction_sky"):
            value = getattr(self, name)
            if value is not None:
                with explained(""):
                    unit(value, name)

    def camera_from_sky(self, camera_from_target: Pose) -> Array:
        """(3, 3) rotation from the sky frame to the camera's."""
        return camera_from_target.rotation if self.sky_frame == "target" else np.eye(3)

    def earth_direction(self) -> Array:
        """(3,) unit direction to the Earth in the sky frame."""
        default = (-1.0, 0.0, 0.0) if self.sky_frame == "target" else (0.0, 0.0, 1.0)
        return unit(self.earth_direction_sky or default, "earth_direction_sky")


def sun_at_phase(centre_camera_m: npt.ArrayLike, phase_rad: float, azimuth_rad: float) -> Array:
    """(3,) direction to the Sun in the camera frame, at an angle Sun–target–camera.

    Args:
        centre_camera_m: (3,) the target in the camera frame.
        phase_rad: 0: the Sun is behind the camera; π: behind the target.
        azimuth_rad: direction of the Sun in the picture: 0 right, π/2 down.
    """
    ahead = unit(centre_camera_m, "centre_camera_m")
    right = np.array([1.0, 0.0, 0.0]) - ahead[0] * ahead
    right = right / np.linalg.norm(right) if abs(ahead[0]) < 0.999 else np.array([0.0, 1.0, 0.0])
    right = unit(right - (right @ ahead) * ahead, "right")
    down = np.cross(ahead, right)
    across = math.cos(azimuth_rad) * right + math.sin(azimuth_rad) * down
    return -math.cos(phase_rad) * ahead + math.sin(phase_rad) * across


def render_frame(
    mesh: Mesh,
    camera: Camera,
    camera_from_target: Pose,
    sun_direction_camera: npt.ArrayLike,
    options: SceneOptions,
    rng: np.random.Generator,
    time_s: float = 0.0,
    light: Float32s | None = None,
) -> UInt8s:
    """One 8-bit picture (H, W). An automatic exposure uses this frame only.

    The mesh is drawn as it is: ``mesh_error`` and ``insulation`` belong to scenes. ``light`` (H, W)
    is added behind the optics, grey levels.
    """
    sun = unit(sun_direction_camera, "sun")
    return _frame(mesh, camera, camera_from_target, sun, options, rng, time_s, light)[0]


def simulate(
    mesh: Mesh,
    camera: Camera,
    poses: Sequence[TimedPose],
    options: SceneOptions,
    folder: Path,
    seed: int,
    *,
    joints: JointMotion | None = None,
    jobs: int = 1,
    progress: Progress | None = None,
    overwrite: bool = False,
    light: Light | None = None,
    again: bool = False,
) -> None:
    """Render every pose and write a BOP scene; frame i of ``poses`` is image i.

    With ``joints`` the parts of the mesh move, and ``scene_joints.json`` has their angles. The
    bytes depend on ``seed`` and not on ``jobs``: each frame has a child seed. Automatic exposure
    is set once for the scene, from a few of its frames.

    Args:
        light: added to each picture, such as that of reflectors.
        again: the same scene in a second picture at the same time: only the noise differs.

    Raises:
        RendezviewError: there are no poses, times do not increase, or the folder cannot be
            written.
    """
    if not poses:
        raise RendezviewError("there is nothing to simulate: the trajectory has no frames")
    times_s = [time_s for time_s, _ in poses]
    if any(later <= earlier for earlier, later in pairwise(times_s)):
        raise RendezviewError("the times of a trajectory must rise from frame to frame")
    if jobs == 0:
        raise RendezviewError("jobs must be a number of threads, or −1 for all cores, not 0")
    if options.mesh_error > 0.0:  # after the trajectory, which is planned with the CAD model
        mesh = deformed(mesh, options.mesh_error, np.random.default_rng([seed, _MESH_STREAM]))
    if options.insulation > 0.0:
        if joints is not None:
            raise RendezviewError(
                "insulation and joints: a blanket has no joints, give one of them"
            )
        mesh = insulated(mesh, options.insulation, np.random.default_rng([seed, _BLANKET_STREAM]))
    meshes = [mesh] * len(poses)
    if joints is not None:
        meshes = [joints.posed(mesh, time_s) for time_s in times_s]
    scene_seed, *frame_seeds = np.random.SeedSequence(seed).spawn(len(poses) + 1)
    scene_azimuth = float(np.random.default_rng(scene_seed).uniform(0.0, 2.0 * math.pi))
    suns = []
    rngs = [np.random.default_rng(child) for child in frame_seeds]
    for (_, pose), rng in zip(poses, rngs, strict=True):
        azimuth = options.sun_azimuth_rad
        if azimuth is None:
            azimuth = scene_azimuth
            if options.sun_azimuth_each_frame:
                azimuth = float(rng.uniform(0.0, 2.0 * math.pi))
        suns.append(_sun(mesh, pose, options, azimuth))
    if again:
        rngs = [rng.spawn(1)[0] for rng in rngs]
    if options.sensor.exposure is None:
        chosen = np.unique(np.linspace(0, len(poses) - 1, _METERED_FRAMES).round().astype(int))
        # One sample per pixel without shadows is enough to measure the sunlit faces.
        plain = replace(options.shading, samples=1, shadows=False)
        drawn = [render(meshes[i], camera, poses[i][1], suns[i], plain) for i in chosen]
        pictures = [(picture.radiance, picture.coverage) for picture in drawn]
        options = replace(
            options, sensor=replace(options.sensor, exposure=_exposure(mesh, pictures, options))
        )
    with BopSceneWriter(folder, camera, overwrite=overwrite) as writer:
        frames = Parallel(n_jobs=jobs, prefer="threads", return_as="generator")(
            delayed(_frame)(
                own, camera, pose, sun, options, rng, time_s, light and light(number, pose)
            )
            for number, (own, (time_s, pose), sun, rng) in enumerate(
                zip(meshes, poses, suns, rngs, strict=True)
            )
        )
        try:
            for i, (image, coverage) in enumerate(frames):
                time_s, pose = poses[i]
                mask = None
                if options.masks:
                    mask = np.where(coverage >= _MASK_COVERAGE, 255, 0).astype(np.uint8)
                writer.add(i, image, pose, time_s, mask=mask)
                if progress is not None:
                    progress(i + 1, len(poses))
        finally:  # cancels the frames that wait, when one cannot be written
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # joblib warns about the cancellation
                frames.close()
    if joints is not None:
        joints.write(folder, times_s)


def _sun(mesh: Mesh, pose: Pose, options: SceneOptions, azimuth_rad: float) -> Array:
    if options.sun_direction_sky is not None:
        return options.camera_from_sky(pose) @ unit(options.sun_direction_sky, "sun_direction_sky")
    centre_m, _ = mesh.bounding_sphere
    return sun_at_phase(pose.apply(centre_m), options.sun_phase_rad, azimuth_rad)


def _exposure(mesh: Mesh, pictures: list[Picture], options: SceneOptions) -> float:
    metered = automatic_exposure(pictures, options.sensor.black_level_grey)
    if metered is not None:
        return metered
    # No part of the target is sunlit and visible: expose for its mean albedo in full sunlight.
    albedo = float(np.mean(mesh.face_albedo)) if len(mesh.faces) else 0.0
    return (200.0 - options.sensor.black_level_grey) / max(albedo, 0.05)


def _frame(
    mesh: Mesh,
    camera: Camera,
    camera_from_target: Pose,
    sun: Array,
    options: SceneOptions,
    rng: np.random.Generator,
    time_s: float,
    light: Float32s | None = None,
) -> tuple[UInt8s, Float32s]:
    camera_from_sky = options.camera_from_sky(camera_from_target)
    earth_camera = None
    if options.earth is not None:
        earth_camera = camera_from_sky @ options.earth_direction()
    radiance, coverage = _target(mesh, camera, camera_from_target, sun, earth_camera, options, rng)
    exposure = options.sensor.exposure
    if exposure is None:
        exposure = _exposure(mesh, [(radiance, coverage)], options)
    radiance_per_grey = 1.0 / (exposure * options.sensor.overexposure)
    if options.stars is not None or options.earth is not None:
        behind = np.zeros_like(radiance)
        if options.stars is not None:
            behind += star_radiance(camera, camera_from_sky, options.stars)
        if options.earth is not None and earth_camera is not None:
            below = ground_rotation(options.earth_direction(), GROUND_RATE_RAD_S * time_s)
            ground, clear = earth_radiance(
                camera, earth_camera, sun, options.earth, below @ camera_from_sky.T
            )
            behind = behind * clear + ground
        radiance = radiance + (1.0 - coverage) * behind
    if options.sky_level_grey > 0.0:
        radiance = radiance + (1.0 - coverage) * (options.sky_level_grey * radiance_per_grey)
    if options.dust:
        specks = np.zeros_like(radiance)
        add_dust(specks, options.dust, rng)
        radiance = radiance + specks * np.float32(radiance_per_grey)
    return expose(radiance, exposure, options.sensor, rng, light), coverage


def _target(
    mesh: Mesh,
    camera: Camera,
    camera_from_target: Pose,
    sun: Array,
    earth: Array | None,
    options: SceneOptions,
    rng: np.random.Generator,
) -> Picture:
    """The target without background, by the chosen renderer."""
    if options.mitsuba is None:
        drawn = render(mesh, camera, camera_from_target, sun, options.shading, earth)
        return drawn.radiance, drawn.coverage
    radius = options.earth.angular_radius_rad if options.earth is not None else 0.0
    seed = int(rng.integers(2**31))
    return render_mitsuba(
        mesh, camera, camera_from_target, sun, options.mitsuba, earth, radius, seed
    )
