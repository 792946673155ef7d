"""``rendezview fly``."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from rendezview.cli.progress import ProgressBar
from rendezview.io.bundled import find_target
from rendezview.io.file_lock import FolderLock
from rendezview.io.files import make_folder
from rendezview.io.results import read_json_lines
from rendezview.io.video_file import VideoWriter
from rendezview.sensors.appearance import ViewModel
from rendezview_ground.fly.campaign import agreement, campaign, fly_once, record
from rendezview_ground.fly.faults import FAULTS, Fault
from rendezview_ground.fly.live import fly_live
from rendezview_ground.fly.loop import Flight
from rendezview_ground.fly.options import load_fly_plan
from rendezview_ground.fly.report import (
    FILM,
    replay_folder,
    replayed,
    write_campaign_page,
    write_flight_page,
)
from rendezview_ground.fly.setup import Setup
from rendezview_ground.learn.command_options import Dask, Jobs
from rendezview_ground.learn.jobs.open_executor import open_executor
from rendezview_ground.learn.target_job import train_target
from rendezview_ground.mesh.mesh import load_mesh
from rendezview_service.client import Client

_FILM_HZ = 10.0  # twenty times as fast as the flight. Source: chosen to be watchable


class Frames(StrEnum):
    """Where the readings of camera, ring and reflectors come from."""

    MODELLED = "modelled"
    RENDERED = "rendered"


def fly(
    target: Annotated[str, typer.Argument(help="Mesh, target.toml, or bundled name.")],
    plan: Annotated[Path | None, typer.Option(help="Numbers that differ, plan.toml.")] = None,
    frames: Annotated[
        Frames,
        typer.Option(help="Readings by measured error tables, or by the sensors on pictures."),
    ] = Frames.MODELLED,
    model: Annotated[
        Path | None, typer.Option(help="Of rendered frames; default: trained into the folder.")
    ] = None,
    runs: Annotated[int, typer.Option(min=1, help="Flights, of rising seeds.")] = 1,
    faults: Annotated[
        str, typer.Option(help=f"all, or some of {', '.join(FAULTS)}, with commas.")
    ] = "",
    every: Annotated[
        int, typer.Option(min=1, help="Of several flights, one in so many has a fault.")
    ] = 10,
    beside: Annotated[
        Path | None, typer.Option(help="runs.jsonl of others, whose contacts are compared.")
    ] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder of the results.")] = Path(
        "rendezview-fly"
    ),
    unit: Annotated[str | None, typer.Option(help="Unit of a bare mesh.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of everything random.")] = 0,
    live: Annotated[
        str | None,
        typer.Option(
            help="Address of a service that tracks its frames, as http://127.0.0.1:8360; silent "
            "for 30 s, it is an error."
        ),
    ] = None,
    token: Annotated[
        str | None, typer.Option(envvar="RENDEZVIEW_TOKEN", help="Of that service.")
    ] = None,
    speed: Annotated[
        float, typer.Option(min=0.0, help="Of a live flight; 0: as fast as it goes.")
    ] = 1.0,
    jobs: Jobs = 1,
    dask: Dask = None,
) -> None:
    """Fly to a target's port in a closed loop, from 60 m to contact, and report.

    Example: rendezview fly client -o flight
    """
    console = Console(stderr=True, highlight=False, soft_wrap=True)
    start, options = time.perf_counter(), load_fly_plan(plan)
    found = find_target(target)
    mesh = load_mesh(found.mesh_path, unit or found.unit)
    kinds = FAULTS if faults == "all" else tuple(filter(None, faults.split(",")))
    drawn = [Fault.drawn(kind, seed) for kind in kinds]  # an unknown one is an error now
    checked = Setup.of(found, mesh, options)
    port = checked.port  # so is a target without a port
    checked.stereo_pair()  # and so are lights that give no pose
    others = None if beside is None else read_json_lines(beside)
    make_folder(output)
    views = None
    with FolderLock(output), ProgressBar() as progress:
        if frames is Frames.RENDERED and live is None:
            path = model or output / f"{found.name}.rvm"
            if not path.exists() and model is None:
                console.print(f"Training {found.name} …")
                craft, seen = replace(found, docking_ring=port.ring), port.circle(mesh)
                train_target(craft, mesh, path, unit, port=seen, progress=progress)
            views = ViewModel.load(path)
        setup = Setup.of(found, mesh, options, views)
        if runs == 1 or live is not None:
            fault = drawn[0] if drawn else None
            if live is not None:
                with Client(live, token) as client:
                    flight = fly_live(setup, client, seed, fault, speed)
                page = write_flight_page(output, found.name, setup, flight, seed, fault, live)
            else:
                page, flight = _one(output, found.name, setup, seed, fault)
            Console(highlight=False, soft_wrap=True).print(_words(record(flight, seed, fault)))
        else:
            with open_executor(jobs, dask, processes=True, tell=console.print) as executor:
                lines = campaign(
                    setup, output / "runs.jsonl", runs, seed, kinds, every, executor, progress
                )
            for line in replayed(lines, setup):
                kind, name = line["fault"], replay_folder(line)
                again = None if kind is None else Fault.drawn(kind, line["seed"])
                _one(output / name, found.name, setup, line["seed"], again)
            page = write_campaign_page(output, found.name, setup, lines, others)
            Console(highlight=False, soft_wrap=True).print(_table(lines))
            for key, some, other, p in agreement(lines, others or []):
                console.print(f"{key}: p {p:.2g}, {some} beside {other} contacts")
    console.print(f"{page}, in {time.perf_counter() - start:.0f} s")


def _one(
    folder: Path, name: str, setup: Setup, seed: int, fault: Fault | None
) -> tuple[Path, Flight]:
    """Fly once; the page of the flight, and the flight."""
    make_folder(folder)
    with VideoWriter(folder / FILM, _FILM_HZ) as film:  # without frames: no file
        flight = fly_once(setup, seed, fault, film)
    return write_flight_page(folder, name, setup, flight, seed, fault), flight


def _words(line: dict[str, Any]) -> str:
    """One flight in words."""
    told = f"{line['end']} after {line['time_s']:.0f} s, {line['spent_m_s']:.2f} m/s of thrust"
    if line["outside"]:
        told += f", outside: {line['outside']}"
    touch = line["contact"]
    if touch is None:
        return f"{told}; {line['reason']}"
    return (
        f"{told}; lateral {1e3 * touch['lateral_m']:.0f} mm, tilt "
        f"{math.degrees(touch['tilt_rad']):.2f}°, closing {touch['closing_m_s']:.3f} m/s"
    )


def _table(lines: list[dict[str, Any]]) -> str:
    """How the flights ended, by fault."""
    ends = ("contact", "outside", "held", "aborted")
    rows = [f"{'fault':12}{'flights':>8}" + "".join(f"{end:>9}" for end in ends)]
    for kind in [None, *sorted({line["fault"] for line in lines if line["fault"]})]:
        some = [line for line in lines if line["fault"] == kind]
        counts = [sum(line["end"] == end for line in some) for end in ends]
        rows.append(f"{kind or 'none':12}{len(some):>8}" + "".join(f"{n:>9}" for n in counts))
    beyond, steps = (sum(line[key] for line in lines) for key in ("beyond", "steps"))
    return "\n".join([*rows, f"beyond the protection level unalarmed: {beyond} of {steps} steps"])
