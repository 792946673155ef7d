"""Protection levels against errors: misleading, alarmed and available poses by condition."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from experiments.frame import PICTURES, show, table_of
from experiments.integrity.draw import CONDITIONS, tracks
from rendezview.io.files import atomic_write
from rendezview.sensors.appearance.integrity.monitor import IntegrityMonitor, IntegrityOptions
from rendezview_ground.evaluate.pictures.palette import png
from rendezview_ground.evaluate.pictures.stanford_pictures import stanford_picture
from rendezview_ground.evaluate.stanford import Judged, upper_limit

RISKS = (1e-2, 1e-3, 1e-4)
LIMIT_RAD, LIMIT_SHARE = math.radians(15.0), 0.15  # of the levels; of the range for the position


@dataclass(frozen=True, slots=True, eq=False)
class Campaign:
    """All poses of the logs with their levels, and how many frames had none."""

    judged: Judged
    condition: np.ndarray  # (N,)
    tracked: np.ndarray  # (N,) from a prediction, against a first pose
    frames: dict[str, int]  # looks of each condition, with or without a pose

    def rows(self, name: str | None, tracked: bool) -> Judged:
        """The poses of a condition, or of all."""
        here = np.ones(len(self.condition), bool) if name is None else self.condition == name
        return self.judged.of(here & (self.tracked == tracked))


def replay(folder: Path, risk: float) -> Campaign:
    """Every track of the logs through a monitor; the position's limit is a share of the range."""
    rows, conditions, tracked = [], [], []
    frames = dict.fromkeys(CONDITIONS, 0)
    for track in tracks(folder):
        frames[track[0].condition] += len(track)
        poses = [look for look in track if look.evidence is not None]
        if not poses:
            continue
        limit_m = LIMIT_SHARE * poses[0].evidence.range_m
        limits = {"alarm_attitude_rad": LIMIT_RAD, "alarm_position_m": limit_m}
        monitor = IntegrityMonitor(IntegrityOptions(risk=risk, **limits))
        for look in poses:
            found = monitor.judge(look.evidence, look.ask)
            moved = (look.move_m, found.position_m, found.alarm)
            rows.append([look.turn_rad, found.attitude_rad, *moved])
            conditions.append(look.condition)
            tracked.append(look.evidence.innovation is not None)
    turn, turn_level, move, move_level, alarm = np.array(rows, dtype=np.float64).T
    judged = Judged(turn, turn_level, move, move_level, alarm > 0.5)
    return Campaign(judged, np.array(conditions), np.array(tracked), frames)


def run(
    folder: Annotated[Path, "logs of integrity-draw"], *,
    picture: Annotated[bool, "write docs/pictures/integrity.png"] = False,
) -> None:  # fmt: skip
    """Judge the levels of every pose in logs that the fit has not seen."""
    for risk in RISKS:
        campaign = replay(folder, risk)
        judged = campaign.judged
        if risk == 1e-3:
            _table(campaign)
            if picture:
                title = f"{len(judged)} poses at a risk of 0.001"
                with atomic_write(PICTURES / "integrity.png", durable=False) as file:
                    file.write(png(stanford_picture(judged, title)))
        count, free = int(judged.misleading.sum()), ~judged.alarm
        print(
            f"risk {risk:g}: {count} of {len(judged)} poses misleading "
            f"({count / len(judged):.2g}, below {upper_limit(count, len(judged)):.2g} with 95 %), "
            f"median level {np.rad2deg(np.median(judged.attitude_level[free])):.3g}°"
        )


def _table(campaign: Campaign) -> None:
    table = table_of(
        "at a risk of 1e-3",
        "condition | frames | tracked poses | misleading | below (95 %) | available %"
        " | median level ° | first poses | misleading | available %",
    )

    def percent(which: np.ndarray) -> str:
        return f"{100.0 * which.mean():.1f}" if len(which) else "–"

    for name in (*CONDITIONS, None):
        tracked, first = campaign.rows(name, True), campaign.rows(name, False)
        frames = sum(campaign.frames.values()) if name is None else campaign.frames[name]
        wrong, of = int(tracked.misleading.sum()), len(tracked)
        free = tracked.attitude_level[~tracked.alarm]
        table.add_row(
            name or "all", f"{frames}", f"{of}", f"{wrong}", f"{upper_limit(wrong, of):.2g}",
            percent(~tracked.alarm),
            f"{np.rad2deg(np.median(free)):.3g}" if len(free) else "–", f"{len(first)}",
            f"{first.misleading.sum()}", percent(~first.alarm),
        )  # fmt: skip
    show(table, width=150)
