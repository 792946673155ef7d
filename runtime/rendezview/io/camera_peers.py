"""Camera files of other programs, in the keys of `camera_files`.

A new kind is a function that returns our keys, or None if the file is another one, and its line in
`PEERS` (files of keys) or `TEXTS` (other text). What a kind has and we cannot use is refused by its
name.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from typing import Any

from rendezview.io.lenses import (
    Bend,
    as_fisheye,
    division,
    double_sphere,
    extended_unified,
    field_of_view,
    omnidirectional,
    thin_prism_fisheye,
)

Keys = dict[Any, Any]

# COLMAP's models: their parameters after the focal lengths and the principal point. Source: COLMAP,
# src/colmap/sensor/models.h. One focal length: f; the fisheyes are polynomials in the angle.
_COLMAP = {
    "SIMPLE_PINHOLE": ("f", ""),
    "PINHOLE": ("fx fy", ""),
    "SIMPLE_RADIAL": ("f", "k1"),
    "RADIAL": ("f", "k1 k2"),
    "OPENCV": ("fx fy", "k1 k2 p1 p2"),
    "FULL_OPENCV": ("fx fy", "k1 k2 p1 p2 k3 k4 k5 k6"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "k1"),
    "RADIAL_FISHEYE": ("f", "k1 k2"),
    "OPENCV_FISHEYE": ("fx fy", "k1 k2 k3 k4"),
    "SIMPLE_FISHEYE": ("f", ""),
    "FISHEYE": ("fx fy", ""),
    "FOV": ("fx fy", "omega"),
    "SIMPLE_DIVISION": ("f", "k"),
    "DIVISION": ("fx fy", "k"),
    "EUCM": ("fx fy", "alpha beta"),
    "THIN_PRISM_FISHEYE": ("fx fy", "k1 k2 p1 p2 k3 k4 sx1 sy1"),
}
# Those that are no lens of ours.
_COLMAP_BENT: dict[str, Callable[..., Bend]] = {
    "FOV": field_of_view,
    "SIMPLE_DIVISION": division,
    "DIVISION": division,
    "EUCM": extended_unified,
    "THIN_PRISM_FISHEYE": lambda *terms: thin_prism_fisheye(terms),
}
_POLYNOMIAL = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_ANGLES = ("k1", "k2", "k3", "k4")  # of a fisheye
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_MATRIX_TEXT = re.compile(rf"\s*(?:{_NUMBER}[\s,;]+){{8}}{_NUMBER}\s*")
_COLMAP_LINE = re.compile(r"\d+\s+([A-Z0-9_]+)\s+(\d+)\s+(\d+)((?:\s+\S+)*)\s*")
_OURS = ("roi", "binning", "binning_x", "binning_y", "bit_depth")  # in all kinds
_HALF = 0.5  # px: COLMAP counts from the picture's corner. Source: COLMAP, "Camera models"


def _nerf(data: Keys) -> Keys | None:
    """``transforms.json`` of nerfstudio and instant-ngp, whose pixels are COLMAP's."""
    if "frames" not in data or not {"fl_x", "camera_angle_x"} & set(data):
        first = data["frames"][0] if isinstance(data.get("frames"), list) and data["frames"] else {}
        if isinstance(first, dict) and "fl_x" in first:
            raise ValueError("each frame has a camera of its own: give one camera for all")
        return None
    width, height = number(data, "w"), number(data, "h")
    if "fl_x" in data:
        fx = number(data, "fl_x")
    else:
        fx = 0.5 * width / math.tan(0.5 * number(data, "camera_angle_x"))
    model = str(data.get("camera_model", "OPENCV"))
    fisheye = bool(data.get("is_fisheye")) or "FISHEYE" in model
    if model in _COLMAP_BENT or (not fisheye and model not in _COLMAP):
        raise ValueError(f"camera_model: {model!r} is not read: undistort the images first")
    cx, cy = data.get("cx", 0.5 * width) - _HALF, data.get("cy", 0.5 * height) - _HALF
    terms = {name: data[name] for name in _POLYNOMIAL if name in data}
    return _keys([width, height, fx, data.get("fl_y", fx), cx, cy], terms, fisheye)


