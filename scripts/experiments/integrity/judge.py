"""Protection levels against errors: misleading, alarmed and available poses by condition."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from experiments.frame import PICTURES, show, table_of
from experiments.integrity.frames import CONDITIONS
from experiments.integrity.logs import Look, tracks
from rendezview.io.files import atomic_write
from rendezview.sensors.appearance.integrity.monitor import IntegrityMonitor, IntegrityOptions
from rendezview_ground.evaluate.pictures.palette import png
from rendezview_ground.evaluate.pictures.stanford_pictures import stanford_picture
from rendezview_ground.evaluate.stanford import Judged, tail_risk, upper_limit

RISKS = (1e-2, 1e-3, 1e-4)
SETTLED = 12  # poses, after which the second witness has been asked three times


@dataclass(frozen=True, slots=True, eq=False)
class Campaign:
    """All poses of the logs with their levels, and how many frames had none."""

    judged: Judged
    condition: np.ndarray  # (N,)
    tracked: np.ndarray  # (N,) from a prediction, against a first pose
    age: np.ndarray  # (N,) poses of its track before it
    frames: dict[str, int]  # looks of each condition, with or without a pose

    def rows(self, name: str | None, tracked: bool, least_age: int = 0) -> Judged:
        """The poses of a condition, or of all."""
        here = np.ones(len(self.condition), bool) if name is None else self.condition == name
        return self.judged.of(here & (self.tracked == tracked) & (self.age >= least_age))


def replay(folder: Path, risk: float, attitude_deg: float, share: float) -> Campaign:
    """Every track of the logs through a monitor; the position's limit is a share of the range."""
    rows, conditions, tracked, age = [], [], [], []
    frames = dict.fromkeys(CONDITIONS, 0)
    for track in tracks(folder):
        frames[track[0].condition] += len(track)
        poses = [look for look in track if look.evidence is not None]
        if not poses:
            continue
        assert poses[0].evidence is not None
        options = IntegrityOptions(
            risk=risk,
            alarm_attitude_rad=math.radians(attitude_deg),
            alarm_position_m=share * poses[0].evidence.range_m,
        )
        monitor = IntegrityMonitor(options)
        for k, look in enumerate(poses):
            age.append(k)
            rows.append(_judge(monitor, look))
            conditions.append(look.condition)
            tracked.append(look.evidence is not None and look.evidence.innovation is not None)
    turn, turn_level, move, move_level, alarm = np.array(rows).T
    judged = Judged(turn, turn_level, move, move_level, alarm > 0.5)
    return Campaign(judged, np.array(conditions), np.array(tracked), np.array(age), frames)


def _judge(monitor: IntegrityMonitor, look: Look) -> list[float]:
    assert look.evidence is not None
    found = monitor.judge(look.evidence, look.ask)
    return [look.turn_rad, found.attitude_rad, look.move_m, found.position_m, float(found.alarm)]


def run(
    folder: Annotated[Path, "logs of integrity-draw"],
    *,
    attitude_deg: Annotated[float, "limit of the level"] = 15.0,
    share: Annotated[float, "of the range, limit of the level of the position"] = 0.15,
    picture: Annotated[bool, "write docs/pictures/integrity.png"] = False,
) -> None:
    """Judge the levels of every pose in logs that the fit has not seen."""
    for risk in RISKS:
        campaign = replay(folder, risk, attitude_deg, share)
        if risk == 1e-3:
            _table(campaign)
            if picture:
                everything = campaign.judged
                title = f"{len(everything)} poses at a risk of 0.001"
                with atomic_write(PICTURES / "integrity.png", durable=False) as file:
                    file.write(png(stanford_picture(everything, title)))
        judged = campaign.judged
        count = int(judged.misleading.sum())
        free = ~judged.alarm
        tail = tail_risk(judged.ratio[free])
        print(
            f"risk {risk:g}: {count} of {len(judged)} poses misleading "
            f"({count / len(judged):.2g}, below {upper_limit(count, len(judged)):.2g} with 95 %), "
            f"by the fitted tail {'–' if tail is None else f'{tail:.2g}'}; "
            f"median level {np.rad2deg(np.median(judged.attitude_level[free])):.3g}°"
        )


def _table(campaign: Campaign) -> None:
    table = table_of(
        "at a risk of 1e-3",
        "condition | frames | tracked poses | misleading | below (95 %) | available %"
        f" | after {SETTLED} poses | median level ° | first poses | misleading | available %",
    )
    for name in (*CONDITIONS, None):
        tracked, first = campaign.rows(name, True), campaign.rows(name, False)
        frames = sum(campaign.frames.values()) if name is None else campaign.frames[name]
        wrong, of = int(tracked.misleading.sum()), len(tracked)
        free = tracked.attitude_level[~tracked.alarm]
        table.add_row(
            name or "all",
            str(frames),
            str(of),
            str(wrong),
            f"{upper_limit(wrong, of):.2g}",
            _percent(~tracked.alarm),
            _percent(~campaign.rows(name, True, SETTLED).alarm),
            f"{np.rad2deg(np.median(free)):.3g}" if len(free) else "–",
            str(len(first)),
            str(int(first.misleading.sum())),
            _percent(~first.alarm),
        )
    show(table, width=150)


def _percent(which: np.ndarray) -> str:
    return f"{100.0 * which.mean():.1f}" if len(which) else "–"
