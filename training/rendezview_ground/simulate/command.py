"""``rendezview simulate``."""

from __future__ import annotations

from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from rendezview.cli.inputs import given_camera, say_once
from rendezview.cli.progress import ProgressBar
from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.bundled import find_target
from rendezview.io.files import check_place
from rendezview.io.target import Target
from rendezview.sensors.beacons.rig_files import load_rig
from rendezview_ground.learn.command_options import Jobs
from rendezview_ground.mesh.joints import with_parts
from rendezview_ground.mesh.mesh import load_mesh
from rendezview_ground.mesh.parts import with_blankets
from rendezview_ground.simulate.background import Earth, Stars
from rendezview_ground.simulate.joint_motion import joint_motion
from rendezview_ground.simulate.led_pictures import PictureOptions
from rendezview_ground.simulate.light_scene import simulate_lights
from rendezview_ground.simulate.mitsuba_renderer import MitsubaOptions
from rendezview_ground.simulate.ranger import Ranger, write_echoes
from rendezview_ground.simulate.reflector_scene import (
    Integration,
    simulate_reflectors,
    without_mesh,
)
from rendezview_ground.simulate.scene import PARTS_STREAM, SceneOptions
from rendezview_ground.simulate.scene import simulate as simulate_scene
from rendezview_ground.simulate.sensor import SensorOptions
from rendezview_ground.simulate.shading import ShadingOptions
from rendezview_ground.simulate.trajectories import TrajectoryOptions, Triple, trajectory, triple

_LED_GREY = 200.0  # peak of a light


class Kind(StrEnum):
    """Trajectories."""

    CIRCULAR = "circular"
    SPIRAL = "spiral"
    VBAR = "vbar"
    FLYAROUND = "flyaround"
    TUMBLE = "tumble"
    RANDOM = "random"
    STATIONS = "stations"


