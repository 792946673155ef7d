"""Inputs of commands: what a reader questions in them is a line on the screen."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from rendezview.cli.progress import as_json, say
from rendezview.geometry.camera import Camera
from rendezview.io.camera_files import load_camera
from rendezview.io.sequences import Sequence, open_sequence


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
