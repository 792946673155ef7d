"""``rendezview track``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from rendezview.cli.compiling import COMMANDS, compile_ahead, compile_beside
from rendezview.cli.guide import (
    AemFile,
    ChaserFile,
    Epoch,
    Guide,
    OemFile,
    PlanFile,
    ShapeName,
    first_epoch,
)
from rendezview.cli.inputs import ObjectId, check_apart, direction_of, given_camera, given_sequence
from rendezview.cli.live_view import LiveView
from rendezview.cli.progress import ProgressBar, say, say_summary
from rendezview.cli.where import At, Box, Boxes, Instances, Mask, given_regions
from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Pose
from rendezview.io.files import check_place
from rendezview.io.pose_log import poses_by_frame, read_pose
from rendezview.io.sequences import Frame, Sequence
from rendezview.io.sequences.frame import GreyImage
from rendezview.io.sequences.live import is_live, live_frames
from rendezview.sensors.appearance import (
    AppearanceObservation,
    SilhouetteOptions,
    Threshold,
    ViewModel,
)
from rendezview.sensors.appearance.following import follow, record, result_row
from rendezview.sensors.appearance.integrity.monitor import IntegrityOptions
from rendezview.sensors.appearance.video import drawn, video_of
from rendezview.sensors.protection import Levels
from rendezview.sensors.run import Line, run


def track(
    model: Annotated[Path, typer.Argument(help="Model file (*.rvm).")],
    scene: Annotated[
        str,
        typer.Argument(
            help="BOP scene, SPEED folder, images, video or recording; or a camera: 0, "
            "/dev/video0, rtsp://..., until Ctrl-C."
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Results, BOP CSV; of a camera not needed."),
    ] = None,
    log: Annotated[Path | None, typer.Option(help="Everything of each frame, JSON lines.")] = None,
    camera: Annotated[
        Path | None,
        typer.Option(
            help="Camera file (OpenCV YAML, ROS, SPEED or BOP JSON); wins over the scene."
        ),
    ] = None,
    prior: Annotated[
        str | None,
        typer.Option(
            help="Attitude of the first frame, right to about 20°: 'w,x,y,z' (camera from target), "
            "a JSON file with quat_wxyz [and translation_m], or 'scene' for the scene's own truth. "
            "Without it all attitudes are searched. Or a log of poses by other sensors, .jsonl: "
            "where the target is searched while it is lost."
        ),
    ] = None,
    independent: Annotated[
        bool, typer.Option("--independent", help="Each frame on its own, no memory.")
    ] = False,
    threshold: Annotated[
        str, typer.Option(help="noise, otsu, or a grey level from 0 to 254.")
    ] = "noise",
    sun: Annotated[
        str | None,
        typer.Option(help="'x,y,z' towards the Sun, camera frame: helps where shadows are hard."),
    ] = None,
    refine: Annotated[
        bool, typer.Option("--refine/--no-refine", help="Move poses onto the edges of the frame.")
    ] = True,
    sketch: Annotated[
        bool,
        typer.Option(
            "--sketch/--no-sketch",
            help="Where grey edges give no pose, search on a network's sketch of the frame.",
        ),
    ] = True,
    integrity_risk: Annotated[
        float | None,
        typer.Option(
            help="Protection levels: the error that is exceeded with this probability, 1e-3 … 1e-6."
        ),
    ] = None,
    alarm_attitude_deg: Annotated[
        float | None, typer.Option(help="Alarm where the level of the attitude is higher.")
    ] = None,
    alarm_position_m: Annotated[
        float | None, typer.Option(help="Alarm where the level of the position is higher.")
    ] = None,
    obj_id: ObjectId = None,
    box: Box = None,
    boxes: Boxes = None,
    instances: Instances = 1,
    mask: Mask = None,
    at: At = None,
    video: Annotated[
        Path | None,
        typer.Option(help="Frames with the result drawn over them (.webm, .mp4, .avi or .gif)."),
    ] = None,
    show: Annotated[
        bool, typer.Option("--show", help="The same in a browser, while it runs.")
    ] = False,
    plan: PlanFile = None,
    shape: ShapeName = None,
    chaser: ChaserFile = None,
    oem: OemFile = None,
    aem: AemFile = None,
    epoch: Epoch = None,
) -> None:
    """Recognise and track a target through a sequence of frames.

    \b
    Example: rendezview track hubble.rvm approach -o poses.csv --log log.jsonl --prior scene
             rendezview track hubble.rvm 0 --camera camera.yaml --show
    """
    if output is None and not is_live(scene):
        raise typer.BadParameter("recorded frames need a file for the results", param_hint="-o")
    check_place(output, "the results")
    check_place(log, "the log")
    check_apart(output, log, video, model, oem, aem, plan, chaser)
    first_epoch(epoch, [], False)  # a wrong one is said before the frames are opened
    loaded = ViewModel.load(model)
    taken: Iterable[Frame] | None = None
    if is_live(scene):
        sequence = Sequence(1, (), Path(scene))  # nothing is known of its frames
        taken = live_frames(scene, given_camera(camera), say)
    else:
        sequence = given_sequence(Path(scene), camera, obj_id)
    times_s = [frame.time_s for frame in sequence.frames[:1] if frame.time_s is not None]
    moment = first_epoch(epoch, times_s, bool(oem or aem))
    others = None if prior is None or not prior.endswith(".jsonl") else Path(prior)
    expected = (
        None if others is None else poses_by_frame(others, lambda *known: known, sequence.frames)
    )
    first = _prior(prior, sequence, loaded) if others is None else None
    options = None if threshold == Threshold.NOISE else _silhouette(threshold)
    light = None if sun is None else direction_of(sun, "--sun", "towards the Sun")
    sequence, where, first_where = given_regions(sequence, obj_id, box, boxes, mask, at, instances)
    independent = independent or instances > 1
    integrity = _integrity(integrity_risk, alarm_attitude_deg, alarm_position_m)
    levels = Levels()
    # Frames of a file wait for loops that only hard ones need; those of a camera do not.
    ahead, later = (("track",), ("hard",)) if taken is None else (COMMANDS["track"], ())
    compile_ahead(*ahead)
    guide = _guide(loaded, plan, shape, chaser, oem, aem, refine)
    film = video_of(video, sequence, loaded) if video else None
    view = LiveView() if show else None

    def watch(frame: Frame, image: GreyImage | None, observation: AppearanceObservation) -> None:
        picture = drawn(frame, image, observation, loaded)
        for each in (film, view):
            if each is not None:
                each.add(picture)

    if view is not None:
        say(f"Watch at {view.address}")
    frames = follow(
        loaded,
        sequence if taken is None else taken,
        prior=first,
        independent=independent,
        silhouette=options,
        sun_camera=light,
        refine=refine,
        sketch=sketch,
        integrity=integrity,
        expected=expected,
        where=where,
        first_where=first_where,
        watch=watch if film or view else None,
    )

    def lines() -> Iterator[Line]:
        for index, (frame, observation) in enumerate(frames):
            noted = record(frame, observation)
            if guide is not None:
                time_s = float(index) if frame.time_s is None else frame.time_s
                noted["trajectory"], words = guide.update(
                    time_s, observation.pose, observation.covariance, observation.cloud
                )
                if words:
                    say(words)
            levels.add(observation.protection)
            row = result_row(sequence.scene_id, frame, observation)
            yield Line(noted, observation.status, row, sum(observation.stage_ms.values()))

    beside = compile_beside(*later)
    with beside, film or nullcontext(), view or nullcontext(), ProgressBar() as bar:
        progress = bar.stage("frames", len(sequence)) if taken is None else None
        summary = run(
            lines(), log=log, results=output, to_stdout=taken is not None, progress=progress
        )
    if guide is not None:
        guide.finish(oem, aem, moment, loaded.name)
    if integrity is not None:
        say(str(levels))
    say_summary(summary, len(summary.rows), summary.total, what="poses", step="frame")


def _guide(
    model: ViewModel,
    plan: Path | None,
    shape: str | None,
    chaser: Path | None,
    oem: Path | None,
    aem: Path | None,
    refine: bool,
) -> Guide | None:
    if plan is None and shape is None:
        if chaser or oem or aem:
            raise RendezviewError("--chaser, --oem and --aem need a --plan or a --shape to fit")
        return None
    return Guide.of(model.centre_m, plan, shape, chaser, refine)


def _integrity(
    risk: float | None, attitude_deg: float | None, position_m: float | None
) -> IntegrityOptions | None:
    """The user's risk and limits; a limit alone takes the default risk."""
    if risk is None and attitude_deg is None and position_m is None:
        return None
    given: dict[str, Any] = {}
    if risk is not None:
        given["risk"] = risk
    if attitude_deg is not None:
        given["alarm_attitude_rad"] = float(np.deg2rad(attitude_deg))
    if position_m is not None:
        given["alarm_position_m"] = position_m
    return IntegrityOptions(**given)


