"""``rendezview fuse``."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from rendezview.cli.inputs import check_positive
from rendezview.cli.progress import ProgressBar, outcome_words, say
from rendezview.errors import RendezviewError
from rendezview.fusion import Fusion, FusionOptions
from rendezview.fusion.logs import (
    LogContext,
    merged,
    read_log,
    read_mount,
    read_options,
    read_surfaces,
    sensor_name,
    state_record,
)
from rendezview.geometry.pose import Pose
from rendezview.io.bundled import find_target
from rendezview.io.files import check_place
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.beam import BeamMesh, BeamSurface
from rendezview.sensors.observation import Status
from rendezview.sensors.run import Line, Summary, run

_MOST_TICKS = 1_000_000  # of --every-s. Source: a chosen limit, a few GB


def fuse(
    logs: Annotated[
        list[str],
        typer.Argument(
            help="Logs (JSON lines) of track, reflectors, stereo, ring, or a laser ranger; "
            "[NAME=]PATH, the name being the file's where not given."
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="The state, JSON lines.")],
    target: Annotated[
        str | None,
        typer.Option(
            help="Target file with a docking ring, or client: the place of rings and ranges."
        ),
    ] = None,
    mount: Annotated[
        list[str] | None,
        typer.Option(help="NAME=FILE.json: sensor_from_camera of a sensor; repeat for several."),
    ] = None,
    surfaces: Annotated[
        Path | None,
        typer.Option(
            help="JSON list of surfaces a ranger's beam can hit; default: near the ring's plane."
        ),
    ] = None,
    model: Annotated[
        Path | None, typer.Option(help="View model: a ranger's beam is cast on its mesh.")
    ] = None,
    options: Annotated[
        Path | None, typer.Option(help="JSON file of options, as docs/fusion.md lists them.")
    ] = None,
    every_s: Annotated[
        float | None, typer.Option(help="An estimate so often too, where no sensor speaks.")
    ] = None,
) -> None:
    """Join several sensors' logs into one state: pose, rates, covariance.

    \b
    Example: rendezview fuse track.jsonl ring.jsonl laser.jsonl --target client -o state.jsonl
    """
    check_place(output, "the state")
    check_positive("--every-s", every_s)
    named = [sensor_name(text) for text in logs]
    names = [name for name, _ in named]
    if len(set(names)) < len(names):
        raise RendezviewError(
            f"two logs are of one sensor ({', '.join(names)}): name them apart, NAME=PATH"
        )
    if output.resolve() in [path.resolve() for _, path in named]:
        raise RendezviewError(f"{output}: the state must not overwrite a log")
    ring = find_target(target).docking_ring if target else None
    context = LogContext(ring, _surfaces(surfaces, model), _mounts(mount or [], names))
    fusion = Fusion(_options(options, names) if options else FusionOptions())
    read = [read_log(path, name, context) for name, path in named]
    measurements = merged(read)
    if not measurements:
        raise RendezviewError("no line of these logs has a measurement: there is nothing to join")
    lasts_s = measurements[-1].time_s - measurements[0].time_s
    if every_s is not None and lasts_s > _MOST_TICKS * every_s:
        raise RendezviewError(
            f"--every-s {every_s:g} gives more than {_MOST_TICKS:,} estimates in the {lasts_s:g} s "
            "of the logs: give a longer one, or correct their times"
        )

    def lines() -> Iterator[Line]:
        tick_s = measurements[0].time_s
        for measurement in measurements:
            while every_s is not None and tick_s < measurement.time_s:
                yield Line(state_record(fusion.state_at(tick_s), None, fusion))
                tick_s += every_s
            verdict = fusion.add(measurement)
            estimate = fusion.state_at(measurement.time_s)
            yield Line(state_record(estimate, verdict, fusion), estimate.status)

    with ProgressBar() as bar:
        summary = run(lines(), log=output, progress=bar.stage("measurements", len(measurements)))
    _say_outcome(fusion, summary)


def _options(path: Path, names: list[str]) -> FusionOptions:
    """Options of a file; says which of its keys are without a use here."""
    with warnings.catch_warnings(record=True) as ignored:
        warnings.simplefilter("always", DeprecationWarning)
        read = read_options(path)
    for warning in ignored:
        say(f"{path}: {warning.message}")
    for name in read.sensors:
        if name not in names:
            say(f"{path}: sensors.{name} is ignored: no log has this name ({', '.join(names)})")
    return read


def _surfaces(surfaces: Path | None, model: Path | None) -> tuple[BeamSurface, ...] | BeamMesh:
    """What a ranger's beam may meet."""
    if surfaces is not None:
        return read_surfaces(surfaces)
    if model is None:
        return ()
    mesh = ViewModel.load(model).beam_mesh()
    if mesh is None:
        raise RendezviewError(
            f"{model}: it carries no mesh that stands still (it has joints, or was trained by an "
            "older version): name --surfaces instead"
        )
    return mesh


def _mounts(texts: list[str], names: list[str]) -> dict[str, Pose]:
    mounts = {}
    for text in texts:
        name, equals, path = text.partition("=")
        if not equals or name not in names:
            raise RendezviewError(
                f"--mount must be NAME=FILE.json with the name of a log ({', '.join(names)}), "
                f"not {text!r}"
            )
        mounts[name] = read_mount(path)
    return mounts


def _say_outcome(fusion: Fusion, summary: Summary) -> None:
    sensors = "; ".join(
        f"{name}: {trust.accepted} of {trust.received} taken"
        + (f", locked out {trust.lockouts} times" if trust.lockouts else "")
        for name, trust in fusion.trusts.items()
    )
    say(
        f"{summary.outcomes[Status.TRACKING]} of {summary.total} tracking"
        + outcome_words(summary.outcomes, Status.TRACKING)
        + f"; {sensors}"
        + (f"; begun {fusion.starts} times" if fusion.starts != 1 else "")
    )
