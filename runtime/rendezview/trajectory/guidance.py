"""From a fitted segment and a plan to a correction: how far off, and the Δv back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rendezview.geometry.pose import Array
from rendezview.trajectory.no_fit import NoFit
from rendezview.trajectory.plan import Plan
from rendezview.trajectory.relative_orbit import transition, velocity_to_reach
from rendezview.trajectory.segment import Segment

# Of the distance to the target: a plan farther off is another one. Source: a chosen limit
_FARTHEST = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """What brings the craft back to the plan, in the plan's axes."""

    time_s: float  # when the change of velocity is given
    reach_s: float  # when the place is the plan's again
    error_m: Array  # (3,) fitted place less the planned one, now
    predicted_error_m: Array  # (3,) the same at ``reach_s``, if nothing is done
    predicted_sigma_m: float  # one σ of that, in its worst direction
    delta_v_m_s: Array  # (3,) change of velocity now
    arrival_delta_v_m_s: Array  # (3,) that at ``reach_s`` which makes the velocity the plan's

    @property
    def size_m_s(self) -> float:
        """Of the change of velocity."""
        return float(np.linalg.norm(self.delta_v_m_s))

    @property
    def direction(self) -> Array | None:
        """(3,) unit, of the thrust; None where there is nothing to correct."""
        return None if self.size_m_s == 0.0 else self.delta_v_m_s / self.size_m_s


def correct(segment: Segment, plan: Plan, time_s: float, reach_s: float) -> Correction | NoFit:
    """The impulse at ``time_s`` that leads back to the plan at ``reach_s``.

    Thrusts superpose on the craft's present motion, forced or not: the shift of the place
    at ``reach_s`` needs Δv = Φ_rv⁻¹ (planned − predicted), Φ of Clohessy and Wiltshire, or of
    motion without gravity where the plan has no orbit.
    """
    if not np.isfinite([time_s, reach_s]).all() or reach_s <= time_s:
        return NoFit(f"no time to correct in: from {time_s:g} s to {reach_s:g} s")
    missing = plan.out_of(time_s) or plan.out_of(reach_s)
    if missing is not None:
        return NoFit(missing)
    now, then = segment.places([time_s, reach_s])
    planned_now, planned_then = plan.places([time_s, reach_s])
    error_m = now - planned_now
    far = min(np.linalg.norm(now), np.linalg.norm(planned_now))
    if np.linalg.norm(error_m) > _FARTHEST * far:
        return NoFit(
            f"the plan is {np.linalg.norm(error_m):.3g} m away at a range of "
            f"{np.linalg.norm(now):.3g} m: the craft does not fly it"
        )
    shift_m = planned_then - then
    dt_s = reach_s - time_s
    delta_v = velocity_to_reach(plan.mean_motion_rad_s, dt_s, shift_m)
    if delta_v is None:
        return NoFit(f"no thrust now shifts the place in {dt_s:.0f} s: near half an orbit")
    moved = transition(plan.mean_motion_rad_s, dt_s)[3:, 3:] @ delta_v
    arrival = plan.velocity(reach_s) - segment.velocity(reach_s) - moved
    spread = np.linalg.eigvalsh(segment.place_covariance(reach_s))[-1]
    return Correction(time_s, reach_s, error_m, -shift_m, float(np.sqrt(spread)), delta_v, arrival)
