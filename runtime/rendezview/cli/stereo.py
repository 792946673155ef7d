"""``rendezview stereo track`` and ``rendezview calibrate rig``."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from rendezview.calibration.board import OPENCV_FIVE, Chessboard, calibrate_board, read_board_views
from rendezview.calibration.laboratory import calibrate_laboratory
from rendezview.calibration.laboratory_files import load_record
from rendezview.cli.budget import BudgetReport
from rendezview.cli.compiling import compile_ahead
from rendezview.cli.inputs import board_of, check_apart, check_positive
from rendezview.cli.progress import ProgressBar, say, say_summary, say_table
from rendezview.errors import RendezviewError
from rendezview.io.bundled import find_target
from rendezview.io.files import check_place
from rendezview.io.results import ResultRow
from rendezview.sensors.beacons import (
    MotionOptions,
    Rig,
    Spots,
    StereoObservation,
    StereoTracker,
    TrackerOptions,
)
from rendezview.sensors.beacons.detect.led_spots import SpotOptions
from rendezview.sensors.beacons.detect.photodiode import Normalisation
from rendezview.sensors.beacons.multiplex import MultiplexedTracker
from rendezview.sensors.beacons.readings import open_readings, picture_pairs
from rendezview.sensors.beacons.rig import INTRINSICS
from rendezview.sensors.beacons.rig_files import load_rig, save_opencv, save_rig
from rendezview.sensors.run import Line, run
from rendezview.sensors.sensor import Sensor

stereo = typer.Typer(
    help="Track a target's lights with two or more cameras.",
    no_args_is_help=True,
    rich_markup_mode=None,
)


@stereo.command("calibrate", hidden=True)  # until version 0.4
def calibrate_rig(
    source: Annotated[
        Path, typer.Argument(help="Folder of board pictures, or a laboratory's record (*.json).")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Rig file to write (JSON).")],
    board: Annotated[str, typer.Option(help="Inner corners of the chessboard.")] = "9x6",
    pitch_mm: Annotated[float, typer.Option(help="Distance of two corners.")] = 25.0,
    lens: Annotated[
        str, typer.Option(help="opencv, or welch: eq. 6 from measured to ideal, p3 and centre too.")
    ] = "opencv",
    opencv: Annotated[
        Path | None, typer.Option(help="Write OpenCV's M1 D1 M2 D2 R T besides (YAML).")
    ] = None,
    order: Annotated[
        int, typer.Option(help="Of a photodiode's response: 3 as in the paper, or 5.")
    ] = 5,
    normalisation: Annotated[
        Normalisation,
        typer.Option(help="Divisor of a photodiode's currents: pair as in the paper's eq. 1, 2."),
    ] = Normalisation.TOTAL,
) -> None:
    """Calibrate two or more cameras, lenses and their places.

    \b
    Pictures are left01.png right01.png ... or left/01.png right/01.png ...
    Example: rendezview calibrate rig pictures --board 9x6 --pitch-mm 25 -o rig.json
    """
    check_place(output, "the rig")
    rig = (
        _from_pictures(source, board, pitch_mm, lens)
        if source.is_dir()
        else _from_record(source, order, normalisation)
    )
    save_rig(rig, output)
    if opencv is not None:
        save_opencv(rig, opencv)
    _print_rig(rig)


@stereo.command()
def track(
    rig: Annotated[Path, typer.Argument(help="Rig file (JSON), or OpenCV's stereo YAML.")],
    target: Annotated[str, typer.Argument(help="Target file with [[leds]], or its folder.")],
    readings: Annotated[
        Path, typer.Argument(help="JSON lines of currents or spots, or a folder of pictures.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Results, BOP CSV.")],
    log: Annotated[
        Path | None, typer.Option(help="Everything of each reading, JSON lines.")
    ] = None,
    filtered: Annotated[
        bool, typer.Option("--filter", help="Weigh each reading against the motion before it.")
    ] = False,
    angular: Annotated[
        float, typer.Option(help="With --filter: angular acceleration, deg/s² √s.")
    ] = 1.0,
    linear: Annotated[float, typer.Option(help="With --filter: acceleration, m/s² √s.")] = 0.02,
    rate: Annotated[float, typer.Option(help="Pictures a second.")] = 1.0,
    threshold: Annotated[
        float | None, typer.Option(help="Grey levels above the sky that make a light.")
    ] = None,
    multiplex: Annotated[
        float,
        typer.Option(
            "--multiplex-s", min=0.0, help="Seconds from one light to the next of a reading."
        ),
    ] = 0.0,
    budget: Annotated[
        bool, typer.Option("--budget", help="Print the errors of the poses by cause, at the end.")
    ] = False,
) -> None:
    """Track a target's lights through a log of readings or pictures.

    \b
    Example: rendezview stereo track rig.json scole readings.jsonl -o poses.csv --log log.jsonl
    """
    check_place(output, "the results")
    check_apart(output, log, rig, readings)
    loaded = load_rig(rig)
    lights = find_target(target)
    names = tuple(led.name for led in lights.leds)
    motion = None
    if filtered:
        if not (np.isfinite(angular) and np.isfinite(linear) and min(angular, linear) >= 0.0):
            raise RendezviewError("--angular and --linear must not be negative")
        motion = MotionOptions(
            angular_acceleration=float(np.deg2rad(angular)), linear_acceleration=linear
        )
    plain = StereoTracker.of_target(loaded, lights, TrackerOptions(motion=motion))
    tracker: Sensor[Sequence[Spots], StereoObservation] = plain
    if multiplex > 0.0:
        tracker = MultiplexedTracker(plain, multiplex * np.arange(len(names)))
    options = SpotOptions(threshold_grey=threshold)
    series = open_readings(readings, loaded, names, rate_hz=rate, options=options)
    if not series:
        raise RendezviewError(f"{readings}: holds no readings")
    compile_ahead("stereo")
    report = BudgetReport(budget)

    def lines() -> Iterator[Line]:
        for reading in series:
            start = time.perf_counter()
            observation = tracker.update(reading.time_s, reading.fetch())
            spent_ms = 1e3 * (time.perf_counter() - start)
            row = None
            report.take(observation.budget)
            if observation.pose is not None:
                score, spent_s = float(observation.inliers), 1e-3 * spent_ms
                row = ResultRow(1, reading.im_id, 1, score, observation.pose, spent_s)
            noted = {"im_id": reading.im_id, **observation.record()}
            # With the time that the search for spots in the pictures takes.
            noted["stage_ms"] = {"track": spent_ms}
            yield Line(noted, observation.status, row, spent_ms)

    with ProgressBar() as bar:
        progress = bar.stage("readings", len(series))
        summary = run(lines(), log=log, results=output, progress=progress)
    say_summary(summary, len(summary.rows), len(series), what="poses", step="reading")
    report.tell()


def _from_pictures(folder: Path, board: str, pitch_mm: float, lens: str) -> Rig:
    columns, rows = board_of(board)
    check_positive("--pitch-mm", pitch_mm)
    if lens not in ("opencv", "welch"):
        raise RendezviewError(f"--lens must be opencv or welch, not {lens!r}")
    views = read_board_views(picture_pairs(folder), Chessboard(columns, rows, 1e-3 * pitch_mm))
    free = OPENCV_FIVE if lens == "opencv" else INTRINSICS
    made = calibrate_board(views, free=free, corrects=lens == "welch")
    alone = zip(views.names, made.separate, strict=True)
    each = ", ".join(f"{name} {found.rms:.3f} px" for name, found in alone)
    say(f"r.m.s. {each}, together {made.together.rms:.3f} px")
    return made.rig


def _from_record(path: Path, order: int, normalisation: Normalisation) -> Rig:
    if order not in (3, 5):
        raise RendezviewError(f"--order must be 3 or 5, not {order}")
    made = calibrate_laboratory(load_record(path), normalisation, order)
    say_table(
        ("step", "before, µm", "after, µm"),
        ((s.name, f"{1e6 * s.before_m:.2f}", f"{1e6 * s.after_m:.2f}") for s in made.steps),
    )
    return made.rig


def _print_rig(rig: Rig) -> None:
    rows = []
    for camera in rig.cameras:
        values = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.lens.coefficients]
        for name, value in zip(INTRINSICS, values, strict=True):
            sigma = camera.sigma.get(name, camera.sigma.get("f") if name[0] == "f" else None)
            if sigma is not None:
                rows.append((camera.name, name, f"{value:.6g}", f"{sigma:.2g}"))
    say_table(("camera", "parameter", "value", "σ"), rows)