def _realsense(data: Keys) -> Keys | None:
    """``rs2_intrinsics``: ``ppx``, ``ppy`` are the principal point there, in pixels."""
    if not {"ppx", "ppy", "fx", "fy", "width", "height"} <= set(data) or "Nu" in data:
        return None
    terms = [float(term) for term in data.get("coeffs") or ()]
    model = str(data.get("model", "")).lower().replace("_", " ").removeprefix("distortion.")
    if any(terms) and model not in ("brown conrady", "kannala brandt4"):
        raise ValueError(
            f"model: {data.get('model')!r} is not read: use the rectified stream, or calibrate "
            "with OpenCV"
        )
    found = _keys(_numbers(data, "width height fx fy ppx ppy"))
    if any(terms):
        found["distortion_coefficients"] = terms[:4] if "kannala" in model else terms
        found["distortion_model"] = "equidistant" if "kannala" in model else "plumb_bob"
    return found


def _visp(data: Keys) -> Keys | None:
    """ViSP's ``vpXmlParserCamera``: ``px py u0 v0``, and ``kud`` for x' = x (1 + kud r²)."""
    cameras = data.get("camera")
    if isinstance(cameras, list):
        raise ValueError("several cameras: keep the one that took the images")
    if not isinstance(cameras, dict) or "model" not in cameras:
        return None
    models = cameras["model"] if isinstance(cameras["model"], list) else [cameras["model"]]
    distorted = [model for model in models if model.get("type", "").endswith("WithDistortion")]
    chosen = (distorted or models)[0]
    if str(chosen.get("type")).removeprefix("perspectiveProj") not in (
        "WithDistortion", "WithoutDistortion",
    ):  # fmt: skip
        raise ValueError(f"model: {chosen.get('type')!r} is not read: calibrate a perspective one")
    six = _numbers(cameras, "image_width image_height") + _numbers(chosen, "px py u0 v0")
    return _keys(six, {"k1": chosen.get("kud", 0.0)})


def _m3t(data: Keys) -> Keys | None:
    """M3T and ICG: ``intrinsics`` is a mapping."""
    inner = data.get("intrinsics")
    if not isinstance(inner, dict) or "f_u" not in inner:
        return None
    return _keys(_numbers(inner, "width height f_u f_v pp_x pp_y"))


def _megapose(data: Keys) -> Keys | None:
    """MegaPose's ``camera_data.json``: ``resolution`` is height and width."""
    if "K" not in data or "resolution" not in data or "intrinsics" in data:
        return None
    height, width = data["resolution"]
    return {**{k: v for k, v in data.items() if k != "resolution"}, "width": width,
            "height": height}  # fmt: skip


def _open3d(data: Keys) -> Keys | None:
    """Open3D's ``PinholeCameraIntrinsic``: nine numbers column by column."""
    values = data.get("intrinsic_matrix")
    if not isinstance(values, list) or len(values) != 9 or values[6:8] == [0, 0]:
        return None
    return {**data, "intrinsic_matrix": [values[k + 3 * j] for k in range(3) for j in range(3)]}


def _orb_slam(data: Keys) -> Keys | None:
    """ORB-SLAM and stella: ``Camera.fx`` or ``Camera1.fx``, one key a number."""
    if "Camera1.fx" in data and "Camera2.fx" in data:
        raise ValueError("several cameras (Camera1, Camera2): keep the one that took the images")
    prefix = next((p for p in ("Camera1.", "Camera.") if f"{p}fx" in data), None)
    if prefix is None:
        return None
    model = str(data.get("Camera.type", data.get("Camera.model", "PinHole"))).lower()
    if model not in ("pinhole", "perspective", "kannalabrandt8", "fisheye", "rectified"):
        raise ValueError(f"Camera.type: {model!r} is not read: calibrate PinHole or KannalaBrandt8")
    size = [
        data.get(f"Camera.{ours}", data.get(f"Camera.{stellas}"))
        for ours, stellas in (("width", "cols"), ("height", "rows"))
    ]
    four = _numbers(data, " ".join(prefix + key for key in ("fx", "fy", "cx", "cy")))
    terms = {k: data[prefix + k] for k in _POLYNOMIAL if prefix + k in data}
    return _keys([*size, *four], terms, model in ("kannalabrandt8", "fisheye"))


