"""Rig files: our JSON with everything, and OpenCV's stereo YAML where the models agree."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, TypeAdapter

from rendezview.errors import RendezviewError, explained
from rendezview.geometry.pose import Pose, nearest_rotation
from rendezview.io.calibration_yaml import parse_yaml
from rendezview.io.camera_files import camera_from_keys, counted, opencv_matrix
from rendezview.io.files import StrPath, atomic_write_text, checked, parse_json, read_text
from rendezview.io.plausible import CHECKED
from rendezview.sensors.beacons.detect.brown_lens import Lens
from rendezview.sensors.beacons.detect.detectors import Photodiode
from rendezview.sensors.beacons.detect.photodiode import TERMS, Normalisation, Response
from rendezview.sensors.beacons.rig import Rig, RigCamera

FORMAT = "rendezview rig 1"
_LIMIT_BYTES = 20_000_000  # Source: by construction, a bound of memory

_Two = Annotated[list[FiniteFloat], Field(min_length=2, max_length=2)]
_Three = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
_Four = Annotated[list[FiniteFloat], Field(min_length=4, max_length=4)]
_Curve = Annotated[list[FiniteFloat], Field(min_length=TERMS[3], max_length=TERMS[5])]
_Size = Annotated[int, Field(gt=0)]
_Positive = Annotated[FiniteFloat, Field(gt=0.0)]
_NotNegative = Annotated[FiniteFloat, Field(ge=0.0)]


class Table(BaseModel):
    """A part of a file, without unknown keys."""

    model_config = ConfigDict(extra="forbid")


class PoseTable(Table):
    """A pose in a file."""

    quat_wxyz: _Four
    translation_m: _Three

    def pose(self) -> Pose:
        """The same as a `Pose`.

        Raises:
            ValueError: the quaternion is zero.
        """
        return Pose.from_quat_wxyz(self.quat_wxyz, self.translation_m)


class _LensTable(Table):
    radial: _Three
    tangential: _Three
    centre: _Two
    corrects: bool


class _PhotodiodeTable(Table):
    response: Annotated[list[_Curve], Field(min_length=2, max_length=2)]
    normalisation: Literal["pair", "total"]
    noise: _Positive
    half_width_m: _Positive


class _CameraTable(Table):
    name: Annotated[str, Field(min_length=1)]
    fx: _Positive
    fy: _Positive
    cx: FiniteFloat
    cy: FiniteFloat
    lens: _LensTable
    size: Annotated[list[_Size], Field(min_length=2, max_length=2)] | None
    photodiode: _PhotodiodeTable | None
    camera_from_rig: PoseTable
    floor: _NotNegative
    sigma: dict[str, _NotNegative] = {}
    rms: _NotNegative | None = None
    misfit: _NotNegative | None = None


class _RigFile(Table):
    format: Literal["rendezview rig 1"]
    cameras: Annotated[list[_CameraTable], Field(min_length=1)]
    covariance_names: list[str] = []
    covariance: list[list[FiniteFloat]] | None = None


_RIG_FILE = TypeAdapter(_RigFile)


def save_rig(rig: Rig, path: StrPath) -> None:
    """Write a rig file (JSON), atomically, numbers in full precision."""
    cameras = []
    for camera in rig.cameras:
        diode = camera.photodiode
        cameras.append(
            {
                **{key: getattr(camera, key) for key in ("name", "fx", "fy", "cx", "cy")},
                "lens": asdict(camera.lens),
                "size": camera.size,
                "photodiode": diode
                and {
                    "response": diode.response.coefficients.tolist(),
                    "normalisation": str(diode.response.normalisation),
                    "noise": diode.noise,
                    "half_width_m": diode.half_width_m,
                },
                "camera_from_rig": camera.camera_from_rig.as_dict(),
                **{key: getattr(camera, key) for key in ("floor", "sigma", "rms", "misfit")},
            }
        )
    content = {
        "format": FORMAT,
        "cameras": cameras,
        "covariance_names": rig.covariance_names,
        "covariance": None if rig.covariance is None else rig.covariance.tolist(),
    }
    atomic_write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def load_rig(path: StrPath) -> Rig:
    """Read a rig: our JSON, or OpenCV's stereo YAML (M1 D1 M2 D2 R T and the image size).

    Raises:
        RendezviewError: missing, neither of these, or impossible numbers (named).
    """
    text = read_text(path, "a rig file", limit_bytes=_LIMIT_BYTES)
    with explained(f"{path}: ", ": correct the rig file"):
        if not text.lstrip().startswith("{"):
            return _from_opencv(text, path)
        file = checked(_RIG_FILE, parse_json(text, str(path)), str(path))
        covariance = None
        if file.covariance is not None:
            covariance = np.array(file.covariance, dtype=np.float64)
            if covariance.shape != (len(file.covariance_names),) * 2:
                raise ValueError("covariance does not fit covariance_names")
        cameras = tuple(_camera(table) for table in file.cameras)
        return Rig(cameras, covariance, tuple(file.covariance_names))


def _camera(table: _CameraTable) -> RigCamera:
    diode = table.photodiode
    return RigCamera(
        table.name, table.fx, table.fy, table.cx, table.cy, table.camera_from_rig.pose(),
        Lens(**table.lens.model_dump()),
        None if table.size is None else (table.size[0], table.size[1]),
        None
        if diode is None
        else Photodiode(
            Response(np.array(diode.response), Normalisation(diode.normalisation)),
            diode.noise, diode.half_width_m,
        ),
        table.floor, dict(table.sigma), table.rms, table.misfit,
    )  # fmt: skip


def _from_opencv(text: str, path: StrPath) -> Rig:
    data = parse_yaml(text)
    needed = ("M1", "D1", "M2", "D2", "R", "T", "image_width", "image_height")
    missing = [key for key in needed if not isinstance(data, dict) or key not in data]
    if missing:
        raise RendezviewError(
            f"{path}: no rig: {', '.join(missing)} missing: give a rig file of `rendezview stereo "
            "calibrate`, or OpenCV's M1 D1 M2 D2 R T with image_width and image_height in one file"
        )
    size = {key: data[key] for key in ("image_width", "image_height")}
    right = Pose(
        nearest_rotation(np.reshape(counted(data, "R", 9), (3, 3))),
        np.array(counted(data, "T", 3)),
    )
    cameras = []
    for number, name, pose in ((1, "left", Pose.identity()), (2, "right", right)):
        keys = {"M1": data[f"M{number}"], "D1": data[f"D{number}"], CHECKED: True, **size}
        camera = camera_from_keys(keys, f"{path}: M{number}, D{number}")
        cameras.append(RigCamera.from_camera(name, camera, pose))
    return Rig(tuple(cameras))


def save_opencv(rig: Rig, path: StrPath) -> None:
    """Write two picture cameras as OpenCV's M1 D1 M2 D2 R T (YAML); T in metres.

    Raises:
        RendezviewError: not two picture cameras, or a lens that OpenCV's model cannot be.
    """
    if len(rig) != 2:
        raise RendezviewError(f"OpenCV's stereo file is of two cameras, this rig has {len(rig)}")
    both = [camera.to_camera() for camera in rig.cameras]
    if (both[0].width, both[0].height) != (both[1].width, both[1].height):
        raise RendezviewError("OpenCV's stereo file is of two pictures of one size")
    first, second = (camera.camera_from_rig for camera in rig.cameras)
    relative = second @ first.inverse()
    matrices = {
        "M1": both[0].matrix,
        "D1": np.atleast_2d(both[0].distortion or (0.0,) * 5),
        "M2": both[1].matrix,
        "D2": np.atleast_2d(both[1].distortion or (0.0,) * 5),
        "R": relative.rotation,
        "T": relative.translation_m[:, None],
    }
    lines = [f"%YAML:1.0\n---\nimage_width: {both[0].width}\nimage_height: {both[0].height}\n"]
    lines += [f"{key}: {opencv_matrix(matrix)}" for key, matrix in matrices.items()]
    atomic_write_text(path, "".join(lines))
