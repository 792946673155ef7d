"""``rendezview calibrate``: cameras, a card of dots, the shape of a target, a ring's size."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from rendezview.calibration.as_built import AsBuilt, ShapeEstimator, strain_names
from rendezview.calibration.as_built.picture import shape_picture
from rendezview.calibration.board import Chessboard
from rendezview.calibration.one_camera import CharucoBoard, calibrate_camera
from rendezview.cli.inputs import CameraFile, ObjectId, board_of, check_positive, given_sequence
from rendezview.cli.pattern import calibrate_pattern
from rendezview.cli.progress import say, say_table
from rendezview.cli.reflectors import calibrate_reflectors
from rendezview.cli.ring import size
from rendezview.cli.stereo import calibrate_rig
from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array, Pose
from rendezview.io.camera_files import save_camera
from rendezview.io.files import check_place, make_folder
from rendezview.io.results import read_results
from rendezview.io.sequences import Sequence
from rendezview.io.sequences.images import write_png
from rendezview.io.target import Target
from rendezview.sensors.appearance import ViewModel
from rendezview.sensors.beacons.card import Paper, write_card

calibrate = typer.Typer(
    help="Calibrate cameras from pictures of a board; measure a target from frames.",
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
    """Calibrate one camera, into a file that every command takes.

    \b
    Example: rendezview calibrate camera boards/*.jpg --board 9x6 --pitch-mm 25 -o webcam.yaml
             rendezview calibrate camera boards --board 7x5 --pitch-mm 30 --marker-mm 22 -o c.yaml
    """
    check_place(output, "the camera file")
    columns, rows = board_of(board)
    check_positive("--pitch-mm", pitch_mm)
    check_positive("--marker-mm", marker_mm)
    pattern = (
        Chessboard(columns, rows, 1e-3 * pitch_mm)
        if marker_mm is None
        else CharucoBoard(columns, rows, 1e-3 * pitch_mm, 1e-3 * marker_mm, dictionary)
    )
    found = calibrate_camera(pictures, pattern)
    save_camera(found.camera, output)
    numbers = ((name, f"{value:.6g}", f"{sigma:.2g}") for name, value, sigma in found.rows())
    say_table(("parameter", "value", "σ"), numbers)
    say(
        f"{output}: from {found.used} of {found.given} pictures, r.m.s. {found.rms_px:.3f} px"
        + (f"; no board in {', '.join(found.without)}" if found.without else "")
    )


@calibrate.command()
def card(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder to write.")],
    diameter_mm: Annotated[float, typer.Option(help="Of the dots.")] = 16.0,
    paper: Annotated[Paper, typer.Option(help="Size of the page.")] = Paper.A4,
    code: Annotated[
        int, typer.Option(min=1, max=2, help="Which of two cards that are told apart.")
    ] = 1,
) -> None:
    """Make a card of dots to print (PDF), with its target file.

    \b
    Example: rendezview calibrate card -o card
    Print it at 100 %, fold it along the lines, and measure the scale bar: 100 mm. If it has
    97 mm, ranges come out 3 % too long: `calibrate pattern --length` measures the dots.
    """
    make_folder(output)
    write_card(output, 1e-3 * diameter_mm, paper, code)
    say(
        f"{output}/card.pdf, {output}/target.toml: print at 100 %, fold, then "
        f"rendezview reflectors {output}/target.toml 0 --camera webcam.yaml --invert"
    )


@calibrate.command()
def shape(
    model: Annotated[Path, typer.Argument(help="Model file (*.rvm) trained on the CAD mesh.")],
    scene: Annotated[
        Path, typer.Argument(help="Fly-around: BOP scene, SPEED folder, folder of images, video.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Model file to write.")],
    camera: CameraFile = None,
    poses: Annotated[
        str | None,
        typer.Option(
            help="Rough poses (10°): 'scene' for its truth, or a results CSV of track. Without: "
            "the recognizer finds them."
        ),
    ] = None,
    length: Annotated[
        list[str] | None,
        typer.Option(
            help="A known length along an axis, measured over modelled: 'x=0.571/0.560'. "
            "Without one the overall size stays the model's."
        ),
    ] = None,
    length_error: Annotated[float, typer.Option(help="One σ of these ratios.")] = 1e-3,
    parts: Annotated[
        Path | None,
        typer.Option(
            help="Target file whose [[parts]] (with boxes_m) may be mounted aside: the turn, shift "
            "and trust of each are estimated."
        ),
    ] = None,
    lens: Annotated[
        Path | None,
        typer.Option(
            help="Camera file to write: focal length and principal point are estimated as well."
        ),
    ] = None,
    frames: Annotated[int, typer.Option(help="At most, evenly spaced.")] = 200,
    obj_id: ObjectId = None,
    picture: Annotated[
        Path | None,
        typer.Option(help="PNG to write: residuals over the surface, before and after."),
    ] = None,
) -> None:
    """Estimate how a target differs from its CAD model; correct it.

    \b
    Frames of a fly-around show it. The difference is a strain: other sizes along x, y and z, and
    shears; with --parts also parts that are turned or shifted. Poses need not be known.
    Example: rendezview calibrate shape tango.rvm fly-around -o as-built.rvm --length x=0.571/0.560
    """
    check_place(output, "the model")
    check_place(picture, "the picture")
    check_place(lens, "the camera file")
    loaded = ViewModel.load(model)
    mounted = () if parts is None else Target.load(parts).parts
    if parts is not None and not mounted:
        raise RendezviewError(f"{parts}: no [[parts]]: name those that may be mounted aside")
    sequence = given_sequence(scene, camera, obj_id)
    if frames < 1 or not len(sequence):
        raise RendezviewError(f"{scene}: calibration needs frames")
    cameras = {frame.camera for frame in sequence}
    if len(cameras) > 1:
        raise RendezviewError(f"{scene}: the frames have several cameras: give one with --camera")
    known = dict(_known_length(text, length_error) for text in length or [])
    chosen = np.unique(np.linspace(0, len(sequence) - 1, max(1, frames)).round().astype(int))
    priors = _rough_poses(poses, sequence)
    found = ShapeEstimator(loaded, cameras.pop()).estimate(
        [sequence.frames[int(k)].read() for k in chosen],
        None if priors is None else [priors[int(k)] for k in chosen],
        known,
        say,
        mounted,
        lens=lens is not None,
    )
    found.model.save(output)
    if lens is not None:
        save_camera(found.camera, lens)
    if picture is not None:
        write_png(picture, shape_picture(found, f"{loaded.name}: {found.used} frames"))
    _tell(found, output, len(chosen))


calibrate.command("rig")(calibrate_rig)
calibrate.command("pattern")(calibrate_pattern)
calibrate.command("reflectors")(calibrate_reflectors)
calibrate.command("ring")(size)


def _known_length(text: str, error: float) -> tuple[int, tuple[float, float]]:
    """A component of the strain, its value and σ."""
    parted = re.fullmatch(r"([xyz])=([0-9.eE+-]+)/([0-9.eE+-]+)", text.strip())
    try:
        ratio = float(parted[2]) / float(parted[3]) if parted else np.nan
    except (ValueError, ZeroDivisionError):
        ratio = np.nan
    if parted is None or not 0.5 < ratio < 2.0:
        raise RendezviewError(
            f"--length must be AXIS=MEASURED/MODELLED like x=0.571/0.560, not {text!r}"
        )
    if not 0.0 < error < 1.0:
        raise RendezviewError(f"--length-error must be a share above 0, not {error}")
    return "xyz".index(parted[1]), (ratio - 1.0, error)


def _rough_poses(text: str | None, sequence: Sequence) -> list[Pose | None] | None:
    """A pose for each frame of the sequence, where there is one."""
    if text is None:
        return None
    if text == "scene":
        return [frame.camera_from_target for frame in sequence.frames]
    rows = {row.im_id: row.camera_from_target for row in read_results(text)}
    return [rows.get(frame.im_id) for frame in sequence.frames]


def _triple(values: Array) -> str:
    return " ".join(f"{value:+.2f}" for value in values)


def _tell(found: AsBuilt, output: Path, given: int) -> None:
    sigmas = np.sqrt(np.diag(found.covariance))
    strain = zip(strain_names(), found.components, sigmas, strict=True)
    say_table(
        ("strain", "%", "σ, %"), ((n, f"{100 * v:+.2f}", f"{100 * s:.2f}") for n, v, s in strain)
    )
    if found.mountings:
        rows = []
        for part in found.mountings:
            turn, shift = np.sqrt(np.trace(part.covariance[:3, :3])), part.motion[3:]
            rows.append((
                part.name, _triple(np.rad2deg(part.motion[:3])), f"{np.rad2deg(turn):.2g}",
                _triple(1e3 * shift), f"{1e3 * np.sqrt(np.trace(part.covariance[3:, 3:])):.2g}",
                f"{part.trust:.2f}", str(part.edges),
            ))  # fmt: skip
        say_table(("part", "turned, °", "σ", "shifted, mm", "σ", "trust", "edges"), rows)
    if len(found.lens_covariance):
        sigmas = np.sqrt(np.diag(found.lens_covariance))
        seen = found.camera
        say(
            f"focal length {seen.fx:.2f} px (σ {seen.fx * sigmas[0]:.2f}), principal point "
            f"{seen.cx:.2f}, {seen.cy:.2f} px (σ {sigmas[1]:.2f}, {sigmas[2]:.2f})"
        )
    if not found.size_known:
        say(
            "one camera does not see the overall size: it stays the model's, give a --length to "
            "correct it"
        )
    say(
        f"{output}: from {found.used} of {given} frames; edges lie "
        f"{100 * found.rms_before:.2f} % of the target's radius aside before, "
        f"{100 * found.rms_after:.2f} % after"
    )