def _camodocal(data: Keys) -> Keys | None:
    """VINS and camodocal: ``model_type``, ``projection_parameters``, ``distortion_parameters``."""
    if "model_type" not in data or not isinstance(data.get("projection_parameters"), dict):
        return None
    inner, model = data["projection_parameters"], data["model_type"]
    size = _numbers(data, "image_width image_height")
    if model == "PINHOLE":
        terms = data.get("distortion_parameters") or {}
        return _keys(size + _numbers(inner, "fx fy cx cy"), terms)
    if model == "KANNALA_BRANDT":
        angles = dict(zip(_ANGLES, _numbers(inner, "k2 k3 k4 k5"), strict=True))
        return _keys(size + _numbers(inner, "mu mv u0 v0"), angles, True)
    if model == "MEI":
        terms = tuple(_numbers(data.get("distortion_parameters") or {}, "k1 k2 p1 p2"))
        (xi,) = _numbers(data["mirror_parameters"], "xi")
        return _bent(
            model, omnidirectional(xi, terms), size + _numbers(inner, "gamma1 gamma2 u0 v0")
        )
    raise ValueError(f"model_type: {model!r} is not read: calibrate PINHOLE or KANNALA_BRANDT")


def _kalibr(data: Keys) -> Keys | None:
    """Kalibr's and EuRoC's lenses beside the pinhole with OpenCV's."""
    model, lens = data.get("camera_model", "pinhole"), data.get("distortion_model", "none")
    if "intrinsics" not in data or (model == "pinhole" and lens != "fov"):
        return None
    counts = {"ds": 2, "eucm": 2, "omni": 1, "pinhole": 0}
    if model not in counts or (model == "omni" and lens not in ("none", "radtan")):
        raise ValueError(
            f"camera_model: {model!r} with distortion_model: {lens!r} is not read: calibrate with "
            "pinhole, and equidistant for a fisheye"
        )
    values = [float(value) for value in data["intrinsics"]]
    own, four = values[: counts[model]], values[counts[model] :]
    if len(four) != 4:
        raise ValueError(f"intrinsics: has {len(values)} numbers, {model} has {counts[model] + 4}")
    terms = tuple(float(term) for term in data.get("distortion_coeffs") or ())
    bend = {
        "ds": lambda: double_sphere(*own),
        "eucm": lambda: extended_unified(*own),
        "omni": lambda: omnidirectional(own[0], terms),
        "pinhole": lambda: field_of_view(*terms),
    }[model]()
    return _bent(model if model != "pinhole" else "fov", bend, [*data["resolution"], *four])


def _basalt(data: Keys) -> Keys | None:
    """Basalt's ``calib.json`` of one camera."""
    value = data.get("value0")
    if not isinstance(value, dict) or "intrinsics" not in value:
        return None
    if len(value["intrinsics"]) != 1:
        raise ValueError(
            f"{len(value['intrinsics'])} cameras in value0: keep the one that took the images, in "
            "intrinsics and resolution"
        )
    inner, kind = value["intrinsics"][0]["intrinsics"], value["intrinsics"][0]["camera_type"]
    six = [*value["resolution"][0], *_numbers(inner, "fx fy cx cy")]
    if kind == "pinhole":
        return _keys(six)
    if kind == "kb4":
        return _keys(six, {name: inner[name] for name in _ANGLES}, True)
    if kind == "ds":
        return _bent(kind, double_sphere(*_numbers(inner, "xi alpha")), six)
    if kind == "eucm":
        return _bent(kind, extended_unified(*_numbers(inner, "alpha beta")), six)
    raise ValueError(f"camera_type: {kind!r} is not read: calibrate kb4, ds or pinhole")


def _colmap(text: str) -> Keys | None:
    """``cameras.txt`` of COLMAP: CAMERA_ID MODEL WIDTH HEIGHT PARAMS."""
    lines = [line for line in text.splitlines() if line.strip() and line.lstrip()[0] != "#"]
    found = [_COLMAP_LINE.fullmatch(line.strip()) for line in lines]
    if not found or not all(found):
        return None
    if len(found) > 1:
        raise ValueError(f"{len(found)} cameras: keep the line of the one that took the images")
    assert found[0] is not None
    model, width, height = found[0].group(1, 2, 3)
    if model not in _COLMAP:
        raise ValueError(f"{model} is not read: use one of {', '.join(_COLMAP)}")
    focal, terms = (names.split() for names in _COLMAP[model])
    numbers = [float(word) for word in found[0].group(4).split()]
    if len(numbers) != len(focal) + 2 + len(terms):
        raise ValueError(f"{model}: has {len(numbers)} parameters")
    fx, fy = numbers[0], numbers[len(focal) - 1]
    cx, cy = (number - _HALF for number in numbers[len(focal) : len(focal) + 2])
    six = [int(width), int(height), fx, fy, cx, cy]
    bends = dict(zip(terms, numbers[len(focal) + 2 :], strict=True))
    if model in _COLMAP_BENT:
        return _bent(model, _COLMAP_BENT[model](*bends.values()), six)
    return _keys(six, bends, "FISHEYE" in model)


