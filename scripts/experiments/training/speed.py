"""Time and memory of training, each run in a process of its own."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from rendezview.training.mesh import Mesh, load_mesh
from rendezview.training.options import TrainingOptions

from experiments.frame import show, table_of
from rendezview.io.target import Target

TRIANGLES = 200_000
Kind = Literal["paper", "trees", "default", "many"]


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


def train_here(target: Path, kind: str, unit: str | None) -> None:
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


def measured(target: Path, kind: str, unit: str | None, cache: Path) -> tuple[str, ...]:
    """Seconds, peak megabytes and triangles of a training in a process of its own."""
    words = ["training-speed", str(target), "--child", kind, *(["--unit", unit] if unit else [])]
    done = subprocess.run(
        [sys.executable, "-m", "experiments", *words],
        env=os.environ | {"NUMBA_CACHE_DIR": str(cache)},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return tuple(done.stdout.split())


def run(
    target: Annotated[Path, "target.toml, its folder, or a mesh"],
    *, unit: Annotated[str | None, "of a bare mesh"] = None,
    child: Annotated[Kind | None, "one of them, in this process"] = None,
) -> None:  # fmt: skip
    """Time and memory of training, each run in a process of its own.

    The paper's views with a cold and a warm compiler, the robust trees, the default with what
    refinement needs, and the paper's views of the same mesh with its triangles split until there
    are 200,000.
    """
    if child:
        train_here(target, child, unit)
        return
    title = f"training {target}, order 3, {os.cpu_count()} cores"
    rows = table_of(title, ("views", "triangles", "seconds", "peak MB"))
    with tempfile.TemporaryDirectory() as folder:
        for name, kind in (
            ("the paper's, cold compiler", "paper"),
            ("the paper's, warm", "paper"),
            ("robust trees only, warm", "trees"),
            ("default, refinement too, warm", "default"),
            ("the paper's, triangles split", "many"),
        ):
            seconds, peak, triangles = measured(target, kind, unit, Path(folder))
            rows.add_row(name, triangles, seconds, peak)
    show(rows, width=100)
