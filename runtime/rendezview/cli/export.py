"""``rendezview export``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rendezview.appearance import ViewModel
from rendezview.errors import RendezviewError
from rendezview.files import atomic_write_text


def export(
    model: Annotated[Path, typer.Argument(help="Model file (*.rvm).")],
    listing: Annotated[
        bool, typer.Option("--listing", help="The trees as the paper's figure 5 prints them.")
    ] = False,
    rules: Annotated[
        bool, typer.Option("--rules", help="The trees as if-then-else rules.")
    ] = False,
    node: Annotated[
        list[int] | None, typer.Option(help="Only this node; may be given again.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="File to write instead of the screen.")
    ] = None,
) -> None:
    """Print a model's decision trees.

    In a listing `2 #156 <= 455` is level, bin and threshold in thousandths of the square
    root of the silhouette's area; `T 1` recognises the view, `T 0` does not.

    Example: rendezview export hubble.rvm --listing --node 17
    """
    if listing == rules:
        raise RendezviewError("say how to print the trees: --listing or --rules")
    loaded = ViewModel.load(model)
    forest = loaded.forest
    nodes = node if node else range(len(forest))
    parts = []
    for k in nodes:
        if not 0 <= k < len(forest):
            raise RendezviewError(f"there is no node {k}: the sphere has 0 … {len(forest) - 1}")
        x, y, z = loaded.geodesic.nodes[k]
        parts.append(f"Node {k}  direction {x:+.4f} {y:+.4f} {z:+.4f}")
        parts.append(forest.listing(k) if listing else forest.rules(k, "r{}"))
        parts.append("")
    text = "\n".join(parts)
    if output:
        atomic_write_text(output, text)
    else:
        typer.echo(text)
