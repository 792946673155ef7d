"""Book et al.'s closed form (appendix) and its calibration: six numbers from three centroids.

Weak perspective: the base and the post as they would look from far away. What that leaves out is
put right by a calibration, fitted by linear regression on readings whose truth is known.

It measures against the line of sight, where a post that points at the camera stands over the
base's middle. So the spots are first turned to the boresight, and the result back: the paper's
sensor looked straight at its target.

Angles here are the paper's with this project's signs: roll clockwise on the screen, yaw moves the
post's tip right and pitch moves it down (see `SixNumbers`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import ConfigDict, FiniteFloat, TypeAdapter
from pydantic.dataclasses import dataclass as checked_dataclass

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, minimal_rotation
from rendezview.io.files import StrPath, atomic_write_text, checked, read_json
from rendezview.sensors.beacons.constellation import (
    ReflectorPattern,
    SixNumbers,
    attitude,
    attitude_angles,
)

# Of a calibration: three unknowns a regression.
_LEAST_READINGS = 12  # Source: by construction, four times the unknowns
# How far constants may be from those of no calibration, one σ: slopes, offsets in rad; terms that
# fade with range: the base, and its square. A run of one attitude then leaves them nearly as they
# are. Source: by construction, the size of what weak perspective leaves out
_FREE = 0.02
# rad, of a reading: the weight of that. Source: by hand; at 2e-3 a straight approach adds errors
_READING_RAD = 5e-3


@checked_dataclass(frozen=True, slots=True, kw_only=True, config=ConfigDict(extra="forbid"))
class ClosedFormCalibration:
    """Constants of the closed form. The paper's C5 … C9, and those of yaw and pitch, for which
    it asks a calibration too without printing one; they need terms that fade with range.
    """

    c5_m: FiniteFloat = 0.0  # added to the range
    c6: FiniteFloat = 1.0  # slope of azimuth
    c7_rad: FiniteFloat = 0.0  # offset of azimuth
    c8: FiniteFloat = 1.0  # slope of elevation
    c9_rad: FiniteFloat = 0.0  # offset of elevation
    yaw_slope: FiniteFloat = 1.0
    yaw_near_m: FiniteFloat = 0.0  # × yaw / range
    yaw_near_m2: FiniteFloat = 0.0  # × yaw / range²
    yaw_offset_rad: FiniteFloat = 0.0
    pitch_slope: FiniteFloat = 1.0
    pitch_near_m: FiniteFloat = 0.0
    pitch_near_m2: FiniteFloat = 0.0
    pitch_offset_rad: FiniteFloat = 0.0

    @classmethod
    def load(cls, path: StrPath) -> ClosedFormCalibration:
        """Read a calibration file (JSON).

        Raises:
            RendezviewError: missing, not JSON, an unknown key or no number.
        """
        return checked(_ADAPTER, read_json(path, "a reflector calibration"), str(path))

    def save(self, path: StrPath) -> None:
        """Write a calibration file, atomically."""
        atomic_write_text(path, _ADAPTER.dump_json(self, indent=2).decode() + "\n")


_ADAPTER: TypeAdapter[ClosedFormCalibration] = TypeAdapter(
    Annotated[ClosedFormCalibration, "calibration"]
)


@dataclass(frozen=True, slots=True)
class _Raw:
    roll: float
    yaw: float
    pitch: float
    range_m: float


def closed_form(
    camera: Camera,
    pattern: ReflectorPattern,
    spots_px: npt.ArrayLike,
    calibration: ClosedFormCalibration | None = None,
) -> SixNumbers | None:
    """Six numbers from the centroids of left, centre and right reflector, (3, 2) px.

    Pixels become angles through the camera's calibration, in place of the paper's 1.5338e-3
    rad a pixel. The pattern must be the paper's: a post midway between the outer two.

    Returns:
        None where the spots fit no such target (no real yaw, no base).

    Raises:
        ValueError: not three finite spots, or another pattern.
    """
    constants = calibration or ClosedFormCalibration()
    length, post = base_and_post(pattern)
    view, angles = _view(camera, spots_px)
    raw = _raw(angles, length, post, constants)
    if raw is None:
        return None
    azimuth, elevation = _bearing(view, angles, raw, length)
    return SixNumbers(
        raw.range_m,
        constants.c6 * azimuth + constants.c7_rad,
        constants.c8 * elevation + constants.c9_rad,
        *attitude_angles(view @ attitude(raw.roll, raw.pitch, raw.yaw)),
    )


def calibrate(
    camera: Camera, pattern: ReflectorPattern, readings: Iterable[tuple[npt.ArrayLike, SixNumbers]]
) -> ClosedFormCalibration:
    """Fit the constants to readings: (3, 2) centroids of left, centre, right, and the truth.

    In the paper's order: yaw first, pitch by the calibrated yaw, range by both, then azimuth and
    elevation by the calibrated range; each by linear regression, towards no calibration where the
    readings hardly vary.

    Raises:
        RendezviewError: too few readings with a closed form, or all alike.
    """
    length, post = base_and_post(pattern)
    kept = []
    for spots, truth in readings:
        view, angles = _view(camera, spots)
        raw = _raw(angles, length, post, ClosedFormCalibration())
        if raw is not None:
            kept.append((view, angles, truth))
    if len(kept) < _LEAST_READINGS:
        raise RendezviewError(
            f"a calibration needs {_LEAST_READINGS} readings with all three reflectors and their "
            f"truth, this run has {len(kept)}: record more"
        )
    fitted = ClosedFormCalibration()
    for name in ("yaw", "pitch"):
        raws = [_must(_raw(angles, length, post, fitted)) for _, angles, _ in kept]
        measured = np.array([getattr(raw, name) for raw in raws])
        near = 1.0 / np.array([raw.range_m for raw in raws])
        design = np.column_stack(
            [measured, measured * near, measured * near**2, np.ones(len(raws))]
        )
        true = np.array([_seen_from(view, truth)[name] for view, _, truth in kept])
        terms = ("slope", "near_m", "near_m2", "offset_rad")
        fit = _regress(design, true, [_FREE, length, length**2, _FREE], name)
        values = dict(zip((f"{name}_{t}" for t in terms), fit, strict=True))
        fitted = ClosedFormCalibration(**asdict(fitted) | values)
    raws = [_must(_raw(angles, length, post, fitted)) for _, angles, _ in kept]
    ranges = np.array(
        [truth.range_m - raw.range_m for raw, (_, _, truth) in zip(raws, kept, strict=True)]
    )
    fitted = ClosedFormCalibration(**asdict(fitted) | {"c5_m": float(ranges.mean())})
    bearings = np.array(
        [
            _bearing(view, angles, _must(_raw(angles, length, post, fitted)), length)
            for view, angles, _ in kept
        ]
    )
    truths = np.array([(truth.azimuth_rad, truth.elevation_rad) for _, _, truth in kept])
    lines = [
        _regress(
            np.column_stack([bearings[:, k], np.ones(len(kept))]), truths[:, k], [_FREE] * 2, name
        )
        for k, name in enumerate(("azimuth", "elevation"))
    ]
    (c6, c7), (c8, c9) = lines
    return ClosedFormCalibration(
        **asdict(fitted) | {"c6": c6, "c7_rad": c7, "c8": c8, "c9_rad": c9}
    )


def base_and_post(pattern: ReflectorPattern) -> tuple[float, float]:
    """Base and post length of the paper's target, metres.

    Raises:
        ValueError: the pattern has no reflector on a post midway over its base.
    """
    centre = post_of(pattern)
    if centre is None:
        raise ValueError(
            f"reflectors {pattern.names}: the closed form needs one on a post that stands midway "
            "between the outer two"
        )
    post = pattern.target_from_face.inverse().apply(pattern.positions_m[centre])
    return pattern.base_m, float(post[2])


def post_of(pattern: ReflectorPattern) -> int | None:
    """Number of the reflector on a post midway over the base; None: there is none."""
    places = pattern.target_from_face.inverse().apply(pattern.positions_m)
    off = np.abs(places[:, :2]).sum(axis=1)
    there = np.flatnonzero((off < 1e-3 * pattern.base_m) & (places[:, 2] > 0.0))
    return int(there[0]) if len(there) else None


def _must(raw: _Raw | None) -> _Raw:
    if raw is None:
        raise RendezviewError("a calibration reading lost its closed form: leave it out of the run")
    return raw


def _regress(design: Array, values: Array, free: list[float], name: str) -> list[float]:
    """Slope, further terms and offset; ``free``: σ of each about a slope of 1 and no more."""
    if np.linalg.matrix_rank(design, tol=1e-6 * float(np.abs(design).max())) < design.shape[1]:
        raise RendezviewError(
            f"the {name} does not vary enough in this run to calibrate it: record another one"
        )
    plain = np.eye(len(free))[0]
    rows = np.vstack([design / _READING_RAD, np.diag(1.0 / np.array(free))])
    more = np.append((values - design @ plain) / _READING_RAD, np.zeros(len(free)))
    return [float(value) for value in plain + np.linalg.lstsq(rows, more, rcond=None)[0]]


def _seen_from(view: Array, truth: SixNumbers) -> dict[str, float]:
    """Yaw and pitch of a true attitude against the line of sight."""
    turn = attitude(truth.roll_rad, truth.pitch_rad, truth.yaw_rad)
    _, pitch, yaw = attitude_angles(view.T @ turn)
    return {"yaw": yaw, "pitch": pitch}


def _view(camera: Camera, spots_px: npt.ArrayLike) -> tuple[Array, Array]:
    """The turn (3, 3) of the boresight to the middle of the base, and the spots' angles (3, 2)
    right and down from there, rad."""
    spots = np.asarray(spots_px, dtype=np.float64)
    if spots.shape != (3, 2) or not np.isfinite(spots).all():
        raise ValueError(f"spots_px must be (3, 2) and finite, not {spots.tolist()}")
    rays = camera.rays(spots)
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    view = minimal_rotation([0.0, 0.0, 1.0], rays[0] + rays[2])
    x, y, z = (rays @ view).T
    return view, np.column_stack([np.arctan2(x, z), np.arctan2(y, z)])


def _raw(
    angles: Array, length: float, post: float, constants: ClosedFormCalibration
) -> _Raw | None:
    """Roll, yaw, pitch, range by the appendix, with its calibration."""
    left, centre, right = angles
    base = right - left
    width = math.hypot(*base)  # "1.5338e-3 × Max_Length"
    if width == 0.0:
        return None
    roll = math.atan2(base[1], base[0])
    c, s = math.cos(roll), math.sin(roll)
    dx, dy = centre - 0.5 * (left + right)
    x, y = c * dx + s * dy, c * dy - s * dx  # shifted, unrolled
    u, v, ratio = abs(x) / width, abs(y) / width, post / length
    # 0.25 V² cos²2ψ − 0.5 (U² + S²) cos 2ψ + (0.5 S² − 0.5 U² − 0.25 V²) = 0
    g, h = 0.25 * v * v, -0.5 * (u * u + ratio * ratio)
    i = 0.5 * ratio * ratio - 0.5 * u * u - 0.25 * v * v
    root = h * h - 4.0 * g * i
    if root < 0.0:
        return None
    # (−H − √(H² − 4GI)) / 2G without the division by G, which is 0 at no pitch
    twice = 2.0 * i / (-h + math.sqrt(root))
    if not -1.0 <= twice <= 1.0:
        return None
    yaw = math.copysign(0.5 * math.acos(twice), x)
    rough = _range(length, yaw, width)
    if rough is None:
        return None
    near = (constants.yaw_near_m + constants.yaw_near_m2 / rough) / rough
    yaw = (constants.yaw_slope + near) * yaw + constants.yaw_offset_rad
    sine = v * math.cos(yaw) / ratio
    pitch = math.copysign(math.asin(min(sine, 1.0)), y)
    far = _range(length, yaw, width)
    if far is None:
        return None
    near = (constants.pitch_near_m + constants.pitch_near_m2 / far) / far
    pitch = (constants.pitch_slope + near) * pitch + constants.pitch_offset_rad
    return _Raw(roll, yaw, pitch, far + constants.c5_m)


def _range(length: float, yaw: float, width: float) -> float | None:
    """Range² − (2A / tan w) Range − (A² + B²) = 0, its positive root."""
    a, b = 0.5 * length * math.cos(yaw), 0.5 * length * math.sin(yaw)
    if not 0.0 < width < 0.5 * math.pi:
        return None
    half = a / math.tan(width)
    return half + math.sqrt(half * half + a * a + b * b)


def _bearing(view: Array, angles: Array, raw: _Raw, length: float) -> tuple[float, float]:
    """Azimuth and elevation of the base's middle: that of its picture, shifted (Pix_Shift)."""
    left, _, right = angles
    base = math.hypot(*(right - left))
    a, b = 0.5 * length * math.cos(raw.yaw), 0.5 * length * abs(math.sin(raw.yaw))
    # The nearer end looks longer: half of the base as it is seen from its near end.
    shift = math.copysign(math.atan2(a, raw.range_m - b) - 0.5 * base, raw.yaw)
    x, y = 0.5 * (left + right) + (shift * math.cos(raw.roll), shift * math.sin(raw.roll))
    sight = view @ (math.tan(x), math.tan(y), 1.0)
    return math.atan2(sight[0], sight[2]), math.atan2(-sight[1], math.hypot(sight[0], sight[2]))
