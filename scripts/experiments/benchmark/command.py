"""Measures every figure of the README, beside its peers and floors, in one run."""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
import os
import sys
import time
from pathlib import Path
from typing import Annotated

import cv2
from threadpoolctl import threadpool_limits

from experiments.benchmark.appearance import flight_code, poses
from experiments.benchmark.check import ALLOWED, Bench, Row, best, worse
from experiments.benchmark.check import write as write_rows
from experiments.benchmark.estimation import fusion, segments, three_points
from experiments.benchmark.history import history_table, kept_ratios
from experiments.benchmark.sensors import reflectors, rings, stereo
from experiments.flight_code.check import driver
from experiments.frame import mesh_of, show, table_of
from rendezview import TrainingOptions, find_target
from rendezview.sensors import appearance
from rendezview_ground.learn.job import train

CACHE = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "rendezview-benchmark"
AGAIN = 4  # passes at most
SIZE, SHORT_SIZE = (6, 1000, 1.5), (3, 200, 0.6)  # frames, problems, seconds of a race
SMALL = TrainingOptions(
    order=2, resolution_px=256, perturbed_views=1200, held_out_views=50, contour_points=120,
    contour_radii=(1.0,), contour_resolution_px=400, shadowed_silhouettes=False,
)  # fmt: skip


def small_path() -> Path:
    """Of the short form's model; another one when options, mesh or sources have changed."""
    found = find_target("hubble")
    digest = hashlib.sha256(repr(SMALL).encode() + found.mesh_path.read_bytes())
    for source in (inspect.getfile(train), appearance.__file__):
        for path in sorted(Path(str(source)).parent.rglob("*.py")):
            digest.update(path.read_bytes())
    return CACHE / f"hubble-{digest.hexdigest()[:16]}.rvm"


def show_rows(rows: list[Row]) -> None:
    """Print the comparisons."""
    title = "less is better; ratio = ours / beside"
    table = table_of(title, "what | ours | beside | peer or floor | ratio | more in")
    for row in rows:
        mine, peer, unit = row.shown()
        table.add_row(
            row.name, f"{mine:.3g} {unit}", f"{peer:.3g} {unit}", row.beside,
            f"{row.ratio:.3g}", row.command,
        )  # fmt: skip
    show(table, width=170)


def measured(bench: Bench, passes: int, kept: Path | None) -> tuple[list[Row], dict[str, str]]:
    """All rows, the best of the passes, and those worse than the kept: these are measured again."""
    everything = [poses, reflectors, three_points, rings, stereo, fusion, segments]
    if driver.compiler() is not None:
        everything.append(flight_code)
    rows: dict[str, Row] = {}
    of_group: dict[str, int] = {}
    again = set(range(len(everything)))
    wrong: dict[str, str] = {}
    for turn in range(max(passes, AGAIN if kept else 1)):
        for k in sorted(again):
            found = list(everything[k](bench))
            of_group |= {row.key: k for row in found}
            rows = best([*rows.values(), *found])
        wrong = worse(rows.values(), kept) if kept else {}
        if turn + 1 >= passes:
            again = {of_group[key] for key in wrong if key in of_group}
            if not again:
                break
    return list(rows.values()), wrong


def run(
    *, short: Annotated[bool, "small model, less than a minute"] = False,
    check: Annotated[Path | None, "exit 1 where a ratio is over 1.5 × the kept one"] = None,
    write: Annotated[Path | None, "keep the ratios in a file"] = None,
    history: Annotated[Path | None, "only print the ratios that such a file kept, by day"] = None,
    model: Annotated[Path | None, "default model of hubble; else it is trained"] = None,
    seed: int = 77,
) -> None:  # fmt: skip
    """Everything the README claims, beside its peers and floors.

    Ours and the peers are timed in turns, in processor time; each figure is the least of the
    medians of 15 turns. Less is better everywhere; the ratio is ours over the peer's. --short
    trains a small model of its own once, into ~/.cache.
    """
    if history:
        show(history_table(kept_ratios(history)), width=170)
        return
    start = time.perf_counter()
    cv2.setNumThreads(1)
    name, mesh = mesh_of("hubble")
    path = small_path() if short else model or CACHE / "hubble.rvm"
    if not path.exists():
        CACHE.mkdir(parents=True, exist_ok=True)
        train(mesh, path, name=name, options=SMALL if short else None)
    with threadpool_limits(1):
        bench = Bench(mesh, path, *(SHORT_SIZE if short else SIZE), seed)
        rows, wrong = measured(bench, 3 if write else 1, check)
    show_rows(rows)
    for package in ("poselib", "nlopt"):
        if importlib.util.find_spec(package) is None:
            print(f"absent: {package}: not installed")
    if driver.compiler() is None:
        print("absent: flight code: no C compiler here")
    print(f"seed {seed}; {time.perf_counter() - start:.0f} s")
    if write:
        write_rows(rows, write)
    if check:
        for line in wrong.values():
            print(line, file=sys.stderr)
        print(f"{len(rows)} ratios, {len(wrong)} not within {ALLOWED} × {check}")
        sys.exit(1 if wrong else 0)
