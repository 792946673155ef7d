"""Inputs of commands: their options; what a reader questions is a line on the screen."""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from rendezview.cli.progress import as_json, say
from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array
from rendezview.io.camera_files import load_camera
from rendezview.io.sequences import Sequence, open_sequence

CameraFile = Annotated[
    Path | None, typer.Option(help="Camera file; wins over that of the pictures.")
]
ObjectId = Annotated[int | None, typer.Option(help="Which object of a BOP scene is the target.")]


def given_camera(path: Path | None) -> Camera | None:
    """The camera of ``--camera``.

    Raises:
        RendezviewError: as `load_camera`.
    """
    camera = None if path is None else load_camera(path)
    if camera is not None:
        say_once(*(f"{path}: {doubt}" for doubt in camera.doubts))
    return camera


def given_sequence(path: Path, camera: Path | None = None, obj_id: int | None = None) -> Sequence:
    """The frames of a command.

    Raises:
        RendezviewError: as `open_sequence` and `load_camera`.
    """
    sequence = open_sequence(path, load_camera(camera) if camera else None, obj_id=obj_id)
    say_once(*sequence.notes)
    return sequence


def say_once(*lines: str) -> None:
    """Doubts on the screen, equal ones once; for a program that asks, each as a line of JSON."""
    for line in dict.fromkeys(lines):
        if as_json():
            print(json.dumps({"doubt": line}), file=sys.stderr, flush=True)
        else:
            say(line)


def numbers_of(
    text: str, option: str, counts: tuple[int, ...], meaning: str = "",
    valid: Callable[[Array], bool] = lambda _: True,
) -> Array:  # fmt: skip
    """The finite numbers of an option such as 'x,y,w,h', of one of these counts.

    Args:
        meaning: more words for the message.
        valid: what else they must be.

    Raises:
        RendezviewError: something else.
    """
    try:
        numbers = np.array([float(part) for part in text.split(",")])
    except ValueError:
        numbers = np.zeros(0)
    if len(numbers) not in counts or not np.isfinite(numbers).all() or not valid(numbers):
        how_many = " or ".join(map(str, counts))
        raise RendezviewError(
            f"{option} needs {how_many} numbers with commas{meaning}, not {text!r}"
        )
    return numbers


def _has_length(values: Array) -> bool:
    return 0.0 < float(np.linalg.norm(values)) < math.inf


def direction_of(text: str, option: str, meaning: str) -> Array:
    """(3,) unit, of an option 'x,y,z'; errors as of `numbers_of`."""
    meaning = f" 'x,y,z', not all zero, {meaning}"
    values = numbers_of(text, option, (3,), meaning, _has_length)
    return np.asarray(values / np.linalg.norm(values))


def check_positive(option: str, value: float | None) -> None:
    """Refuse a number that is not positive, or not finite; None: not given.

    Raises:
        RendezviewError: it is not.
    """
    if value is not None and not (math.isfinite(value) and value > 0.0):
        raise RendezviewError(f"{option} must be positive, not {value}")


def board_of(text: str) -> tuple[int, int]:
    """Columns and rows of a calibration board, '9x6'.

    Raises:
        RendezviewError: something else, or fewer than three.
    """
    parted = re.fullmatch(r"(\d+)x(\d+)", text)
    if parted is None or min(int(parted[1]), int(parted[2])) < 3:
        raise RendezviewError(f"--board must be like 9x6, at least 3x3, not {text!r}")
    return int(parted[1]), int(parted[2])


def check_apart(*paths: Path | None) -> None:
    """Refuse at once files that are read and written under one name, the first a written one.

    Raises:
        RendezviewError: two are one.
    """
    given = [path for path in paths if path is not None]
    if len({path.resolve() for path in given}) < len(given):
        raise RendezviewError(
            f"{given[0]}: everything read and written must be different files: choose another name"
        )
