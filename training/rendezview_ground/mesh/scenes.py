"""Scenes of several nodes, and STEP files as triangles."""

from __future__ import annotations

import contextlib
import fnmatch
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from rendezview.errors import RendezviewError, optional
from rendezview_ground.mesh.notes import counted

_CHORD_MM = 0.5  # of triangles from the true surface of a STEP part. Source: below 0.01 % of 10 m
_ANGLE_RAD = 0.2  # between neighbouring triangles of a curved surface. Source: 31 to a circle
_MOST_NAMED = 12  # nodes in a message. Source: fits a line


def nodes_below(graph: Any, name: str | None, path: Path) -> set[str] | None:
    """A node of trimesh's scene graph and all below it; None if no node was named.

    ``*`` and ``?`` in the name stand for other characters, as in file names.

    Raises:
        RendezviewError: there is no such node; the message lists those that there are.
    """
    if name is None:
        return None
    children: dict[str, list[str]] = {}
    for parent, child, _ in graph.to_edgelist():
        children.setdefault(str(parent), []).append(str(child))
    known = {str(node) for node in graph.nodes}
    matching = [name] if name in known else fnmatch.filter(sorted(known), name)
    if not matching:
        names = sorted(known - {str(graph.base_frame)})
        raise no_such_node(path, name, "the scene has no node", names)
    found, waiting = set(), matching
    while waiting:
        node = waiting.pop()
        found.add(node)
        waiting += [child for child in children.get(node, []) if child not in found]
    return found


def no_such_node(path: Path, name: str, words: str, names: list[str]) -> RendezviewError:
    """The error that lists the nodes that there are."""
    listed = ", ".join(names[:_MOST_NAMED]) + (" …" if len(names) > _MOST_NAMED else "")
    return RendezviewError(f"{path}#{name}: {words} {name!r}; it has {listed}")


OR_EXPORT = ", or export the mesh as GLB"  # what a file needs whose reader is missing


def triangulate_step(path: Path, output: Path) -> int:
    """Write a STEP file as GLB, metres, by OpenCASCADE; the number of bytes written.

    Raises:
        RendezviewError: the reader is not installed, or cannot read the file.
    """
    with optional(f"{path}: STEP files need", "step", instead=OR_EXPORT):
        import cascadio
    with _quiet_descriptors():
        status = cascadio.step_to_glb(
            str(path), str(output), tol_linear=_CHORD_MM, tol_angular=_ANGLE_RAD,
            include_materials=True,
        )  # fmt: skip
    if status != 0 or not output.is_file() or output.stat().st_size == 0:
        raise RendezviewError(
            f"{path} cannot be read as STEP: the file is damaged, cut short or of another format; "
            "export it again as AP203, AP214 or AP242"
        )
    return output.stat().st_size


@contextlib.contextmanager
def _quiet_descriptors() -> Iterator[None]:
    """Keep what a library writes to the process's own output off the terminal."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = os.dup(1), os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
        yield
    finally:
        for place, old in enumerate(kept, start=1):
            os.dup2(old, place)
            os.close(old)
        os.close(nowhere)


def step_note(size: int, faces: NDArray[Any]) -> str:
    """What became of a STEP file."""
    return (
        f"STEP surfaces as {counted(len(faces), 'triangle')} ({size / 1e6:.1f} MB), within "
        f"{_CHORD_MM:g} mm and {_ANGLE_RAD:g} rad of the curved ones."
    )
