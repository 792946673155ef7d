"""Training pictures for foreground segmentation: random spacecraft before random skies."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.zbuffer import Float32s
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate.background import Earth, earth_radiance
from rendezview_ground.simulate.random_craft import random_craft
from rendezview_ground.simulate.random_skies import random_sky
from rendezview_ground.simulate.scene import sun_at_phase
from rendezview_ground.simulate.sensor import SensorOptions, UInt8s, automatic_exposure, expose
from rendezview_ground.simulate.shading import ShadingOptions, render

WIDTH, HEIGHT = 320, 240  # px; input of the network
_RADIUS_PX = (40.0, 118.0)  # px; radius of the craft in the picture
_DARK_EXPOSURE = 300.0  # grey levels per unit of radiance, if no part of the craft is sunlit


def foreground_frame(rng: np.random.Generator) -> tuple[UInt8s, UInt8s]:
    """A grey picture (240, 320) and the coverage of each pixel by the craft, 0 … 255."""
    mesh = random_craft(rng)
    centre_m, _ = mesh.bounding_sphere
    camera, pose = _view(mesh, rng)
    sun = sun_at_phase(
        pose.apply(centre_m), np.deg2rad(rng.uniform(0.0, 95.0)), rng.uniform(0.0, 2.0 * np.pi)
    )
    below, around = np.deg2rad(rng.uniform(0.0, 75.0)), rng.uniform(0.0, 2.0 * np.pi)
    earth_camera = np.array(
        [np.sin(below) * np.cos(around), np.sin(below) * np.sin(around), np.cos(below)]
    )
    shading = ShadingOptions(
        specular=float(rng.choice([0.0, 0.15, 0.5])),
        shininess=float(rng.uniform(5.0, 60.0)),
        ambient=float(rng.uniform(0.0, 0.05)),
        earthshine=float(rng.uniform(0.0, 0.35)),
        shadow_texels_max=1024,
    )
    craft = render(mesh, camera, pose, sun, shading, earth_camera)
    exposure = automatic_exposure([(craft.radiance, craft.coverage)]) or _DARK_EXPOSURE
    exposure *= float(np.exp(rng.normal(0.0, 0.3)))
    behind = _behind(camera, earth_camera, sun, rng)
    radiance = np.asarray(craft.radiance + (1.0 - craft.coverage) * behind, dtype=np.float32)
    sensor = SensorOptions(
        blur_sigma_px=float(rng.uniform(0.25, 0.7)),
        noise_sigma_grey=float(rng.uniform(0.7, 3.5)),
        black_level_grey=float(rng.uniform(0.0, 10.0)),
    )
    cover = np.asarray(np.rint(craft.coverage * 255.0), dtype=np.uint8)
    return expose(radiance, exposure, sensor, rng), cover


def _view(mesh: Mesh, rng: np.random.Generator) -> tuple[Camera, Pose]:
    """Any attitude, anywhere in the picture, sometimes across its border."""
    centre_m, radius_m = mesh.bounding_sphere
    focal = float(rng.uniform(200.0, 600.0))
    camera = Camera(width=WIDTH, height=HEIGHT, fx=focal, fy=focal,
                    cx=(WIDTH - 1) / 2, cy=(HEIGHT - 1) / 2)  # fmt: skip
    radius_px = rng.uniform(*_RADIUS_PX)
    room = np.array([WIDTH, HEIGHT]) / 2.0 - radius_px * rng.uniform(0.6, 1.05)
    shift = rng.uniform(-1.0, 1.0, 2) * np.maximum(room, 0.0) / focal
    place = np.array([*shift, 1.0]) * focal * radius_m / radius_px
    rotation = Rotation.random(random_state=rng).as_matrix()
    return camera, Pose(rotation, place - rotation @ centre_m)


def _behind(camera: Camera, earth_camera: Array, sun: Array, rng: np.random.Generator) -> Float32s:
    """The Earth or a random sky; sometimes dimmed, brightened, blurred or uniform."""
    if rng.random() < 0.55:
        earth = Earth(
            seed=int(rng.integers(2**31)), angular_radius_rad=float(rng.uniform(0.7, 1.3))
        )
        sky = earth_radiance(camera, earth_camera, sun, earth)[0]
    else:
        sky = random_sky(camera.height, camera.width, rng)
    if rng.random() < 0.3:
        sky = sky * rng.uniform(0.3, 2.0) + rng.uniform(0.0, 0.2) * (rng.random() < 0.5)
    if rng.random() < 0.2:
        sky = np.asarray(cv2.GaussianBlur(sky, (0, 0), rng.uniform(0.5, 3.0)), dtype=np.float32)
    if rng.random() < 0.1:
        sky = np.full_like(sky, rng.uniform(0.0, 0.8))
    return np.asarray(sky, dtype=np.float32)
