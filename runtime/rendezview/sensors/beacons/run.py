"""Runs the sensor over a sequence of pictures, and calibrates it from a run with truth."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError, explained
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array
from rendezview.io.sequences import Frame, Sequence
from rendezview.sensors.beacons.accelerations import Accelerations
from rendezview.sensors.beacons.closed_form import ClosedFormCalibration, base_and_post, calibrate
from rendezview.sensors.beacons.constellation import ReflectorPattern, SixNumbers, six_numbers
from rendezview.sensors.beacons.detect.difference import LitDark, ThresholdOptions, registered
from rendezview.sensors.beacons.detect.spots import find_spots
from rendezview.sensors.beacons.exposure import suggest_exposure
from rendezview.sensors.beacons.match.acquisition_options import AcquisitionOptions
from rendezview.sensors.beacons.observation import ReflectorObservation
from rendezview.sensors.beacons.paper_forms import PaperForms, outer_and_centre
from rendezview.sensors.beacons.track import TrackingOptions
from rendezview.sensors.beacons.tracker import ReflectorSensor
from rendezview.sensors.run import observe
from rendezview.sensors.sensor import AidedSensor

# A reading that is no farther from its truth calibrates: a false triplet is farther.
# Source: by construction, ten times the errors of a good reading at the farthest
_NEAR_RAD, _NEAR_SHARE = 0.2, 0.1
# times: dots of a picture of their own kind stand out so much more. Source: by construction, a
# dark picture's share of the light is a few per cent, a wrong kind's spots are texture
_PLAIN = 3.0


class Mode(StrEnum):
    """How pictures make readings."""

    PAIRS = "pairs"  # one sequence: lit, dark, lit, dark …
    SINGLE = "single"  # one sequence, each picture a reading: LEDs, or other bright markers
    SPLITTER = "splitter"  # two sequences of two cameras behind one lens: lit and dark at once


@dataclass(frozen=True, slots=True)
class FramePair:
    """The pictures of one reading, unread."""

    lit: Frame
    dark: Frame | None
    lit_from_dark: Array | None = None  # (2, 3) of a second camera; see `registered`
    invert: bool = False  # dark dots on a bright ground

    @property
    def name(self) -> str:
        """Of the lit picture."""
        return self.lit.name

    @property
    def time_s(self) -> float | None:
        """Of the lit picture."""
        return self.lit.time_s

    def read(self) -> LitDark:
        """Both pictures, the dark one as the lit camera sees it.

        Raises:
            RendezviewError: one cannot be read, or they do not fit each other.
        """
        dark = None if self.dark is None else self.dark.read()
        if dark is not None and self.lit_from_dark is not None:
            dark = registered(dark, self.lit_from_dark)
        frames = LitDark(self.lit.read(), dark)
        return frames.inverted() if self.invert else frames


def pair_up(
    sequences: list[Sequence], mode: Mode, lit_from_dark: Array | None = None, invert: bool = False
) -> list[FramePair]:
    """The readings of one or two sequences; ``invert``: dark dots on a bright ground.

    ``lit_from_dark`` (2, 3) maps pixels of the dark camera to those of the lit one, with a
    splitter; see `registered`.

    Raises:
        RendezviewError: not as many sequences as the mode has, or an odd number of pictures.
    """
    wanted = 2 if mode is Mode.SPLITTER else 1
    if len(sequences) != wanted:
        raise RendezviewError(
            f"mode {mode} takes {wanted} sequence(s) of pictures, {len(sequences)} given: "
            "two are lit and dark pictures (--mode splitter), one holds both in turn (--mode "
            "pairs) or single pictures (--mode single)"
        )
    first = sequences[0]
    lit: list[Frame] = list(first)
    dark: list[Frame] | list[None] = [None] * len(lit)
    if mode is Mode.SPLITTER:
        dark = list(sequences[1])
        if len(lit) != len(dark):
            raise RendezviewError(
                f"{first.source} has {len(lit)} pictures and {sequences[1].source} {len(dark)}: "
                "lit and dark must be as many"
            )
    elif mode is Mode.PAIRS:
        if len(lit) % 2:
            raise RendezviewError(
                f"{first.source}: {len(lit)} pictures cannot be lit and dark in turn: "
                "remove the one without its partner, or use --mode single"
            )
        lit, dark, lit_from_dark = lit[::2], lit[1::2], None
    return [FramePair(*both, lit_from_dark, invert) for both in zip(lit, dark, strict=True)]


def pair_up_live(frames: Iterator[Frame], mode: Mode, invert: bool = False) -> Iterator[FramePair]:
    """The readings of one camera as its pictures come.

    Raises:
        RendezviewError: the mode takes two cameras.
    """
    if mode is Mode.SPLITTER:
        raise RendezviewError("--mode splitter takes two recorded sequences, not one live camera")
    if mode is Mode.SINGLE:
        return (FramePair(frame, None, None, invert) for frame in frames)
    return (FramePair(lit, dark, None, invert) for lit, dark in zip(frames, frames, strict=False))


def wrong_mode(pairs: Iterable[FramePair], threshold: ThresholdOptions | None = None) -> str | None:
    """A hint for a run without a pose: both pictures of a pair show the dots, or they are dark.

    Only the first readable pair is looked at, and in it the third brightest spot.
    """
    for pair in pairs:
        try:
            frames = pair.read()
        except RendezviewError:
            continue
        lit = _third_peak(LitDark(frames.lit), threshold)
        inverse = _third_peak(LitDark(frames.lit).inverted(), threshold)
        if not pair.invert and inverse > _PLAIN * max(lit, 1.0):
            return f"{pair.name}: dots darker than their ground: did you mean --invert?"
        if frames.dark is None:
            return None
        if _third_peak(LitDark(frames.dark), threshold) > lit / _PLAIN > 0.0:
            return (
                f"{pair.name}: dots, but the second picture of the pair is no dark one: did you "
                "mean --mode single?"
            )
        return None
    return None


def _third_peak(frames: LitDark, threshold: ThresholdOptions | None) -> float:
    """Grey levels by which the third brightest spot stands out; 0 where there are fewer."""
    peaks = np.sort(find_spots(frames, threshold).peak_grey)
    return float(peaks[-3]) if len(peaks) >= 3 else 0.0


def follow(
    pairs: Iterable[FramePair],
    patterns: list[ReflectorPattern],
    *,
    threshold: ThresholdOptions | None = None,
    acquisition: AcquisitionOptions | None = None,
    tracking: TrackingOptions | None = None,
    accelerations: Accelerations | None = None,
    independent: bool = False,
) -> Iterator[tuple[FramePair, LitDark | None, ReflectorObservation]]:
    """One observation for each pair, in order; ``UNREADABLE`` where a picture cannot be read.

    Args:
        pairs: of `pair_up`; without times they count as one second apart.
        patterns: groups to look for.
        threshold, acquisition, tracking: options.
        accelerations: of the target, which move the windows.
        independent: each on its own, no memory.

    Yields:
        The pair, its pictures (``None`` where they cannot be read) and the observation.

    Raises:
        RendezviewError: times do not rise.
    """
    if independent:
        tracking = replace(tracking or TrackingOptions(), confirm=False)
    sensors: dict[Camera, ReflectorSensor] = {}

    def look(pair: FramePair, time_s: float, frames: LitDark) -> ReflectorObservation:
        camera = pair.lit.camera
        if camera not in sensors:
            sensors[camera] = ReflectorSensor(
                camera, patterns, threshold=threshold, acquisition=acquisition, tracking=tracking
            )
        elif independent:
            sensors[camera].forget()
        push = accelerations.at(time_s) if accelerations else None
        sensor: AidedSensor[LitDark, npt.ArrayLike, ReflectorObservation] = sensors[camera]
        return replace(sensor.update(time_s, frames, push), time_s=pair.time_s)

    return observe(pairs, look, ReflectorObservation, ordered=not independent)


def record(
    pair: FramePair,
    reading: ReflectorObservation,
    patterns: list[ReflectorPattern],
    forms: PaperForms | None = None,
    frames: LitDark | None = None,
) -> dict[str, Any]:
    """One reading as a log of JSON lines stores it.

    ``forms``: the papers' solutions, beside the pose; ``frames``: the pictures, for the
    suggestion of an exposure.
    """
    line = {"im_id": pair.lit.im_id, "image": pair.lit.name} | reading.record()
    line["time_s"] = pair.lit.time_s
    last = {key: line.pop(key) for key in ("tracked", "stage_ms")}
    beside = forms.of(pair.lit.camera, reading, patterns) if forms else {}
    return line | {"exposure_factor": suggest_exposure(reading, frames), **beside, **last}


def calibrate_run(
    pairs: list[FramePair],
    pattern: ReflectorPattern,
    *,
    threshold: ThresholdOptions | None = None,
    acquisition: AcquisitionOptions | None = None,
) -> tuple[ClosedFormCalibration, int]:
    """The closed form's calibration from a run whose pictures have their true pose.

    Each reading counts on its own, so that separate known poses are a run too. One whose pose
    is not near the truth is left out.

    Returns:
        The calibration and the number of readings in it.

    Raises:
        RendezviewError: no truth, too few readings, or a pattern without a closed form.
    """
    with explained(""):
        base_and_post(pattern)
    if all(pair.lit.camera_from_target is None for pair in pairs):
        raise RendezviewError(
            "this run has no true poses (scene_gt.json): a calibration compares with the truth"
        )
    readings: list[tuple[Array, SixNumbers]] = []
    camera = pairs[0].lit.camera
    for pair, _, reading in follow(
        pairs, [pattern], threshold=threshold, acquisition=acquisition, independent=True
    ):
        truth = pair.lit.camera_from_target
        places = outer_and_centre(pattern, reading)
        if truth is None or reading.pose is None or places is None:
            continue
        six = six_numbers(truth, pattern)
        off = reading.pose.angle_to(truth)
        # A roll that was read half a turn off names left and right the other way round.
        if off > 0.5 * math.pi:
            places, off = places[::-1], math.pi - off
        if off > _NEAR_RAD or not _near(reading, six):
            continue
        readings.append((places, six))
    return calibrate(camera, pattern, readings), len(readings)


def _near(reading: ReflectorObservation, six: SixNumbers) -> bool:
    assert reading.six is not None
    return abs(reading.six.range_m / six.range_m - 1.0) < _NEAR_SHARE
