"""The ``rendezview`` command: finds its sub-commands and reports errors in one line.

Sub-commands are entry points of the group ``rendezview.commands``, each a function that
typer understands, or a typer application with commands of its own; those of the ground side
need ``rendezview[training]``. Only the one that is called is imported, so that each starts fast.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable
from importlib import metadata
from typing import Any

import typer

from rendezview.errors import RendezviewError, without_cache

GROUP = "rendezview.commands"
_OTHER_OPENCV = ("opencv-python", "opencv-contrib-python", "opencv-contrib-python-headless")
_INTERRUPTED = "rendezview: interrupted"

# In the order of a first use. The help shows these without importing the commands.
_SUMMARIES = {
    "demo": "Train, simulate, track, report: the tour.",
    "doctor": "Say what is wrong with a mesh, and what it costs in accuracy.",
    "train": "Train a view model of a target.",
    "catalogue": "Train models of many targets, shells and lights.",
    "simulate": "Render camera frames of a target with the truth of every one.",
    "track": "Recognise and track a target through a sequence of frames.",
    "ring": "Find a docking ring: its ellipses, and with its radius its pose.",
    "stereo": "Track a target's lights with two or more cameras.",
    "calibrate": "Calibrate a camera, or a target's shape; print a card of dots.",
    "reflectors": "Read a video guidance sensor: reflectors to six numbers, or calibrate it.",
    "fuse": "Join several sensors' logs into one state: pose, rates, covariance.",
    "guide": "Fit the path of a log of poses, and say the correction back to a plan.",
    "serve": "Serve poses: frames in, poses out, a page to watch them.",
    "replay": "Repeat a recorded run bit for bit, or mend its log.",
    "rrd": "Convert a run into a recording for the Rerun viewer.",
    "evaluate": "Compare results with the truth of their scene.",
    "assess": "Say how accurate a model is on its craft, on simulated frames.",
    "fly": "Fly to a target's port in a closed loop, and report the contact.",
    "campaign": "The former name of assess.",
    "show": "Draw any file that rendezview writes.",
    "export": "Print a model's decision trees, or write flight code: C99, ONNX.",
}


def make_app(called: str | None) -> typer.Typer:
    """The application with the command that is called, and a line for each of the others.

    Raises:
        RendezviewError: the command's packages are not installed.
    """
    app = typer.Typer(
        help="Where a spacecraft is relative to another one, from a single camera and a CAD model.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )
    app.callback()(_root)
    points = {point.name: point for point in metadata.entry_points(group=GROUP)}
    for name in sorted(points, key=_place):
        command = _load(points[name]) if name == called else _nothing
        if isinstance(command, typer.Typer):  # a command with commands of its own
            app.add_typer(command, name=name)
        else:
            app.command(name, help=_SUMMARIES.get(name) if command is _nothing else None)(command)
    return app


def _place(name: str) -> tuple[int, str]:
    names = list(_SUMMARIES)
    return (names.index(name) if name in names else len(names), name)


def _load(point: metadata.EntryPoint) -> Callable[..., Any] | typer.Typer:
    try:
        command: Callable[..., Any] | typer.Typer = point.load()
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("rendezview"):
            raise
        raise RendezviewError(
            f"`rendezview {point.name}` belongs to the ground side and {error.name} is not "
            "installed: pip install 'rendezview[training]'"
        ) from None
    return command


def _nothing() -> None:
    """Placeholder for a command that is not called."""


def _root(version: bool = typer.Option(False, "--version", help="Print the version.")) -> None:
    """Where a spacecraft is relative to another one, from a single camera and a CAD model."""


def tell_of_other_opencv() -> None:
    """A line on packages that hold another ``cv2`` in the same folder."""
    for name in _OTHER_OPENCV:
        with contextlib.suppress(metadata.PackageNotFoundError):
            version = metadata.version(name)
            print(
                f"rendezview: {name} {version} and opencv-python-headless overwrite each other "
                f"(both are cv2): pip uninstall {name}, then pip install --force-reinstall "
                "opencv-python-headless",
                file=sys.stderr,
            )


def main() -> None:
    """Run a command: exit 0; 1 for what the user can fix, in one line; 2 for usage."""
    arguments = sys.argv[1:]
    if arguments[:1] == ["--version"]:
        print(f"rendezview {metadata.version('rendezview')}")
        return
    tell_of_other_opencv()
    try:
        make_app(next((a for a in arguments if not a.startswith("-")), None))()
    except RendezviewError as error:
        print(f"rendezview: {error}", file=sys.stderr)
        sys.exit(1)
    except RuntimeError as error:
        words = without_cache(error)
        if words is None:
            raise
        print(f"rendezview: {words}", file=sys.stderr)
        sys.exit(1)
    except MemoryError as error:
        print(f"rendezview: not enough memory ({error})", file=sys.stderr)
        sys.exit(1)
    except OSError as error:  # of the standard output; file errors are RendezviewError
        place = f"{error.filename}: " if error.filename else ""
        print(f"rendezview: {place}{error.strerror or error}", file=sys.stderr)
        # The rest of the buffer would fail again when the interpreter ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except KeyboardInterrupt:
        print(_INTERRUPTED, file=sys.stderr)
        sys.exit(130)
    except SystemExit as end:
        if end.code == 130:  # typer's answer to Ctrl-C, which prints nothing
            print(_INTERRUPTED, file=sys.stderr)
        raise
