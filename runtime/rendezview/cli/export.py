"""``rendezview export``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from rendezview.errors import RendezviewError
from rendezview.export import write_c, write_onnx
from rendezview.io.files import atomic_write_text
from rendezview.io.trajectories import TimedPose, kitti_text, poses_of_log, tum_text
from rendezview.sensors.appearance import ViewModel


def export(
    model: Annotated[
        Path, typer.Argument(help="Model file (*.rvm); for --tum and --kitti a log of poses.")
    ],
    listing: Annotated[
        bool, typer.Option("--listing", help="The trees as the paper's figure 5 prints them.")
    ] = False,
    rules: Annotated[
        bool, typer.Option("--rules", help="The trees as if-then-else rules.")
    ] = False,
    c: Annotated[
        Path | None, typer.Option("--c", help="Folder for flight code: C99, see README.md there.")
    ] = None,
    onnx: Annotated[
        Path | None, typer.Option("--onnx", help="File for the trees as an ONNX graph.")
    ] = None,
    tum: Annotated[
        Path | None, typer.Option(help="File for a log's path: time x y z qx qy qz qw.")
    ] = None,
    kitti: Annotated[
        Path | None, typer.Option(help="File for a log's path: [R t] row by row, without times.")
    ] = None,
    node: Annotated[
        list[int] | None,
        typer.Option(help="Only this node, of a listing or rules; may be given again."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="File for a listing or rules instead of the screen."),
    ] = None,
) -> None:
    """Print a model's decision trees, write them as flight code, or a log's path for evo.

    In a listing `2 #156 <= 455` is level, bin and threshold in thousandths of the square
    root of the silhouette's area; `T 1` recognises the view, `T 0` does not.

    Example: rendezview export hubble.rvm --c flight
    """
    files = {"--c": c, "--onnx": onnx, "--tum": tum, "--kitti": kitti}
    if listing + rules + sum(place is not None for place in files.values()) != 1:
        raise RendezviewError(
            "choose what to export: of a model one of --listing, --rules, --c DIR and --onnx FILE, "
            "of a log --tum FILE or --kitti FILE"
        )
    if not (listing or rules) and (node or output):
        raise RendezviewError("--node and --output go with --listing or --rules")
    place = tum or kitti
    if place is not None:
        _write_path(model, place, kitti_text if tum is None else tum_text)
        return
    loaded = ViewModel.load(model)
    if c is not None:
        written = write_c(loaded, c)
        typer.echo(f"{c}: {len(written)} files, start with README.md", err=True)
    elif onnx is not None:
        write_onnx(loaded, onnx)
        typer.echo(f"{onnx}: {len(loaded.forest)} trees", err=True)
    else:
        _print(loaded, listing, node, output)


def _write_path(log: Path, place: Path, text: Callable[[list[TimedPose]], str]) -> None:
    timed, empty = poses_of_log(log)
    atomic_write_text(place, text(timed))
    typer.echo(
        f"{place}: camera in the target's frame, {len(timed)} poses; {empty} frames have none",
        err=True,
    )


def _print(model: ViewModel, listing: bool, node: list[int] | None, output: Path | None) -> None:
    forest = model.forest
    nodes = node if node else range(len(forest))
    parts = []
    for k in nodes:
        if not 0 <= k < len(forest):
            raise RendezviewError(f"there is no node {k}: the sphere has 0 … {len(forest) - 1}")
        x, y, z = model.geodesic.nodes[k]
        parts.append(f"Node {k}  direction {x:+.4f} {y:+.4f} {z:+.4f}")
        parts.append(forest.listing(k) if listing else forest.rules(k, "r{}"))
        parts.append("")
    text = "\n".join(parts)
    if output:
        atomic_write_text(output, text)
    else:
        typer.echo(text)
