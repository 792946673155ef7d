"""``rendezview calibrate camera`` and ``rendezview calibrate card``."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from rendezview.cli.progress import say
from rendezview.errors import RendezviewError
from rendezview.io.camera_files import save_camera
from rendezview.io.files import check_place, make_folder
from rendezview.sensors.reflectors.card import write_card
from rendezview.sensors.stereo.board import Chessboard
from rendezview.sensors.stereo.one_camera import CharucoBoard, calibrate_camera

calibrate = typer.Typer(
    help="Calibrate one camera from pictures of a board; print a card of dots.",
    no_args_is_help=True,
    rich_markup_mode=None,
)


@calibrate.command()
def camera(
    pictures: Annotated[list[Path], typer.Argument(help="Pictures of the board, or their folder.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Camera file to write (YAML).")],
    board: Annotated[
        str, typer.Option(help="Chessboard: inner corners. ChArUco: squares, with --marker-mm.")
    ] = "9x6",
    pitch_mm: Annotated[float, typer.Option(help="Side of a square.")] = 25.0,
    marker_mm: Annotated[
        float | None, typer.Option(help="Side of a marker: the board is a ChArUco board.")
    ] = None,
    dictionary: Annotated[
        str, typer.Option(help="OpenCV's dictionary of the markers.")
    ] = "DICT_4X4_50",
) -> None:
    """Calibrate one camera: intrinsics and lens, into a file that every command takes.

    \b
    Example: rendezview calibrate camera boards/*.jpg --board 9x6 --pitch-mm 25 -o webcam.yaml
             rendezview calibrate camera boards --board 7x5 --pitch-mm 30 --marker-mm 22 -o c.yaml
    """
    check_place(output, "the camera file")
    parted = re.fullmatch(r"(\d+)x(\d+)", board)
    if parted is None or min(int(parted[1]), int(parted[2])) < 3:
        raise RendezviewError(f"--board must be like 9x6, at least 3x3, not {board!r}")
    for name, value in (("--pitch-mm", pitch_mm), ("--marker-mm", marker_mm)):
        if value is not None and not (np.isfinite(value) and value > 0.0):
            raise RendezviewError(f"{name} must be positive, not {value}")
    columns, rows, pitch_m = int(parted[1]), int(parted[2]), 1e-3 * pitch_mm
    pattern = (
        Chessboard(columns, rows, pitch_m)
        if marker_mm is None
        else CharucoBoard(columns, rows, pitch_m, 1e-3 * marker_mm, dictionary)
    )
    found = calibrate_camera(pictures, pattern)
    save_camera(found.camera, output)
    table = Table("parameter", "value", "σ")
    for name, value, sigma in found.rows():
        table.add_row(name, f"{value:.6g}", f"{sigma:.2g}")
    Console(stderr=True).print(table)
    say(
        f"{output}: from {found.used} of {found.given} pictures, r.m.s. {found.rms_px:.3f} px"
        + (f"; no board in {', '.join(found.without)}" if found.without else "")
    )


@calibrate.command()
def card(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder to write.")],
    diameter_mm: Annotated[float, typer.Option(help="Of the dots.")] = 16.0,
) -> None:
    """Make a card of three dots to print (A4, PDF), with its target file.

    \b
    Example: rendezview calibrate card -o card
    Print it at 100 %, fold it along the lines, and measure the scale bar: 100 mm.
    """
    make_folder(output)
    write_card(output, 1e-3 * diameter_mm)
    say(
        f"{output}/card.pdf, {output}/target.toml: print at 100 %, fold, then "
        f"rendezview reflectors {output}/target.toml 0 --camera webcam.yaml --invert"
    )
