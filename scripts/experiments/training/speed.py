"""Time and memory of training, each run in a process of its own.

    python -m experiments training-speed models_cad/hubble

The paper's views with a cold and a warm compiler, the robust trees, the default with what
refinement needs, and the paper's views of the same mesh with its triangles split until there
are 200,000.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from rendezview.io.target import Target
from rendezview.training.mesh import Mesh, load_mesh
from rendezview.training.options import TrainingOptions

TRIANGLES = 200_000


def split(mesh: Mesh, least: int) -> Mesh:
    """The same shape with each triangle cut in four until there are enough, cut to that number."""
    vertices, faces, rgb = mesh.vertices_m, mesh.faces, mesh.face_rgb
    while len(faces) < least:
        corners = vertices[faces]  # (F, 3, 3)
        middles = 0.5 * (corners + np.roll(corners, -1, axis=1))
        points = np.concatenate([corners, middles], axis=1).reshape(-1, 3)
        base = 6 * np.arange(len(faces), dtype=np.int32)[:, None]
        four = [[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]]
        faces = np.concatenate([base + np.array(f, dtype=np.int32) for f in four])
        vertices, rgb = points, np.concatenate([rgb] * 4)
    return replace(mesh, vertices_m=vertices, faces=faces, face_rgb=rgb)


def child(target: Path, kind: str, unit: str | None) -> None:
    """One training; prints seconds and peak megabytes."""
    found = Target.load(target)
    mesh = load_mesh(found.mesh_path, unit or found.unit)
    options = TrainingOptions()
    if kind == "trees":
        options = replace(options, contour_points=0, shadowed_silhouettes=False)
    elif kind != "default":
        options = replace(options.paper(), held_out_views=0)
    if kind == "many":
        mesh = split(mesh, TRIANGLES)
    start = time.perf_counter()
    from rendezview.training.job import train

    with tempfile.TemporaryDirectory() as folder:
        train(mesh, Path(folder) / "model.rvm", name=found.name, options=options)
    seconds = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    print(f"{seconds:.1f} {peak:.0f} {len(mesh.faces)}")


def run(target: Path, kind: str, unit: str | None, cache: Path | None) -> tuple[str, ...]:
    environment = dict(os.environ)
    if cache is not None:
        environment["NUMBA_CACHE_DIR"] = str(cache)
    arguments = [
        sys.executable,
        "-m",
        "experiments",
        "training-speed",
        str(target),
        "--child",
        kind,
    ]
    if unit:
        arguments += ["--unit", unit]
    done = subprocess.run(arguments, env=environment, capture_output=True, text=True, check=True)
    return tuple(done.stdout.split())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("target", type=Path, help="target.toml, its folder, or a mesh")
    parser.add_argument("--unit", help="unit of a bare mesh")
    parser.add_argument(
        "--child", choices=["paper", "trees", "default", "many"], help=argparse.SUPPRESS
    )
    arguments = parser.parse_args()
    if arguments.child:
        child(arguments.target, arguments.child, arguments.unit)
        return
    table = Table(title=f"training {arguments.target}, order 3, {os.cpu_count()} cores")
    for column in ("views", "triangles", "seconds", "peak MB"):
        table.add_column(column, justify="left" if column == "views" else "right")
    with tempfile.TemporaryDirectory() as folder:
        cache = Path(folder)
        for name, kind, where in (
            ("the paper's, cold compiler", "paper", cache),
            ("the paper's, warm", "paper", cache),
            ("robust trees only, warm", "trees", cache),
            ("default, refinement too, warm", "default", cache),
            ("the paper's, triangles split", "many", cache),
        ):
            seconds, peak, triangles = run(arguments.target, kind, arguments.unit, where)
            table.add_row(name, triangles, seconds, peak)
    Console(width=100).print(table)
