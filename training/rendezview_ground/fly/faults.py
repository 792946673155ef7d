"""Faults of a flight: what breaks, when, for how long and by how much."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rendezview.errors import RendezviewError

# Kind: (longest, s; size). Source: the requirement; offset and radius as of `fusion-faults`.
_KINDS = {
    "camera": (30.0, 0.0),  # no frame of the camera
    "glare": (30.0, 0.0),  # grey levels of stray light at the brightest side; drawn
    "ring": (math.inf, 1.08),  # an edge of so many times the radius is taken for the ring
    "laser": (math.inf, 0.3),  # m, on every range
    "reflectors": (math.inf, 0.0),  # one of three is gone: they give no pose
    "thrust": (math.inf, 0.8),  # of the thrust, from the start
    "spin": (math.inf, 0.3),  # °/s more of the target, from the start
}
FAULTS = tuple(_KINDS)
_BEGIN_S = (20.0, 220.0)  # of a fault. Source: within a flight of 240 s
_GLARE_GREY = (100.0, 1600.0)  # log. Source: chosen, from harmless to white
_STREAM = 2  # of the seed


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault of a flight."""

    kind: str
    begin_s: float
    end_s: float
    size: float

    @classmethod
    def drawn(cls, kind: str, seed: int) -> Fault:
        """A fault that begins at a random time; glare of a random strength.

        Raises:
            RendezviewError: no such fault.
        """
        if kind not in _KINDS:
            raise RendezviewError(f"no fault {kind!r}: choose from {', '.join(FAULTS)}")
        longest_s, size = _KINDS[kind]
        rng = np.random.default_rng([_STREAM, seed])
        begin_s = float(rng.uniform(*_BEGIN_S))
        if kind == "glare":
            size = math.exp(rng.uniform(*np.log(_GLARE_GREY)))
        return cls(kind, begin_s, begin_s + longest_s, size)

    def strikes(self, kind: str, time_s: float) -> bool:
        """Whether it is this fault, now."""
        return self.kind == kind and self.begin_s <= time_s < self.end_s


def fault_of_run(kinds: tuple[str, ...], every: int, seed: int) -> str | None:
    """The fault of a run: each kind in turn, in one run of ``every``; None: none."""
    if not kinds or seed % every:
        return None
    return kinds[seed // every % len(kinds)]
