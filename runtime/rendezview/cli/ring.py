"""``rendezview ring`` and ``rendezview calibrate ring``."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from rendezview.cli.inputs import CameraFile, check_positive, direction_of, given_sequence
from rendezview.cli.progress import ProgressBar, say, say_summary
from rendezview.errors import RendezviewError
from rendezview.io.bundled import find_target
from rendezview.io.files import atomic_write_text, check_place, make_folder
from rendezview.io.results import JsonLinesWriter, json_line, read_json_lines
from rendezview.io.sequences.frame import Frame
from rendezview.io.sequences.images import write_png
from rendezview.io.target import DockingRing
from rendezview.sensors.observation import Status
from rendezview.sensors.ring import RingOptions, RingPrior
from rendezview.sensors.ring.overlay import draw_reading
from rendezview.sensors.ring.prior_log import priors_of_poses
from rendezview.sensors.ring.run import follow, record
from rendezview.sensors.ring.size_run import SizeFrame, measure_pass, read_echoes
from rendezview.sensors.run import Line, run

_FIND = "find"  # the command of `rendezview ring FRAMES`


class _RingGroup(TyperGroup):
    """Takes the first word `size`, until version 0.4: `rendezview calibrate ring`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        return super().parse_args(ctx, args if args[:1] == ["size"] else [_FIND, *args])

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        name, command, rest = super().resolve_command(ctx, args)
        return ("" if name == _FIND else name), command, rest


ring = typer.Typer(cls=_RingGroup, rich_markup_mode=None, add_help_option=False)


@ring.command(_FIND)
def find(
    frames: Annotated[
        Path, typer.Argument(help="BOP scene, SPEED folder, folder of images, or video.")
    ],
    camera: CameraFile = None,
    radius_m: Annotated[
        float | None, typer.Option("--radius-m", help="Radius of the ring's edge: gives poses.")
    ] = None,
    target: Annotated[
        str | None,
        typer.Option(
            help="Target file with a docking_ring, or client: its radius, axis and other circles."
        ),
    ] = None,
    range_m: Annotated[
        float | None,
        typer.Option(
            "--range-m", help="Range to the ring in the first frames: which circle is meant."
        ),
    ] = None,
    range_sigma_m: Annotated[
        float | None,
        typer.Option(
            "--range-sigma-m", help="Error of --range-m, one σ; given, it holds for all frames."
        ),
    ] = None,
    track: Annotated[
        Path | None,
        typer.Option(
            help="Log of `rendezview track` over the same frames (with --target): its poses tell "
            "where the ring is, how far, and which way it faces."
        ),
    ] = None,
    prior_axis: Annotated[
        str | None,
        typer.Option(
            help="Axis of the ring, right to about 20°: 'x,y,z' in the camera frame, or 'scene' "
            "for the scene's own truth (with --target). Chooses between a circle's two poses."
        ),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="JSON lines; standard output if absent.")
    ] = None,
    overlay: Annotated[Path | None, typer.Option(help="Folder for pictures of readings.")] = None,
    least_contrast: Annotated[
        float, typer.Option(min=1.0, max=255.0, help="Grey levels of the weakest edge.")
    ] = 8.0,
    independent: Annotated[
        bool, typer.Option("--independent", help="Each frame on its own, no memory.")
    ] = False,
) -> None:
    """Find a docking ring: its ellipses, and with its radius its pose.

    \b
    Example: rendezview ring frames --camera camera.yaml --radius-m 0.597 -o ring.jsonl
    After track: rendezview ring frames --target client --track track.jsonl -o ring.jsonl
    A ring of unknown size: rendezview calibrate ring --help
    """
    check_place(output, "the readings")
    known = None if target is None else _ring_of(target)
    radius = radius_m if radius_m is not None or known is None else known.radius_m
    lengths = (("--radius-m", radius), ("--range-m", range_m), ("--range-sigma-m", range_sigma_m))
    for name, value in lengths:
        check_positive(name, value)
    if range_sigma_m is not None and range_m is None:
        raise RendezviewError("--range-sigma-m is the error of --range-m: give that, too")
    prior = _prior(prior_axis, RingPrior(range_m=range_m, range_sigma_m=range_sigma_m), known)
    if track is not None:
        if known is None or prior_axis is not None or range_m is not None:
            raise RendezviewError(
                "--track needs --target, which gives the ring's place, and comes instead of "
                "--prior-axis and --range-m"
            )
        prior = priors_of_poses(track, known)
    sequence = given_sequence(frames, camera)
    if overlay:
        make_folder(overlay)
    readings = follow(
        sequence, radius, options=RingOptions(least_contrast_grey=least_contrast),
        prior=prior, independent=independent,
        circles=() if known is None or radius != known.radius_m else known.circles,
    )  # fmt: skip

    def lines() -> Iterator[Line]:
        for frame, image, reading in readings:
            if overlay and image is not None:
                drawn = draw_reading(image, reading, frame.camera)
                write_png(overlay / f"{frame.im_id:06d}.png", drawn)
            spent_ms = sum(reading.stage_ms.values())
            yield Line(record(frame, reading), reading.status, spent_ms=spent_ms)

    with ProgressBar() as bar:
        summary = run(
            lines(), log=output, to_stdout=True, progress=bar.stage("frames", len(sequence))
        )
    found = summary.outcomes[Status.OK]
    what = "rings" if radius is None else "poses"
    say_summary(summary, found, len(sequence), what=what, step="frame")