def _silhouette(threshold: str) -> SilhouetteOptions:
    if threshold in (Threshold.NOISE, Threshold.OTSU):
        return SilhouetteOptions(threshold=Threshold(threshold))
    try:
        return SilhouetteOptions(threshold=Threshold.FIXED, level_grey=float(threshold))
    except ValueError:
        raise RendezviewError(
            f"--threshold must be noise, otsu or a grey level from 0 to 254, not {threshold!r}"
        ) from None


def _prior(text: str | None, sequence: Sequence, model: ViewModel) -> Pose | None:
    if text is None:
        return None
    if text == "scene":
        truth = sequence.frames[0].camera_from_target if len(sequence) else None
        if truth is None:
            raise RendezviewError(
                f"{sequence.source}: the first frame has no true pose to start from; "
                "give --prior 'w,x,y,z' or leave it out"
            )
        return truth
    # Only the attitude matters; without a translation the target is straight ahead.
    ahead = [0.0, 0.0, 2.0 * model.sphere_radius_m]
    try:
        if Path(text).is_file():
            return read_pose(Path(text), "a prior pose", ahead)
        return Pose.from_quat_wxyz([float(part) for part in text.split(",")], ahead)
    except (ValueError, OSError):  # too long a name
        raise RendezviewError(
            f"--prior {text!r}: give 'scene', a quaternion 'w,x,y,z', a JSON file with "
            "quat_wxyz and, if you like, translation_m, or a log of poses (.jsonl)"
        ) from None
