"""``rendezview doctor``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from rendezview.cli.progress import ProgressBar, say
from rendezview.errors import RendezviewError
from rendezview.io.bundled import find_target
from rendezview.io.camera_files import load_camera
from rendezview.io.files import atomic_write, check_place
from rendezview.io.sequences import open_sequence
from rendezview_ground.evaluate.doctor import Mark, diagnose, of_frames, of_look_alikes
from rendezview_ground.evaluate.pictures.doctor_pictures import doctor_picture
from rendezview_ground.evaluate.pictures.palette import png
from rendezview_ground.mesh.mesh import load_mesh

_SIGNS = {Mark.FINE: "[green]fine[/]", Mark.NOTE: "[cyan]note[/]", Mark.ACT: "[bold red]act[/]"}


def doctor(
    target: Annotated[
        str,
        typer.Argument(
            help="Mesh, FILE#NODE for a node of a scene, target.toml or its folder, or hubble, "
            "client, scole, shuttle."
        ),
    ],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Picture; default NAME-doctor.png.")
    ] = None,
    unit: Annotated[
        str | None, typer.Option(help="Unit of the mesh: m, cm, mm, in, ft; overrides the file.")
    ] = None,
    frames: Annotated[
        Path | None, typer.Option(help="Frames to question too, with their times and camera.")
    ] = None,
    camera: Annotated[Path | None, typer.Option(help="Camera file of the frames.")] = None,
) -> None:
    """Say what is wrong with a mesh, what is done about it, and what it costs in accuracy.

    \b
    Example: rendezview doctor mysat.stl --unit mm
    """
    found = find_target(target)
    place = output or Path(f"{found.name}-doctor.png")
    check_place(place, "the picture")
    mesh = load_mesh(found.mesh_path, unit or found.unit)
    with ProgressBar() as bar:
        progress = bar.stage("views", 42)
        diagnosis = diagnose(mesh, lambda done, _: progress(done))
    table = Table("", "finding", "what is done", "what it costs", show_lines=True)
    findings = (*diagnosis.findings, *of_look_alikes(mesh, diagnosis.symmetries))
    if frames is not None:
        seen_by = load_camera(camera) if camera else None
        findings = (*findings, *of_frames(open_sequence(frames, seen_by)))
    elif camera is not None:
        raise RendezviewError("--camera is that of --frames: give them too")
    for finding in findings:
        table.add_row(_SIGNS[finding.mark], finding.what, finding.done, finding.cost)
    Console().print(table)
    with atomic_write(place, durable=False) as file:
        file.write(png(doctor_picture(diagnosis, f"{found.name}: {mesh.notes[0]}")))
    healthy = all(finding.mark is not Mark.ACT for finding in findings)
    advice = (
        "nothing needs to be done; after training, `rendezview assess` says how accurate it is"
        if healthy
        else "see the lines marked act"
    )
    say(f"{place}: {advice}")
