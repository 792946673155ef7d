"""Measures every figure of the README, beside its peers and floors, in one run."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import cv2
from rendezview.training.job import train
from rendezview.training.mesh import load_mesh
from rendezview.training.options import TrainingOptions
from rich.table import Table
from threadpoolctl import threadpool_limits

from experiments.benchmark.check import ALLOWED, Row, best, worse
from experiments.benchmark.check import write as write_rows
from experiments.benchmark.rows import Bench, groups
from experiments.flight_code.driver import compiler
from experiments.frame import ROOT, PeerPython, mesh_of, show
from experiments.peers import visp as visp_driver
from rendezview.io.bundled import find_target

CACHE = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "rendezview-benchmark"
AGAIN = 4  # passes at most
SMALL = TrainingOptions(
    order=2,
    resolution_px=256,
    perturbed_views=1200,
    held_out_views=50,
    contour_points=120,
    contour_radii=(1.0,),
    contour_resolution_px=400,
    shadowed_silhouettes=False,
)
LONG = (  # claim, command; {folder}: where the campaign writes and reads
    ("default models of four targets", "rendezview train hubble -o {folder}/hubble.rvm"),
    ("", "rendezview train client -o {folder}/client.rvm"),
    ("", "rendezview train {data}/HST.obj -o {folder}/HST.rvm"),
    ("", "rendezview train {data}/SpaceShuttleOrbiter.obj -o {folder}/SpaceShuttleOrbiter.rvm"),
    ("frames by an independent renderer", "pose-frames {folder}/frames {data}/HST.obj "
     "{data}/SpaceShuttleOrbiter.obj hubble client --count 200 --seed 77"),
    ("tracked 99.9 %, 0.06°, 0.03 %; first pose 98.1 %, wrong 0.2 %",
     "pose-accuracy {folder}/frames {folder}"),
    ("sequences without a loss", "pose-trials sequences {folder} {data}/HST.obj hubble "
     "{data}/SpaceShuttleOrbiter.obj client"),
    ("no pose where there is no target", "pose-trials refusals {folder} {data}/HST.obj hubble "
     "{data}/SpaceShuttleOrbiter.obj client"),
    ("beside ViSP's tracker", "visp-tracking hubble --model {folder}/hubble.rvm"),
    ("", "visp-tracking client --model {folder}/client.rvm"),
    ("a few minutes of training", "training-speed models_cad/hubble"),
    ("active nodes, views", "recognition-accuracy models_cad/hubble --views 2000 --seed 77"),
    ("C identical, 10,000 of 10,000",
     "export-c-check {folder}/hubble.rvm models_cad/hubble --seed 77 --onnx"),
    ("attitude that C needs",
     "flight-code-search {folder}/hubble.rvm models_cad/hubble --frames 400 --seed 77"),
    ("reflectors: accuracy", "reflector-accuracy --frames 150 --seed 21"),
    ("reflectors: a million solves", "reflector-solvers --count 1000000 --seed 11"),
    ("reflectors: acquisition", "reflector-acquisition --frames 2500 --seed 31"),
    ("ring: accuracy", "ring-accuracy --seed 71"),
    ("ring: of unknown size", "ring-flyaround --seed 61"),
    ("stereo: accuracy", "stereo-accuracy --part figure8 --seed 11"),
    ("stereo: calibration", "stereo-calibration --part laboratory --seed 31"),
    ("fusion: approaches",
     "fusion-approach {folder}/runs --model {folder}/client.rvm --seeds 50"),
    ("fusion: faults", "fusion-faults {folder}/runs --seeds 20"),
    ("paths from frames", "trajectory-frames {folder}/observations {folder}/client.rvm client "
     "circular spiral vbar spin tumble"),
    ("paths: accuracy", "trajectory-accuracy {folder}/observations"),
    ("closed loop", "closed-loop {folder}/client.rvm client --seeds 0 20"),
    ("many workers", "scale-out speed --model {folder}/hubble.rvm"),
    ("a worker killed", "scale-out kill"),
)  # fmt: skip


def small_model(cache: Path) -> Path:
    """The short form's model; trained again when options, mesh or sources have changed."""
    found = find_target("hubble")
    digest = hashlib.sha256(repr(SMALL).encode() + found.mesh_path.read_bytes())
    for folder in ("training/rendezview/training", "runtime/rendezview/sensors/appearance"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            digest.update(path.read_bytes())
    path = cache / f"hubble-{digest.hexdigest()[:16]}.rvm"
    if not path.exists():
        cache.mkdir(parents=True, exist_ok=True)
        start = time.perf_counter()
        mesh = load_mesh(found.mesh_path, found.unit)
        train(mesh, path, name="hubble", options=SMALL)
        print(f"small model trained in {time.perf_counter() - start:.0f} s: {path}")
    return path


def absent(peer_python: Path | None, short: bool) -> Iterator[str]:
    """A line for every peer that is not in this run, and why."""
    if peer_python is None:
        yield "linemod, EdgeDrawing, findEllipses: in opencv-contrib only; give --peer-python"
    for package in ("poselib", "nlopt"):
        if importlib.util.find_spec(package) is None:
            yield f"{package}: not installed"
    if compiler() is None:
        yield "flight code: no C compiler here"
    if short:
        yield "ViSP: not in the short form"
    elif visp_driver.missing() is not None:
        yield f"ViSP: {visp_driver.missing()}"


def show_rows(rows: list[Row]) -> None:
    """Print the comparisons."""
    columns = ("what", "ours", "beside", "peer or floor", "ratio", "at length")
    table = Table(title="less is better; ratio = ours / beside")
    for name in columns:
        table.add_column(name, justify="right" if name in ("ours", "beside", "ratio") else "left")
    for row in rows:
        mine, peer, unit = row.shown()
        table.add_row(
            row.name, f"{mine:.3g} {unit}", f"{peer:.3g} {unit}", row.beside,
            f"{row.ratio:.3g}", row.command,
        )  # fmt: skip
    show(table, width=170)


def draw(rows: list[Row], path: Path) -> None:
    """Bars of the ratios on a logarithmic scale, ours better to the left."""
    from matplotlib.figure import Figure

    drawn = [row for row in rows if row.unit in ("s", "°") and 0.0 < row.ratio < 1e6]
    figure = Figure(figsize=(9.0, 0.24 * len(drawn) + 1.0), layout="constrained")
    axes = figure.subplots()
    for k, row in enumerate(drawn):
        axes.barh(k, row.ratio - 1.0, left=1.0, color="#3b7dd8" if row.ratio <= 1 else "#d9822b")
        axes.annotate(
            f"{row.ratio:.2g}", (row.ratio, k), (4 if row.ratio > 1 else -4, 0),
            textcoords="offset points", va="center", fontsize=7,
            ha="left" if row.ratio > 1 else "right",
        )  # fmt: skip
    axes.set_xscale("log")
    axes.set_xlim(0.15 * min(r.ratio for r in drawn), 2.5 * max(r.ratio for r in drawn))
    axes.axvline(1.0, color="black", linewidth=0.8)
    labels = [f"{row.name}  |  {row.beside}" for row in drawn]
    axes.set_yticks(range(len(drawn)), labels, fontsize=7)
    axes.invert_yaxis()
    axes.set_xlabel("ours / beside: time, or error in degrees (left of 1: ours is better)")
    figure.savefig(path, dpi=110)


def campaigns(folder: str) -> int:
    """Print the long campaigns, or run them one after the other; the number that failed."""
    data = os.environ.get("RENDEZVIEW_TEST_DATA", "DATA") + "/meshes_42"
    failed = 0
    for k, (claim, words) in enumerate(LONG):
        command = words.format(folder=folder or "FOLDER", data=data)
        ours = command.startswith("rendezview")
        full = command if ours else f"python -m experiments {command}"
        print(f"{full}" + (f"    # {claim}" if claim else ""), flush=True)
        if not folder:
            continue
        Path(folder).mkdir(parents=True, exist_ok=True)
        arguments = shlex.split(command)
        program = (
            [str(Path(sys.executable).with_name(arguments[0]))]
            if ours
            else [sys.executable, "-m", "experiments", arguments[0]]
        )
        start = time.perf_counter()
        with (Path(folder) / f"{k:02d}_{arguments[0]}.txt").open("w") as out:
            done = subprocess.run(
                [*program, *arguments[1:]], cwd=ROOT, stdout=out, stderr=out, check=False
            )
        failed += done.returncode != 0
        print(
            f"  exit {done.returncode}, {time.perf_counter() - start:.0f} s, {out.name}", flush=True
        )
    return failed


def measured(
    bench: Bench, passes: int, kept: Path | None, short: bool
) -> tuple[list[Row], dict[str, str]]:
    """All rows, the best of the passes, and the rows that are worse than the kept ones.

    Groups with a row that is worse are measured again: noise disappears, a real slowdown stays.
    """
    everything = groups(short)
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
    figure: Annotated[Path | None, "PNG of the ratios"] = None,
    long: Annotated[
        str | None, "print the long campaigns, or run them in a folder", {"nargs": "?", "const": ""}
    ] = None,
    model: Annotated[Path | None, "default model of hubble; else it is trained"] = None,
    peer_python: PeerPython = None, seed: int = 77, cache: Path = CACHE,
) -> None:  # fmt: skip
    """Everything the README claims, beside its peers and floors.

    Ours and the peers are timed in turns, in processor time; each figure is the least of the
    medians of 15 turns. Less is better everywhere; the ratio is ours over the peer's. --short
    trains a small model of its own once, into --cache. linemod and EdgeDrawing need --peer-python,
    ViSP needs a C++ compiler and ``apt install g++ pkg-config libvisp-mbt-dev``.
    """
    if long is not None:
        sys.exit(1 if campaigns(str(Path(long).resolve()) if long else "") else 0)
    start = time.perf_counter()
    cv2.setNumThreads(1)
    name, mesh = mesh_of("hubble")
    if short:
        path, peers = small_model(cache), None
    else:
        path, peers = model or cache / "hubble.rvm", peer_python
        if not path.exists():
            cache.mkdir(parents=True, exist_ok=True)
            train(mesh, path, name=name)
    frames, problems, seconds = (3, 200, 0.6) if short else (6, 1000, 1.5)
    with threadpool_limits(1):
        bench = Bench(mesh, path, frames, problems, seconds, seed, peers)
        rows, wrong = measured(bench, 3 if write else 1, check, short)
    show_rows(rows)
    for line in absent(peers, short):
        print(f"absent: {line}")
    size, spent = path.stat().st_size / 1e6, time.perf_counter() - start
    print(f"seed {seed}; model {size:.1f} MB; {spent:.0f} s")
    if figure:
        draw(rows, figure)
    if write:
        write_rows(rows, write)
    if check:
        for line in wrong.values():
            print(line, file=sys.stderr)
        print(f"{len(rows)} ratios, {len(wrong)} not within {ALLOWED} × {check}")
        sys.exit(1 if wrong else 0)
