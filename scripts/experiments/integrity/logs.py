"""The logs of integrity-draw: looks in their order, and their errors."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.integrity.draw import SECOND_EVERY
from rendezview.io.results import read_json_lines
from rendezview.sensors.appearance.integrity.evidence import Evidence, Second

# A pose is another answer than the truth where its error is larger than this and beyond its tails.
WRONG_DEG = 5.0  # of attitude, as in the experiments of poses
WRONG_SHARE = 0.1  # of the range
WRONG_SIGMA = 6.0  # standard deviations along the longest axis of the covariance


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """One look at one frame."""

    condition: str
    evidence: Evidence | None  # None: no pose
    second: Second | None
    asked: bool  # whether the second witness was
    error: np.ndarray | None  # (6,) from the pose to the truth; None: another target
    misled: bool  # the track began at a wrong prior on purpose

    @property
    def ask(self) -> Callable[[], Second | None] | None:
        """The second witness, where it was asked."""
        return (lambda: self.second) if self.asked else None

    @property
    def turn_rad(self) -> float:
        return np.inf if self.error is None else float(np.linalg.norm(self.error[:3]))

    @property
    def move_m(self) -> float:
        return np.inf if self.error is None else float(np.linalg.norm(self.error[3:]))

    @property
    def wrong(self) -> bool:
        """Another answer than the truth."""
        assert self.evidence is not None
        turned = _beyond(self.turn_rad, np.deg2rad(WRONG_DEG), self.evidence.covariance[:3, :3])
        moved = WRONG_SHARE * self.evidence.range_m
        return turned or _beyond(self.move_m, moved, self.evidence.covariance[3:6, 3:6])


def _beyond(length: float, least: float, covariance: np.ndarray) -> bool:
    spread = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    return length > max(least, WRONG_SIGMA * spread)


def tracks(folder: Path) -> Iterator[list[Look]]:
    """The looks of each track, in order."""
    for path in sorted(folder.glob("*.jsonl")):
        tracked: dict[tuple[int, ...], list[Look]] = {}
        poses: Counter[tuple[int, ...]] = Counter()
        for line in read_json_lines(path):
            name, evidence, second = tuple(line["sequence"]), line["evidence"], line["second"]
            asked = evidence is not None and poses[name] % SECOND_EVERY == 0
            poses[name] += evidence is not None
            look = Look(
                line["condition"],
                None if evidence is None else Evidence.of_record(evidence),
                None if second is None else Second(**second), asked,
                None if line["error"] is None else np.array(line["error"]), line["misled"],
            )  # fmt: skip
            tracked.setdefault(name, []).append(look)
        yield from tracked.values()