def _bare_matrix(text: str) -> Keys | None:
    """``cam_K.txt`` of FoundationPose and others: nine numbers."""
    lines = [line for line in text.splitlines() if line.lstrip()[:1] != "#"]
    joined = "\n".join(lines)
    if not _MATRIX_TEXT.fullmatch(joined):
        return None
    return {"K": [float(word) for word in re.split(r"[\s,;]+", joined.strip())]}


def _ros_ini(text: str) -> Keys | None:
    """The INI file of ROS's camera_calibration: names, and numbers in the lines below them."""
    if not re.search(r"^\s*\[image\]\s*$", text, re.MULTILINE):
        return None
    values: dict[str, list[float]] = {}
    name, cameras = "", 0
    for line in text.splitlines():
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        if words[0].startswith("["):
            cameras += words != ["[image]"] and words[0] != "[externals]"
        elif all(re.fullmatch(_NUMBER, word) for word in words):
            values.setdefault(name, []).extend(map(float, words))
        else:
            name = " ".join(words)
    if cameras != 1:
        raise ValueError(f"{cameras} cameras: keep the one that took the images")
    return {
        "width": values.get("width", [None])[0],
        "height": values.get("height", [None])[0],
        "camera_matrix": values.get("camera matrix", []),
        "distortion_coefficients": values.get("distortion", []),
    }


PEERS: tuple[Callable[[Keys], Keys | None], ...] = (
    _nerf, _realsense, _visp, _m3t, _megapose, _open3d, _orb_slam, _camodocal, _kalibr, _basalt,
)  # fmt: skip
TEXTS: tuple[Callable[[str], Keys | None], ...] = (_colmap, _bare_matrix, _ros_ini)


def translated(data: Keys) -> Keys:
    """Our keys of another program's file; other files as they are.

    Raises:
        ValueError: a kind, a lens or a number that is not read, by its name.
    """
    for read in PEERS:
        try:
            found = read(data)
        except (TypeError, AttributeError, KeyError, IndexError) as error:
            name = read.__name__.strip("_")
            raise ValueError(f"a value is not that of a file of {name}: {error}") from error
        if found is not None:
            return {**found, **{key: data[key] for key in _OURS if key in data}}
    return data


def keys_of_text(text: str) -> Keys | None:
    """Our keys of a text that is neither YAML, JSON nor XML; None for other texts.

    Raises:
        ValueError: a kind, a lens or a number that is not read, by its name.
    """
    return next((found for read in TEXTS if (found := read(text)) is not None), None)


def number(data: Keys, key: str) -> float:
    """The number of a key.

    Raises:
        ValueError: it is not there, or none.
    """
    value = data.get(key)
    if value is None:
        raise ValueError(f"{key}: missing: add it")
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{key}: must be a number, not {value!r}")
    try:
        return float(value)
    except OverflowError:
        raise ValueError(f"{key}: the number is too large") from None


def _numbers(data: Keys, keys: str) -> list[float]:
    return [number(data, key) for key in keys.split()]


def _bent(name: str, bend: Bend, six: list[Any]) -> Keys:
    """Our keys of a lens of `lenses`, as the fisheye that is nearest to it."""
    return _keys(*as_fisheye(name, bend, [float(value) for value in six]), fisheye=True)


def _keys(six: list[Any], terms: Mapping[str, Any] | None = None, fisheye: bool = False) -> Keys:
    """Our keys of width, height, fx, fy, cx, cy; a size of None is reported as any file's."""
    named = dict(zip(("width", "height", "fx", "fy", "cx", "cy"), six, strict=True))
    values = [(terms or {}).get(name, 0.0) for name in (_ANGLES if fisheye else _POLYNOMIAL)]
    while len(values) > 5 and not any(values[5:]):
        values.pop()
    return {
        **{key: value for key, value in named.items() if value is not None},
        "distortion_coefficients": values,
        "distortion_model": "equidistant" if fisheye else "plumb_bob",
    }
