"""``rendezview reflectors`` and ``rendezview calibrate reflectors``."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from rendezview.cli.budget import BudgetReport
from rendezview.cli.compiling import compile_ahead
from rendezview.cli.inputs import CameraFile, numbers_of, say_once
from rendezview.cli.progress import ProgressBar, say, say_summary
from rendezview.errors import RendezviewError
from rendezview.io.bundled import find_target
from rendezview.io.camera_files import load_camera
from rendezview.io.files import check_place, make_folder
from rendezview.io.sequences import open_sequence
from rendezview.io.sequences.images import write_png
from rendezview.io.sequences.live import is_live, live_frames, with_rate
from rendezview.sensors.beacons.accelerations import Accelerations
from rendezview.sensors.beacons.camera_set import follow_cameras, load_cameras
from rendezview.sensors.beacons.closed_form import ClosedFormCalibration
from rendezview.sensors.beacons.constellation import ReflectorPattern, left_out_of, patterns_of
from rendezview.sensors.beacons.detect.difference import (
    Centroid,
    LitDark,
    Opening,
    ThresholdOptions,
)
from rendezview.sensors.beacons.match.acquisition_options import AcquisitionOptions
from rendezview.sensors.beacons.observation import ReflectorObservation
from rendezview.sensors.beacons.overlay import draw_reading
from rendezview.sensors.beacons.paper_forms import PaperForms
from rendezview.sensors.beacons.run import (
    FramePair,
    Mode,
    calibrate_run,
    follow,
    pair_up,
    pair_up_live,
    record,
    wrong_mode,
)
from rendezview.sensors.beacons.track import TrackingOptions
from rendezview.sensors.beacons.triangulation import Iteration
from rendezview.sensors.observation import Status
from rendezview.sensors.run import Line, run

_CALIBRATE = "calibrate"  # as a first word: `rendezview calibrate reflectors`; until version 0.4
# Readings without a pose, from the start. Source: by construction, two make a first find
_READINGS_TO_HINT = 8


class Glass(StrEnum):
    """Hourglasses."""

    TARGET = "target"  # of the target's own triangles, every tilt to 65°
    PAPER = "paper"  # the lines of Book et al., figure 2


def reflectors(
    frames: Annotated[
        list[str],
        typer.Argument(
            help="A target file, if there is no --target; then pictures: one folder, scene or "
            "video with lit and dark ones in turn, or one of each, or a camera (0, /dev/video0, "
            "rtsp://...)."
        ),
    ],
    target: Annotated[
        str | None, typer.Option(help="Target file with reflectors, its folder, or client.")
    ] = None,
    camera: CameraFile = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="JSON lines of readings.")
    ] = None,
    cameras: Annotated[
        Path | None,
        typer.Option(help="Several cameras with their pictures and ranges, TOML; no pictures."),
    ] = None,
    group: Annotated[
        list[str] | None, typer.Option(help="Groups that there are; repeat for several. All.")
    ] = None,
    mode: Annotated[
        Mode | None,
        typer.Option(help="Default: pairs; a camera or --invert: single; two folders: splitter."),
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option(help="Give the closed form too, with this calibration.")
    ] = None,
    triangulation: Annotated[
        Iteration | None, typer.Option(help="Give Bales' iteration too, with its rates.")
    ] = None,
    accelerations: Annotated[
        Path | None,
        typer.Option(help="The target's acceleration as the control system knows it, JSON lines."),
    ] = None,
    centroid: Annotated[Centroid, typer.Option(help="A spot's place.")] = Centroid.WINDOWED,
    hourglass: Annotated[
        Glass, typer.Option(help="Where the centre spot may be: the target's own, or as printed.")
    ] = Glass.TARGET,
    threshold: Annotated[
        float | None, typer.Option(min=0.0, max=255.0, help="Grey; from the noise if not given.")
    ] = None,
    upper: Annotated[
        float | None, typer.Option(min=0.0, max=255.0, help="Grey: brighter pixels are glints.")
    ] = None,
    opening: Annotated[Opening, typer.Option(help="Erosion and dilation.")] = Opening.SMALL,
    blur: Annotated[
        float, typer.Option(min=0.2, max=20.0, help="Blur of the optics, pixels (one σ).")
    ] = 0.75,
    lit_from_dark: Annotated[
        str | None, typer.Option(help="Splitter: 'a,b,c,d,e,f', rows of the map between cameras.")
    ] = None,
    registered: Annotated[  # until version 0.4
        bool, typer.Option("--register", hidden=True, help="No effect: the pictures tell.")
    ] = False,
    readout_ms: Annotated[
        float, typer.Option(min=0.0, max=500.0, help="First to last row of a rolling shutter.")
    ] = 0.0,
    independent: Annotated[
        bool, typer.Option("--independent", help="Each reading on its own, no memory.")
    ] = False,
    invert: Annotated[bool, typer.Option("--invert", help="Black dots on a white ground.")] = False,
    rate: Annotated[
        float | None, typer.Option(help="Pictures a second, where they have no times.")
    ] = None,
    readings: Annotated[
        int | None, typer.Option(min=1, help="Stop after so many; a camera goes on until Ctrl-C.")
    ] = None,
    overlay: Annotated[Path | None, typer.Option(help="Folder for pictures of readings.")] = None,
    budget: Annotated[
        bool, typer.Option("--budget", help="Print the errors of the poses by cause, at the end.")
    ] = False,
) -> None:
    """Read a video guidance sensor: reflectors to six numbers.

    \b
    Example: rendezview reflectors lit dark --camera camera.yaml --target client -o readings.jsonl
             rendezview reflectors card/target.toml 0 --camera webcam.yaml --invert --overlay seen
             rendezview reflectors client --cameras cameras.toml -o readings.jsonl
    """
    calibrating = frames[0] == _CALIBRATE
    places = frames[1:] if calibrating else frames
    if target is None and places:
        target, *places = places
    if target is None or not (places or cameras):
        raise RendezviewError(
            "calibrate reflectors: name the run: the pictures with their truth"
            if calibrating
            else "reflectors: name a target file (or --target) and the pictures"
        )
    check_place(output, "the readings")
    known = find_target(target)
    patterns = patterns_of(known, tuple(group) if group else None)
    forms = PaperForms(
        ClosedFormCalibration.load(calibration) if calibration else None, triangulation
    )
    options = ThresholdOptions(
        lower_grey=threshold, upper_grey=upper, opening=opening, centroid=centroid
    )
    acquisition = AcquisitionOptions(
        left_out=left_out_of(known, patterns),
        blur_px=blur,
        paper_hourglass=hourglass is Glass.PAPER,
    )
    pushes = Accelerations.load(accelerations) if accelerations else None
    if overlay:
        make_folder(overlay)
    if cameras:
        if places or calibrating or independent:
            raise RendezviewError(
                "--cameras names the pictures itself, and follows: leave out pictures, calibrate "
                "and --independent"
            )
        runs = load_cameras(cameras, mode, invert=invert)
        total: int | None = len(runs[0].pairs) if readings is None else readings
        of_set = follow_cameras(
            runs, patterns, threshold=options, acquisition=acquisition, accelerations=pushes
        )
        steps = (
            (s.pair, s.frames, s.observation,
             {"camera": s.camera, "chaser_from_target": s.chaser_from_target})
            for s in of_set
        )  # fmt: skip
        chosen = itertools.islice(steps, total)
        _run(chosen, patterns, forms, overlay, output, total, options, BudgetReport(budget))
        return
    pairs, total = pairs_of(places, camera, mode, lit_from_dark, invert, rate, readings)
    if calibrating:
        if output is None:
            raise RendezviewError("calibrate reflectors: give -o, the file for the calibration")
        used = list(itertools.islice(pairs, total))
        fitted, count = calibrate_run(used, patterns[0], threshold=options, acquisition=acquisition)
        fitted.save(output)
        say(f"{output}: closed form of {patterns[0].name!r} from {count} of {len(used)} readings")
        return
    read = follow(
        itertools.islice(pairs, total), patterns, threshold=options, acquisition=acquisition,
        accelerations=pushes, independent=independent,
        tracking=TrackingOptions(readout_s=1e-3 * readout_ms),
    )  # fmt: skip
    plain = ((*step, dict[str, Any]()) for step in read)
    _run(plain, patterns, forms, overlay, output, total, options, BudgetReport(budget))


def calibrate_reflectors(
    frames: Annotated[
        list[str], typer.Argument(help="A run with its truth: a scene, or lit and dark ones.")
    ],
    target: Annotated[
        str, typer.Option(help="Target file with reflectors, its folder, or client.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Calibration to write (JSON).")],
    camera: CameraFile = None,
    group: Annotated[str | None, typer.Option(help="The group; the first, if not given.")] = None,
    mode: Annotated[
        Mode | None, typer.Option(help="Default: pairs; two folders: splitter.")
    ] = None,
    centroid: Annotated[Centroid, typer.Option(help="A spot's place.")] = Centroid.WINDOWED,
) -> None:
    """Fit the closed form of Book et al. to a run with truth.

    \b
    Example: rendezview calibrate reflectors run/lit run/dark --target client -o calibration.json
    """
    reflectors(
        [_CALIBRATE, *frames], target, camera, output, group=[group] if group else None, mode=mode,
        centroid=centroid,
    )  # fmt: skip


_SEPARATE = "Dots are found, but no reading follows the one before: separate poses? --independent"


class _Hint:
    """What may be wrong with the mode of a run that begins without a pose; said once."""

    def __init__(self, options: ThresholdOptions) -> None:
        self._options = options
        self._first: FramePair | None = None  # that could be read
        self._readings, self._found, self._open = 0, 0, True

    def look(self, pair: FramePair, frames: LitDark | None, reading: ReflectorObservation) -> None:
        """Take a reading; a camera that goes on gets its hint after a few."""
        if reading.pose is not None:
            self._open = False
        elif frames is not None:
            self._first = self._first or pair
            self._readings += 1
            self._found += reading.status is Status.UNCONFIRMED
            if self._readings == _READINGS_TO_HINT:
                self.tell()

    def tell(self) -> None:
        """Say it, if there is something to say."""
        if self._open and self._first:
            if self._found >= max(2, self._readings / 2):
                say(_SEPARATE)
            elif words := wrong_mode([self._first], self._options):
                say(words)
        self._open = False


# One reading, with what a log has besides.
_Step = tuple[FramePair, LitDark | None, ReflectorObservation, dict[str, Any]]


def pairs_of(
    places: list[str], camera: Path | None, mode: Mode | None, lit_from_dark: str | None,
    invert: bool, rate: float | None, readings: int | None,
) -> tuple[Iterable[FramePair], int | None]:  # fmt: skip
    """The readings of pictures or of a live camera, and how many are wanted."""
    seen_by = load_camera(camera) if camera else None
    if len(places) == 1 and is_live(places[0]):
        live = live_frames(places[0], seen_by, say, every=True)
        return pair_up_live(live, mode or Mode.SINGLE, invert), readings
    sequences = [open_sequence(place, seen_by) for place in places]
    say_once(*(note for sequence in sequences for note in sequence.notes))
    if rate is not None:
        sequences = [with_rate(sequence, rate) for sequence in sequences]
    # Black dots do not shine: no picture shows them lit and none dark.
    one = Mode.SINGLE if invert else Mode.PAIRS
    chosen = mode or (Mode.SPLITTER if len(places) == 2 else one)
    pairs = pair_up(sequences, chosen, _affine(lit_from_dark), invert)
    return pairs, len(pairs) if readings is None else min(readings, len(pairs))


def _run(
    steps: Iterable[_Step], patterns: list[ReflectorPattern], forms: PaperForms,
    overlay: Path | None, output: Path | None, total: int | None, options: ThresholdOptions,
    report: BudgetReport,
) -> None:  # fmt: skip
    """Write log and pictures of all readings; a run that starts without a pose gets a hint."""
    compile_ahead("reflectors")
    hint = _Hint(options)

    def lines() -> Iterator[Line]:
        for pair, pictures, reading, more in steps:
            if overlay and pictures is not None:
                drawn = draw_reading(pictures, reading, pair.lit.camera, patterns)
                write_png(overlay / f"{pair.lit.im_id:06d}.png", drawn)
            hint.look(pair, pictures, reading)
            report.take(reading.budget)
            noted = record(pair, reading, patterns, forms, pictures) | more
            yield Line(noted, reading.status, spent_ms=sum(reading.stage_ms.values()))

    with ProgressBar() as bar:
        summary = run(lines(), log=output, progress=bar.stage("readings", total or 0))
    poses = summary.outcomes[Status.OK]
    say_summary(summary, poses, summary.total, what="poses", step="reading")
    hint.tell()
    report.tell()


def _affine(text: str | None) -> np.ndarray | None:
    if text is None:
        return None
    words = ": the six numbers 'a,b,c,d,e,f' of u = a u' + b v' + c, v = d u' + e v' + f, "
    words += "which can be inverted"
    return numbers_of(
        text, "--lit-from-dark", (6,), words,
        lambda n: bool(abs(np.linalg.det(n.reshape(2, 3)[:, :2])) >= 1e-3),
    ).reshape(2, 3)  # fmt: skip
