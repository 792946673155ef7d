"""The trajectory part of ``track``: segment, correction and spin of a plan or a shape."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from scipy.spatial.transform import Rotation, Slerp

from rendezview.cli.progress import say
from rendezview.errors import RendezviewError, explained
from rendezview.geometry.pose import Array, Pose
from rendezview.io.ccsds import Names, attitude_message, epoch_of, orbit_message
from rendezview.io.files import atomic_write_text, read_text
from rendezview.trajectory import (
    Correction,
    FollowerOptions,
    NoFit,
    PathFollower,
    Report,
    Segment,
    Shape,
    Spin,
    load_plan,
)
from rendezview.trajectory.follower import record

_HEADER = ["time_s", "qw", "qx", "qy", "qz"]


def chaser_attitudes(path: Path) -> Slerp:
    """Attitudes of the chaser, path_from_camera, from a CSV ``time_s,qw,qx,qy,qz``.

    Raises:
        RendezviewError: missing, another header, a wrong row, or times that do not rise.
    """
    rows = list(csv.reader(read_text(path, "attitudes of the chaser (CSV)").splitlines()))
    if not rows or [cell.strip() for cell in rows[0]] != _HEADER:
        raise RendezviewError(f"{path}: line 1: the header must be {','.join(_HEADER)}")
    with explained(f"{path}: ", ": correct the file"):
        table = np.array([[float(cell) for cell in row] for row in rows[1:] if row])
        if table.ndim != 2 or table.shape[1] != 5 or len(table) < 2:
            raise ValueError("needs two rows or more of five numbers")
        if not np.isfinite(table).all() or np.any(np.diff(table[:, 0]) <= 0.0):
            raise ValueError("numbers must be finite, and the times rise")
        return Slerp(table[:, 0], Rotation.from_quat(table[:, [2, 3, 4, 1]]))


# Options of the commands that fit a path.
PlanFile = Annotated[
    Path | None,
    typer.Option(help="Planned path (TOML): errors and corrections, spin, of each segment."),
]
ShapeName = Annotated[
    str | None, typer.Option(help="Fit circular, spiral, vbar, orbit or drift; wins over the plan.")
]
ChaserFile = Annotated[
    Path | None,
    typer.Option(help="The chaser's own attitudes, CSV time_s,qw,qx,qy,qz: path from camera."),
]
OemFile = Annotated[Path | None, typer.Option(help="Fitted path, CCSDS OEM (KVN).")]
AemFile = Annotated[Path | None, typer.Option(help="Fitted attitude, CCSDS AEM (KVN).")]
Epoch = Annotated[
    str | None, typer.Option(help="UTC of time 0, for OEM and AEM; times since 1970 need none.")
]


def first_epoch(text: str | None, times_s: Sequence[float], wanted: bool) -> datetime:
    """UTC of time 0; says what was assumed if a message is wanted.

    Raises:
        RendezviewError: as `epoch_of`.
    """
    epoch, words = epoch_of(text, times_s)
    if words is not None and wanted:
        say(words)
    return epoch


@dataclass(slots=True)
class Guide:
    """Feeds observations to a follower, and reports to the screen, the log and CCSDS messages."""

    follower: PathFollower
    chaser: Slerp | None = None
    times_s: list[float] = field(default_factory=list)
    states: list[Array] = field(default_factory=list)
    covariances: list[Array] = field(default_factory=list)
    attitude_times_s: list[float] = field(default_factory=list)
    attitudes: list[Array] = field(default_factory=list)
    last: Report | None = None

    @classmethod
    def of(
        cls,
        centre_m: Array,
        plan_path: Path | None,
        shape: str | None,
        chaser: Path | None,
        refine: bool,
    ) -> Guide:
        """The follower that the options of ``track`` and ``guide`` ask for.

        Raises:
            RendezviewError: the plan, shape or attitudes are none.
        """
        plan = load_plan(plan_path) if plan_path else None
        try:
            chosen = Shape(shape) if shape else None
        except ValueError:
            raise RendezviewError(
                f"--shape must be one of {', '.join(Shape)}, not {shape!r}"
            ) from None
        options = FollowerOptions(poses=refine)
        if plan is not None:
            options = FollowerOptions(
                turn_rad=plan.turn_rad, segment_s=plan.segment_s, poses=refine
            )
        follower = PathFollower(centre_m, chosen, plan, options)
        return cls(follower, chaser_attitudes(chaser) if chaser else None)

    def update(
        self,
        time_s: float,
        pose: Pose | None,
        covariance: Array | None,
        cloud: tuple[Array, Array] | None = None,
    ) -> tuple[dict[str, Any], str | None]:
        """Record of a frame, and words when a segment ends.

        Args:
            pose, covariance: camera_from_target and its (6, 6).
            cloud: points (K, 3) of the camera, target frame, and the trust in each (K,).

        Raises:
            RendezviewError: the chaser's attitudes do not reach to this time.
        """
        attitude = None
        if self.chaser is not None:
            try:
                attitude = self.chaser(time_s).as_matrix()
            except ValueError:
                first_s, last_s = self.chaser.times[[0, -1]]
                raise RendezviewError(
                    f"the chaser's attitudes are of {first_s:g} to {last_s:g} s, the frame of "
                    f"{time_s:g} s: give attitudes of the whole sequence"
                ) from None
        points_m, weights = cloud or (None, None)
        report = self.follower.update(time_s, pose, covariance, points_m, weights, attitude)
        self.last = report
        if isinstance(report.segment, Segment):
            self.times_s.append(time_s)
            place = report.segment.places(time_s)[0]
            self.states.append(np.concatenate([place, report.segment.velocity(time_s)]))
            self.covariances.append(report.segment.state_covariance(time_s))
        if isinstance(report.spin, Spin):
            self.attitude_times_s.append(time_s)
            self.attitudes.append(report.spin.at(time_s)[0][0])
        line = record(report)
        line["centre_m"] = self.follower.centre_m
        line["path_from_target"] = report.path_from_target
        return line, describe(report) if report.ended else None

    def frames(self) -> tuple[str, str]:
        """Names of the frames of the path and of the attitude's reference."""
        plan = self.follower.plan
        path = "SC_BODY_1" if plan is None or plan.orbit is None else "RSW_ROTATING"
        return path, path if self.chaser is not None else "LINE_OF_SIGHT"

    def finish(self, oem: Path | None, aem: Path | None, epoch: datetime, target: str) -> None:
        """Print a segment that has not ended; write CCSDS messages of all that was fitted.

        Raises:
            RendezviewError: there was no segment, or no spin, in any frame.
        """
        if self.last is not None and not self.last.ended:
            say(describe(self.last))
        names = Names(target=target.upper())
        path_frame, reference = self.frames()
        if oem is not None:
            if not self.times_s:
                raise RendezviewError(
                    f"{oem}: no segment was fitted, so there is no orbit to write"
                )
            states = np.array(self.states)
            text = orbit_message(
                epoch,
                self.times_s,
                states[:, :3],
                states[:, 3:],
                frame=path_frame,
                covariances=np.array(self.covariances),
                names=names,
            )
            atomic_write_text(oem, text)
        if aem is not None:
            if not self.attitude_times_s:
                raise RendezviewError(
                    f"{aem}: no spin was fitted, so there is no attitude to write"
                )
            text = attitude_message(
                epoch, self.attitude_times_s, np.array(self.attitudes), frame=reference, names=names
            )
            atomic_write_text(aem, text)


