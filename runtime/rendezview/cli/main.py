"""The ``rendezview`` command: finds its sub-commands and reports errors in one line.

Sub-commands are entry points of the group ``rendezview.commands``, each a function that
typer understands, or a typer application with commands of its own; those of the ground side
need ``rendezview[training]``. Only the one that is called is imported, so that each starts fast.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from importlib import metadata
from types import FrameType
from typing import Any

import typer
from typer.core import TyperCommand

from rendezview.errors import RendezviewError, optional, without_cache

GROUP = "rendezview.commands"
_OTHER_OPENCV = ("opencv-python", "opencv-contrib-python", "opencv-contrib-python-headless")
_EVERYTHING = "--help-all"
_INTERRUPTED = "rendezview: interrupted"

# In the order of a first use. The help shows these without importing the commands.
_SUMMARIES = {
    "demo": "Train, simulate, track, report: the tour.",
    "doctor": "Say what is wrong with a mesh, and what it costs in accuracy.",
    "train": "Train a view model of a target.",
    "catalogue": "Train models of many targets, shells and lights.",
    "simulate": "Render camera frames of a target with the truth of every one.",
    "track": "Recognise and track a target through a sequence of frames.",
    "ring": "Find a docking ring, and with its radius its pose.",
    "stereo": "Track a target's lights with two or more cameras.",
    "calibrate": "Calibrate cameras, a shape, a ring; print a card.",
    "reflectors": "Measure a target with retro-reflectors: the six numbers.",
    "fuse": "Join several sensors' logs into one state.",
    "guide": "Fit the path of a log of poses; corrections to a plan.",
    "warm": "Compile now what commands compile when they first run.",
    "serve": "Serve poses: frames in, poses out, a page to watch them.",
    "replay": "Repeat a recorded run bit for bit, or mend its log.",
    "rrd": "Convert a run into a recording for the Rerun viewer.",
    "evaluate": "Compare results with the truth of their scene.",
    "assess": "Say how accurate a model is on its craft, on simulated frames.",
    "fly": "Fly to a target's port in a closed loop.",
    "show": "Draw any file that rendezview writes.",
    "export": "Print a model's trees, or write flight code: C99, ONNX.",
}

# What the help of a command with many options shows; --help-all shows the others, too.
_MAIN_OPTIONS = {
    "train": ("output", "unit", "camera", "order", "jobs", "dask", "renderer", "seed"),
    "simulate": (
        "output", "kind", "camera", "frames", "dt", "start_range", "end_range", "axis", "sun_phase",
        "earth", "laser", "reflectors", "seed",
    ),
    "track": (
        "output", "log", "camera", "prior", "box", "sun", "independent", "integrity_risk", "plan",
        "video",
    ),
    "reflectors": (
        "target", "camera", "output", "group", "mode", "cameras", "blur", "invert", "independent",
        "overlay",
    ),
    "serve": (
        "camera", "target", "source", "fly", "record", "state", "host", "port", "tokens",
        "workers", "models", "check", "settings",
    ),
}  # fmt: skip


class _Command(TyperCommand):
    """A command whose help shows its main options, where those are named."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the options, and how many others there are."""
        main = _MAIN_OPTIONS.get(str(self.name))
        options: list[Any] = [p for p in self.params if p.param_type_name == "option"]
        others: list[Any] = (
            [] if main is None else [p for p in options if p.name not in main and not p.hidden]
        )
        for option in others:
            option.hidden = True
        super().format_options(ctx, formatter)
        for option in others:
            option.hidden = False
        if others:
            formatter.write(f"\n{len(others)} more options: --help-all\n")


def make_app(called: str | None, *, everything: bool = False) -> typer.Typer:
    """The application with the command that is called, and a line for each of the others.

    Args:
        called: name of the command.
        everything: its help shows all options.

    Raises:
        RendezviewError: the command's packages are not installed.
    """
    app = typer.Typer(
        help="Where a spacecraft is relative to another one, from a single camera and a CAD model.",
        no_args_is_help=True,
        add_completion=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        context_settings={"help_option_names": ["-h", "--help"]},  # of all commands below
    )
    app.callback()(_root)
    points = {point.name: point for point in metadata.entry_points(group=GROUP)}
    for name in sorted(points, key=_place):
        command = _load(points[name]) if name == called else _nothing
        if isinstance(command, typer.Typer):  # a command with commands of its own
            app.add_typer(command, name=name)
        else:
            other = f"A command of {points[name].module}."  # of another package
            summary = _SUMMARIES.get(name, other) if command is _nothing else None
            kind = TyperCommand if everything else _Command
            app.command(name, cls=kind, help=summary)(command)
    return app


def _place(name: str) -> tuple[int, str]:
    names = list(_SUMMARIES)
    return (names.index(name) if name in names else len(names), name)


def _load(point: metadata.EntryPoint) -> Callable[..., Any] | typer.Typer:
    who = f"`rendezview {point.name}` belongs to the ground side and"
    with optional(who, "training", " is not installed"):
        command: Callable[..., Any] | typer.Typer = point.load()
    return command


def _called(arguments: Sequence[str]) -> str | None:
    """The command of a command line; of the one that a shell wants completed."""
    words = os.environ.get("_TYPER_COMPLETE_ARGS")
    if words is not None:
        arguments = words.split()[1:]
    return next((word for word in arguments if not word.startswith("-")), None)


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


@contextlib.contextmanager
def _ended_as_by_ctrl_c() -> Iterator[None]:
    """SIGTERM, as of ``timeout`` and batch systems, ends as Ctrl-C does: what is done is kept."""
    own = os.getpid()

    def end(number: int, frame: FrameType | None) -> None:
        if os.getpid() == own:
            raise KeyboardInterrupt
        signal.signal(number, signal.SIG_DFL)  # a process that was forked
        signal.raise_signal(number)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def main() -> None:
    """Run a command: exit 0; 1 for what the user can fix, in one line; 2 for usage."""
    arguments = sys.argv[1:]
    if arguments[:1] == ["--version"]:
        print(f"rendezview {metadata.version('rendezview')}")
        return
    tell_of_other_opencv()
    try:
        everything = _EVERYTHING in arguments
        sys.argv[1:] = ["--help" if word == _EVERYTHING else word for word in arguments]
        app = make_app(_called(arguments), everything=everything)
        if "numba" in sys.modules:  # of the command that is called
            from rendezview.cli.compiling import tell_of_compiling

            tell_of_compiling()
        with _ended_as_by_ctrl_c():
            app()
    except RendezviewError as error:
        print(f"rendezview: {error}", file=sys.stderr)
        sys.exit(1)
    except RuntimeError as error:
        words = without_cache(error)
        if words is None:
            raise
        print(f"rendezview: {words}", file=sys.stderr)
        sys.exit(1)
    except AttributeError as error:
        if getattr(error.obj, "__name__", "") != "cv2":
            raise
        print(
            f"rendezview: another package has changed OpenCV's files ({error}): "
            "pip install --force-reinstall opencv-python-headless",
            file=sys.stderr,
        )
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