@ring.command("size")
def size(
    frames: Annotated[
        Path, typer.Argument(help="Fly-around: BOP scene, folder of images, or video.")
    ],
    ranges: Annotated[
        Path,
        typer.Option(
            help="JSON lines of a laser ranger: range_m to the panel, sigma_m, time_s or im_id."
        ),
    ],
    camera: CameraFile = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="JSON; standard output if absent.")
    ] = None,
    log: Annotated[Path | None, typer.Option(help="JSON lines: what each frame showed.")] = None,
    least_contrast: Annotated[
        float, typer.Option(min=1.0, max=255.0, help="Grey levels of the ring's weakest edge.")
    ] = 8.0,
) -> None:
    """Measure a docking ring of unknown size.

    This gives its radius and its place over a panel. The frames show a rectangular panel of
    unknown size with the ring before or behind it, in a plane parallel to it. The ranges give the
    scale.

    \b
    Example: rendezview calibrate ring flight --camera camera.yaml --ranges laser.jsonl -o size.json
    """
    check_place(output, "the size")
    sequence = given_sequence(frames, camera)
    echo_of = read_echoes(read_json_lines(ranges), str(ranges))
    with ProgressBar() as bar, JsonLinesWriter(log) if log else nullcontext() as writer:
        done, advance = count(1), bar.stage("frames", len(sequence))

        def each(frame: SizeFrame) -> None:
            if writer:
                writer.write(frame.record())
            advance(next(done))

        result = measure_pass(
            sequence, echo_of, RingOptions(least_contrast_grey=least_contrast), each
        )
    line = json_line(result.record())
    if output:
        atomic_write_text(output, line + "\n")
    else:
        print(line)
    if result.size is None:
        raise RendezviewError(f"{frames}: no size: {result.reason}; --log says it of each frame")
    found = result.size
    sigma = 2.0 * math.sqrt(found.covariance[0, 0])
    say(
        f"diameter {2.0 * found.radius_m:.4f} ± {sigma:.4f} m from {len(found.used)} of "
        f"{result.frames} frames"
    )


def _ring_of(target: str) -> DockingRing:
    known = find_target(target).docking_ring
    if known is None:
        raise RendezviewError(
            f"{target}: this target has no docking_ring: add one, or give --radius-m instead"
        )
    return known


def _prior(
    text: str | None, given: RingPrior, known: DockingRing | None
) -> Callable[[Frame], RingPrior | None]:
    if text is None:
        return lambda frame: given
    if text == "scene":
        if known is None:
            raise RendezviewError("--prior-axis scene needs --target, which gives the ring's axis")

        def from_scene(frame: Frame) -> RingPrior:
            truth = frame.camera_from_target
            if truth is None:
                raise RendezviewError(
                    f"{frame.name}: the scene does not give its pose: give --prior-axis 'x,y,z'"
                )
            return replace(given, axis=truth.rotation @ known.axis)

        return from_scene
    axis = direction_of(text, "--prior-axis", "or 'scene'")
    return lambda frame: replace(given, axis=axis)
