"""``rendezview rrd``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from rendezview.errors import RendezviewError
from rendezview.io.camera_files import load_camera
from rendezview.io.sequences import open_sequence
from rendezview.sensors.appearance import ViewModel
from rendezview_service.viewers.rerun_file import write_rerun
from rendezview_service.viewers.runs import moments


def rrd(
    log: Annotated[
        Path,
        typer.Argument(
            help="Log of a run: JSON lines of track, ring, reflectors, stereo or fuse, or *.mcap "
            "of `rendezview serve`."
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Rerun recording (*.rrd).")],
    scene: Annotated[
        Path | None,
        typer.Option(help="Pictures, camera and truth of the run: what was given to it."),
    ] = None,
    model: Annotated[
        Path | None, typer.Option(help="Model file (*.rvm): points of the target, its contour.")
    ] = None,
    camera: Annotated[
        Path | None, typer.Option(help="Camera file, where the scene has none.")
    ] = None,
) -> None:
    """Convert a run into a recording for the Rerun viewer: `rerun run.rrd` shows it.

    \b
    Example: rendezview rrd log.jsonl -o run.rrd --scene approach --model hubble.rvm
    """
    if scene is not None and log.suffix.lower() == ".mcap":
        raise RendezviewError(f"{log}: holds its own pictures: leave out --scene")
    sequence = None
    if scene is not None:
        sequence = open_sequence(scene, load_camera(camera) if camera else None)
    loaded = ViewModel.load(model) if model else None
    count = write_rerun(output, moments(log, sequence), loaded)
    Console(stderr=True).print(f"{output}: {count} frames", highlight=False, soft_wrap=True)