def simulate(
    target: Annotated[
        str,
        typer.Argument(help="Mesh, target.toml or its folder, or hubble, client, scole, shuttle."),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder of the BOP scene.")],
    kind: Annotated[Kind, typer.Option("--trajectory", help="Motion of camera and target.")],
    unit: Annotated[str | None, typer.Option(help="Unit of a bare mesh.")] = None,
    camera: Annotated[
        Path | None, typer.Option(help="Camera file; default 640 × 480, 53° across.")
    ] = None,
    frames: Annotated[int, typer.Option(min=1, help="Number of frames.")] = 60,
    dt: Annotated[float, typer.Option(help="Seconds between frames.")] = 1.0,
    start_range: Annotated[
        float | None, typer.Option(help="Metres from the target's centre; default 6 target radii.")
    ] = None,
    end_range: Annotated[
        float | None, typer.Option(help="Metres at the end; default 3 target radii, or the start.")
    ] = None,
    turn: Annotated[float, typer.Option(help="Total angle around the target, degrees.")] = 120.0,
    axis: Annotated[
        str | None,
        typer.Option(
            help="V-bar and stations: 'x,y,z' from the target to the camera, target frame; or "
            "'ring': the docking ring's axis, straight, ranges from its centre. Default: +X."
        ),
    ] = None,
    laser: Annotated[
        Path | None,
        typer.Option(help="Write what a laser ranger beside the camera measures, JSON lines."),
    ] = None,
    laser_sigma: Annotated[float, typer.Option(help="Noise of the ranger, metres (one σ).")] = 0.01,
    laser_origin: Annotated[
        str, typer.Option(help="Where its beam leaves, 'x,y,z', camera frame; it runs along +z.")
    ] = "0.1,0,0",
    reflectors: Annotated[
        bool,
        typer.Option(
            "--reflectors", help="Write lit/ and dark/ with the target's reflectors lit by lasers."
        ),
    ] = False,
    group: Annotated[
        list[str] | None, typer.Option(help="With --reflectors: groups that there are. All.")
    ] = None,
    integration: Annotated[
        Integration,
        typer.Option(help="With --reflectors: the exposure; suggested: as the readings ask."),
    ] = Integration.AUTOMATIC,
    leds: Annotated[
        Path | None,
        typer.Option(help="Write what the cameras of this rig file see of the target's LEDs."),
    ] = None,
    multiplex: Annotated[
        float,
        typer.Option("--multiplex-s", min=0.0, help="With --leds: from one light to the next."),
    ] = 0.0,
    sun_phase: Annotated[
        float, typer.Option(min=0.0, max=180.0, help="Degrees Sun–target–camera.")
    ] = 0.0,
    sun_direction: Annotated[
        str | None, typer.Option(help="Fixed Sun instead: 'x,y,z' towards it, target frame.")
    ] = None,
    earth: Annotated[bool, typer.Option("--earth", help="The Earth behind the target.")] = False,
    stars: Annotated[bool, typer.Option("--stars", help="A field of stars.")] = False,
    noise: Annotated[float, typer.Option(help="Noise, grey levels (one σ).")] = 3.0,
    blur: Annotated[float, typer.Option(help="Blur of the optics, pixels (one σ).")] = 0.7,
    overexposure: Annotated[
        float, typer.Option(help="Times the automatic exposure: 5 burns out the sunlit faces.")
    ] = 1.0,
    bloom: Annotated[
        float, typer.Option(help="Share of the light in a halo around bright faces, 0 to 1.")
    ] = 0.0,
    black_level: Annotated[
        float, typer.Option(help="Grey level of the detector in the dark.")
    ] = 5.0,
    sky_level: Annotated[
        float, typer.Option(help="Glow of the sky behind the target, grey levels.")
    ] = 0.0,
    dust: Annotated[
        int, typer.Option(help="Specks of dust before the camera, like stars, in each frame.")
    ] = 0,
    mesh_error: Annotated[
        float, typer.Option(help="Smooth error of the mesh: RMS displacement, share of its radius.")
    ] = 0.0,
    joint: Annotated[
        list[str] | None,
        typer.Option(help="NAME=ANGLE or NAME=ANGLE,RATE of a joint, degrees (a second)."),
    ] = None,
    insulation: Annotated[
        float,
        typer.Option(help="Bumpy blanket over half of the mesh: thickness, share of its radius."),
    ] = 0.0,
    bearing: Annotated[
        float,
        typer.Option(help="Random and stations: largest angle of the target off the boresight, °."),
    ] = 0.0,
    off_axis: Annotated[
        float, typer.Option(help="Stations: largest angle of the camera off the axis, degrees.")
    ] = 15.0,
    jitter: Annotated[float, typer.Option(help="Pointing jitter, degrees (one σ).")] = 0.3,
    mitsuba: Annotated[
        bool,
        typer.Option(
            "--mitsuba", help="Render with Mitsuba (rendezview[mitsuba]), a second per frame."
        ),
    ] = False,
    masks: Annotated[bool, typer.Option("--masks", help="Write mask_visib/ too.")] = False,
    jobs: Jobs = -1,
    seed: Annotated[int, typer.Option(min=0, help="Of all random numbers.")] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a scene.")] = False,
) -> None:
    """Render camera frames of a target, with the true pose of each.

    \b
    Example: rendezview simulate hubble -o approach --trajectory spiral --sun-phase 20
             rendezview simulate client -o run --trajectory vbar --axis ring --reflectors
             rendezview simulate scole -o lights --trajectory vbar --axis 0,0,-1 --leds rig.json
    """
    found = find_target(target)
    if reflectors and leds is not None:
        raise RendezviewError("simulate --reflectors or --leds, not both in one run")
    if leds is not None or (found.mesh is None and reflectors):
        mesh = without_mesh(found)  # trajectories are about the lights, which are all that is drawn
    else:
        mesh = with_parts(load_mesh(found.mesh_path, unit or found.unit), found, unit)
        mesh = with_blankets(mesh, found, unit, np.random.default_rng([seed, PARTS_STREAM]))
    say_once(*mesh.doubts)
    moving = joint_motion([parts.joint for parts in found.joints], joint or [])
    flight_camera = given_camera(camera) or default_camera()
    options = SceneOptions(
        sky_frame="camera" if kind is Kind.TUMBLE else "target",
        sun_phase_rad=float(np.deg2rad(sun_phase)),
        sun_azimuth_each_frame=kind is Kind.RANDOM,
        sun_direction_sky=None
        if sun_direction is None
        else _vector("--sun-direction", sun_direction),
        earth=Earth() if earth else None,
        stars=Stars() if stars else None,
        shading=ShadingOptions(),
        mitsuba=MitsubaOptions() if mitsuba else None,
        sensor=SensorOptions(
            noise_sigma_grey=noise,
            blur_sigma_px=blur,
            overexposure=overexposure,
            bloom=bloom,
            black_level_grey=black_level,
        ),
        sky_level_grey=sky_level,
        dust=dust,
        mesh_error=mesh_error,
        insulation=insulation,
        masks=masks,
    )
    centre, radius_m = mesh.bounding_sphere
    if end_range is None and kind in (Kind.SPIRAL, Kind.VBAR, Kind.RANDOM, Kind.STATIONS):
        end_range = 3.0 * radius_m
    motion = TrajectoryOptions(
        frames=frames,
        dt_s=dt,
        start_range_m=6.0 * radius_m if start_range is None else start_range,
        end_range_m=end_range,
        centre_m=triple(centre),
        turn_rad=float(np.deg2rad(turn)),
        bearing_max_rad=float(np.deg2rad(bearing)),
        off_axis_max_rad=float(np.deg2rad(off_axis)),
        pointing_jitter_rad=float(np.deg2rad(jitter)),
        seed=seed,
    )
    if axis is not None:
        motion = _along(axis, kind, motion, found)
    path = trajectory(kind.value, motion)
    ranger = None
    if laser is not None:
        if not laser_sigma > 0.0:
            raise RendezviewError(f"--laser-sigma must be positive, not {laser_sigma}")
        check_place(laser, "the ranger's log")
        ranger = Ranger(_vector("--laser-origin", laser_origin), laser_sigma)
    processes = 1 if mitsuba else jobs  # Mitsuba uses all cores itself
    with ProgressBar() as progress:

        def report(done: int, total: int) -> None:
            progress("frames", done, total)

        if leds is not None:
            spots = PictureOptions(signal_to_noise=_LED_GREY / max(noise, 0.1), peak_grey=_LED_GREY)
            rig = load_rig(leds)
            simulate_lights(
                found, rig, path, output, seed, options=spots, multiplex_s=multiplex,
                progress=report,
            )  # fmt: skip
        elif reflectors:
            simulate_reflectors(
                mesh, found, flight_camera, path, options, output, seed, groups=tuple(group or ()),
                integration=integration, jobs=processes, progress=report, overwrite=overwrite,
            )  # fmt: skip
        else:
            simulate_scene(
                mesh, flight_camera, path, options, output, seed, jobs=processes, progress=report,
                overwrite=overwrite, joints=moving if moving.joints else None,
            )  # fmt: skip
    if laser is not None and ranger is not None:
        write_echoes(laser, mesh, path, ranger, seed)
    Console(stderr=True).print(f"{output}: {frames} frames", highlight=False, soft_wrap=True)


def default_camera() -> Camera:
    """640 × 480, 53° wide: a target fills it at 2.7 target radii."""
    return Camera.from_fov(640, 480, float(np.deg2rad(53.0)))


def _along(axis: str, kind: Kind, motion: TrajectoryOptions, target: Target) -> TrajectoryOptions:
    """The options of an approach or of places along an axis, or before the docking ring."""
    if kind not in (Kind.VBAR, Kind.STATIONS):
        raise RendezviewError(f"--axis is for vbar and stations, not for {kind}: leave it out")
    if axis != "ring":
        return replace(motion, approach_axis=_vector("--axis", axis))
    ring = target.docking_ring
    if ring is None:
        raise RendezviewError(f"--axis ring: {target.name} has no docking_ring: give 'x,y,z'")
    return replace(motion, approach_axis=triple(ring.axis), centre_m=triple(ring.centre_m), hops=0)


def _vector(option: str, text: str) -> Triple:
    try:
        return triple(float(part) for part in text.split(","))
    except ValueError:
        raise RendezviewError(f"{option} must be 'x,y,z', not {text!r}") from None