def describe(report: Report) -> str:
    """A report in one line for the screen."""
    parts = [f"segment {report.number}, to {report.time_s:.1f} s"]
    segment, correction, spin = report.segment, report.correction, report.spin
    if isinstance(segment, NoFit):
        parts.append(segment.reason)
    else:
        place = segment.places(report.time_s)[0]
        sigma = np.sqrt(np.linalg.eigvalsh(segment.place_covariance(report.time_s))[-1])
        parts.append(f"{segment.shape} at {_vector(place)} ± {sigma:.3f} m")
    if isinstance(correction, Correction):
        off, ahead = (
            float(np.linalg.norm(error))
            for error in (correction.error_m, correction.predicted_error_m)
        )
        parts.append(f"{off:.3f} m off the plan")
        parts.append(
            f"{ahead:.3f} ± {correction.predicted_sigma_m:.3f} m at {correction.reach_s:.1f} s"
        )
        direction = correction.direction
        if direction is not None:
            parts.append(f"Δv {1e3 * correction.size_m_s:.2f} mm/s along {_vector(direction)}")
    elif isinstance(correction, NoFit) and isinstance(segment, Segment):
        parts.append(f"no correction: {correction.reason}")
    if isinstance(spin, Spin):
        parts.append(
            f"{'tumble' if spin.tumbling else 'spin'} {np.rad2deg(spin.speed_rad_s):.4f} ± "
            f"{np.rad2deg(spin.speed_sigma_rad_s):.4f} °/s about {_vector(spin.axis)}"
        )
    elif isinstance(spin, NoFit):
        parts.append(f"no spin: {spin.reason}")
    return "; ".join(parts)


def _vector(values: Array) -> str:
    return "(" + ", ".join(f"{value:.3f}" for value in values) + ")"
