"""Pictures by Mitsuba 3, an independent, physically based renderer.

It shares only the mesh with our own renderer, so results on its frames do not depend on our
renderer. It has hard shadows from a Sun at infinity, diffuse paint blended with rough foil, and
earthshine from half the sky. The unit of radiance is a white Lambert surface that faces the Sun.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError, optional
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.zbuffer import Float32s
from rendezview_ground.limits import check
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate.distortion import widened

_SKY_ROWS = 64  # rows of the environment map


@dataclass(frozen=True, slots=True, kw_only=True)
class MitsubaOptions:
    """Options of the Mitsuba renderer."""

    samples: int = 48  # per pixel; about one second per 640 × 480 frame on one core
    foil: float = 0.2  # share of rough, glinting aluminium in every surface
    foil_roughness: float = 0.25  # Beckmann alpha of the wrinkled foil
    ambient: float = 0.01  # light from all directions: stars, scattered light
    earthshine: float = 0.3  # radiance of the day side of the Earth (its mean albedo)

    def __post_init__(self) -> None:
        check(self, 1, 4096, "samples")
        check(self, 0.0, 1.0, "foil", "foil_roughness", "ambient", "earthshine")


def render_mitsuba(
    mesh: Mesh,
    camera: Camera,
    camera_from_target: Pose,
    sun_direction_camera: Array,
    options: MitsubaOptions,
    earth_direction_camera: Array | None = None,
    earth_radius_rad: float = 1.22,
    seed: int = 0,
) -> tuple[Float32s, Float32s]:
    """Radiance (H, W), premultiplied by coverage, and coverage (H, W) of the target on black.

    Args:
        sun_direction_camera: (3,) unit, towards the Sun.
        earth_direction_camera: (3,) unit, towards the Earth's centre; None: no Earth.
        earth_radius_rad: angular radius of the Earth.
        seed: of the samples.

    Raises:
        RendezviewError: Mitsuba is not installed, the camera's pixels are not square, or the
            target reaches behind the camera.
    """
    bent = widened(camera)
    pinhole = camera if bent is None else bent.pinhole
    vertices = camera_from_target.apply(mesh.vertices_m)
    picture = _render(
        _mitsuba(), mesh, vertices, pinhole, sun_direction_camera, options,
        earth_direction_camera, earth_radius_rad, seed,
    )  # fmt: skip
    if bent is None:
        return picture
    return bent.bend(picture[0], cv2.INTER_LINEAR), bent.bend(picture[1], cv2.INTER_LINEAR)


def _mitsuba() -> Any:
    with optional("frames of the independent renderer need", "mitsuba"):
        import mitsuba
    mitsuba.set_variant("scalar_rgb")
    return mitsuba


def _render(
    mi: Any,
    mesh: Mesh,
    vertices: Array,
    camera: Camera,
    sun: Array,
    options: MitsubaOptions,
    earth: Array | None,
    earth_radius_rad: float,
    seed: int,
) -> tuple[Float32s, Float32s]:
    if abs(camera.fx / camera.fy - 1.0) > 1e-9:
        raise RendezviewError("Mitsuba draws square pixels only: give a camera with fx = fy")
    radiance = np.zeros((camera.height, camera.width), np.float32)
    coverage = np.zeros_like(radiance)
    z = vertices[:, 2]
    if z.min() <= 1e-3:
        raise RendezviewError("Mitsuba cannot draw a target that reaches behind the camera")
    u = camera.fx * vertices[:, 0] / z + camera.cx
    v = camera.fy * vertices[:, 1] / z + camera.cy
    left, right = (int(x) for x in np.clip([u.min() - 1, u.max() + 2], 0, camera.width))
    top, bottom = (int(y) for y in np.clip([v.min() - 1, v.max() + 2], 0, camera.height))
    if right <= left or bottom <= top:
        return radiance, coverage
    film = {
        "type": "hdrfilm",
        "width": camera.width,
        "height": camera.height,
        "crop_offset_x": left,
        "crop_offset_y": top,
        "crop_width": right - left,
        "crop_height": bottom - top,
        "pixel_format": "luminance_alpha",
        "rfilter": {"type": "box"},
    }
    scene = mi.load_dict(
        {
            "type": "scene",
            # more than one emitter sample gives too bright pictures in Mitsuba 3.7.1
            "integrator": {
                "type": "direct",
                "emitter_samples": 1,
                "bsdf_samples": 0,
                "hide_emitters": True,
            },
            "sensor": {
                "type": "perspective",
                "near_clip": 0.5 * float(z.min()),
                "far_clip": 2.0 * float(z.max()),
                "fov_axis": "x",
                "fov": math.degrees(2.0 * math.atan(0.5 * camera.width / camera.fx)),
                # Pixel centres are integers here, the film's corner is (-0.5, -0.5).
                "principal_point_offset_x": 0.5 - (camera.cx + 0.5) / camera.width,
                "principal_point_offset_y": 0.5 - (camera.cy + 0.5) / camera.height,
                # Mitsuba's camera has x to the left and y up.
                "to_world": mi.ScalarTransform4f().rotate([0, 0, 1], 180.0),
                "film": film,
                "sampler": {"type": "independent", "sample_count": options.samples, "seed": seed},
            },
            "sun": {
                "type": "directional",
                "direction": [-float(x) for x in sun],
                "irradiance": {"type": "rgb", "value": math.pi},
            },
            "sky": _sky(mi, sun, options, earth, earth_radius_rad),
            "target": _shape(mi, mesh, vertices, options),
        }
    )
    drawn = np.asarray(mi.render(scene, seed=seed), dtype=np.float32)
    radiance[top:bottom, left:right] = drawn[..., 0]
    coverage[top:bottom, left:right] = drawn[..., 1]
    return radiance, np.clip(coverage, 0.0, 1.0)


def _shape(mi: Any, mesh: Mesh, vertices: Array, options: MitsubaOptions) -> Any:
    """The mesh with a constant albedo per face, as a blend of paint and foil."""
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(
        {
            "type": "twosided",
            "bsdf": {
                "type": "blendbsdf",
                "weight": options.foil,
                "paint": {
                    "type": "diffuse",
                    "reflectance": {"type": "mesh_attribute", "name": "face_albedo"},
                },
                "foil": {
                    "type": "roughconductor",
                    "material": "Al",
                    "alpha": max(options.foil_roughness, 0.01),
                },
            },
        }
    )
    shape = mi.Mesh(
        "target",
        vertex_count=len(vertices),
        face_count=len(mesh.faces),
        has_vertex_normals=False,
        has_vertex_texcoords=False,
        props=properties,
    )
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = np.ascontiguousarray(vertices, dtype=np.float32).ravel()
    parameters["faces"] = np.ascontiguousarray(mesh.faces, dtype=np.uint32).ravel()
    parameters.update()
    albedo = np.ascontiguousarray(np.clip(mesh.face_rgb, 0.0, 0.95), dtype=np.float32)
    shape.add_attribute("face_albedo", 3, albedo.ravel())
    return shape


def _sky(
    mi: Any, sun: Array, options: MitsubaOptions, earth: Array | None, earth_radius_rad: float
) -> Any:
    """Ambient light, and light from the day side of the Earth."""
    if earth is None:
        return {"type": "constant", "radiance": {"type": "rgb", "value": options.ambient}}
    # Latitude-longitude map of Mitsuba: y is up, u = 0 towards +z and rising towards -x.
    rows, columns = _SKY_ROWS, 2 * _SKY_ROWS
    theta = (np.arange(rows)[:, None] + 0.5) / rows * math.pi
    phi = (np.arange(columns)[None, :] + 0.5) / columns * 2.0 * math.pi
    direction = np.stack(
        np.broadcast_arrays(
            np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)
        ),
        axis=-1,
    )
    light: npt.NDArray[np.float32] = np.full((rows, columns, 3), options.ambient, np.float32)
    day = max(0.0, -float(sun @ earth))
    light[direction @ earth >= math.cos(earth_radius_rad)] += options.earthshine * day
    return {"type": "envmap", "bitmap": mi.Bitmap(light)}
