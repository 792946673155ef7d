"""``rendezview calibrate pattern``: where the reflectors of a target are, and which one is off."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from rendezview.calibration.pattern import (
    KnownLength,
    MeasuredPattern,
    Sighting,
    loosened,
    measure_pattern,
    sightings_of_log,
    sightings_of_readings,
)
from rendezview.cli.compiling import compile_ahead
from rendezview.cli.inputs import CameraFile, check_positive, given_camera, numbers_of
from rendezview.cli.progress import ProgressBar, say, say_table
from rendezview.cli.reflectors import pairs_of
from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.bundled import find_target
from rendezview.io.files import check_place
from rendezview.io.sequences.live import is_live
from rendezview.io.target_writer import write_places
from rendezview.sensors.beacons.constellation import ReflectorPattern, patterns_of
from rendezview.sensors.beacons.match.acquisition import merged
from rendezview.sensors.beacons.match.acquisition_options import AcquisitionOptions
from rendezview.sensors.beacons.run import Mode, follow

_LOG = ".jsonl"


def calibrate_pattern(
    target: Annotated[
        str, typer.Option(help="Target file with reflectors, its folder, or client.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Corrected target file to write.")],
    frames: Annotated[
        list[str] | None,
        typer.Argument(
            help="A run: pictures, as for reflectors, or its log (*.jsonl) with --camera. None: "
            "with --length only."
        ),
    ] = None,
    camera: CameraFile = None,
    group: Annotated[
        list[str] | None, typer.Option(help="Groups that there are; repeat for several. All.")
    ] = None,
    mode: Annotated[
        Mode | None, typer.Option(help="Default: pairs; two folders: splitter.")
    ] = None,
    invert: Annotated[bool, typer.Option("--invert", help="Black dots on a white ground.")] = False,
    blur: Annotated[
        float, typer.Option(min=0.2, max=20.0, help="Blur of the optics, pixels (one σ).")
    ] = 0.75,
    length: Annotated[
        list[str] | None,
        typer.Option(
            help="A distance that was measured between two reflectors' middles, m: "
            "'left:right=0.126'. It fixes the size, else the file does."
        ),
    ] = None,
    length_error_mm: Annotated[float, typer.Option(help="One σ of these.")] = 0.3,
) -> None:
    """Measure where a target's reflectors are; name the one that is off.

    \b
    Example: rendezview calibrate pattern run/lit run/dark --target client -o measured.toml
             rendezview calibrate pattern readings.jsonl --camera c.yaml --target t.toml -o m.toml
             rendezview calibrate pattern --target t.toml --length left:right=0.126 -o m.toml
    """
    check_place(output, "the target file")
    known = find_target(target)
    patterns = patterns_of(known, tuple(group) if group else None)
    pattern = merged(patterns)
    lengths = [_length(text, length_error_mm) for text in length or []]
    seen_by, sightings = _sightings(frames or [], patterns, camera, mode, invert, blur)
    found = measure_pattern(seen_by, patterns, sightings, lengths=lengths, blur_px=blur)
    places = zip(found.pattern.positions_m, found.pattern.sigmas_m.tolist(), strict=True)
    write_places(known, dict(zip(pattern.names, places, strict=True)), output)
    _tell(found, output, sized=bool(lengths))


def _sightings(
    places: list[str], patterns: list[ReflectorPattern], camera: Path | None, mode: Mode | None,
    invert: bool, blur: float,
) -> tuple[Camera | None, list[Sighting]]:  # fmt: skip
    """The camera of a run, and its readings with four or more spots."""
    if not places:
        return None, []
    if len(places) == 1 and Path(places[0]).suffix == _LOG:
        seen_by = given_camera(camera)
        if seen_by is None:
            raise RendezviewError(f"{places[0]}: a log has no camera: give --camera")
        return seen_by, sightings_of_log(places[0], merged(patterns))
    if is_live(places[0]):
        raise RendezviewError(f"{places[0]}: a calibration takes a recorded run, not a live camera")
    pairs = list(pairs_of(places, camera, mode, None, invert, None, None)[0])
    cameras = {pair.lit.camera for pair in pairs}
    if len(cameras) != 1:
        raise RendezviewError(f"{places[0]}: needs pictures of one camera: give it with --camera")
    compile_ahead("reflectors")
    readings = []
    with ProgressBar() as bar:
        done = bar.stage("readings", len(pairs))
        options = AcquisitionOptions(blur_px=blur)
        for _, _, reading in follow(pairs, loosened(patterns), acquisition=options):
            readings.append(reading)
            done(len(readings))
    return cameras.pop(), sightings_of_readings(readings, merged(patterns))


def _length(text: str, error_mm: float) -> KnownLength:
    parted = re.fullmatch(r"([^:=]+):([^:=]+)=([0-9.eE+-]+)", text.strip())
    if parted is None:
        raise RendezviewError(f"--length must be NAME:NAME=METRES, not {text!r}")
    (metres,) = numbers_of(parted[3], f"--length {text!r}", (1,))
    check_positive(f"--length {text!r}", metres)
    check_positive("--length-error-mm", error_mm)
    return KnownLength(parted[1], parted[2], float(metres), 1e-3 * error_mm)


def _tell(found: MeasuredPattern, output: Path, *, sized: bool) -> None:
    rows = zip(found.pattern.names, found.moved_m, found.pattern.sigmas_m, found.off, strict=True)
    say_table(
        ("reflector", "moved, mm", "σ, mm", "off, %"),
        (
            (name, " ".join(f"{1e3 * value:+.3f}" for value in moved), f"{1e3 * sigma:.2g}",
             f"{100.0 * off:.0f}")
            for name, moved, sigma, off in rows
        ),
    )  # fmt: skip
    for name in found.named:
        moved = found.moved_m[found.pattern.names.index(name)]
        say(f"{name} is off by {1e3 * float(np.linalg.norm(moved)):.2f} mm: its place is corrected")
    if found.suspects:
        say(f"{', '.join(found.suspects)} may be off: not certain; σ covers both")
    if found.roll_ambiguous and (found.named or found.suspects):
        say("the pattern looks the same after half a turn: the names hold if the roll is below 90°")
    if sized:
        say(f"size {100.0 * found.size:.2f} % of the file's (σ {100.0 * found.size_sigma:.2f} %)")
    frame = "place and attitude" if sized else "place, attitude and size"
    say(
        f"{output}: from {found.used} of {found.given} readings with four or more spots, residuals "
        f"{found.noise:.1f} σ; the {frame} of the whole are the file's"
    )
