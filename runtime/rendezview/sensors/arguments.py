"""Arguments of the sensors that are of another type, or in another order, than they should be."""

from __future__ import annotations

import math
import numbers
from typing import Any

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Pose

# s; cameras date frames in whole nanoseconds, and rates of nearer ones overflow. Source: ROS, MCAP
_SHORTEST_S = 0.999e-9
_Recognizer = type("Recognizer", (), {})  # its name; sensors do not import each other


def check_types(call: str, *arguments: tuple[Any, type]) -> None:
    """Refuse arguments that are not of their types.

    Args:
        call: how it should have been written.
        arguments: each with its type.

    Raises:
        RendezviewError: one is of another type.
    """
    for value, kind in arguments:
        if not isinstance(value, kind):
            name = "number" if kind is numbers.Real else kind.__name__
            raise RendezviewError(
                f"{type(value).__name__} in place of {name}: it is called as {call}"
            )


def check_recognizer(value: Any) -> None:
    """Refuse what recognises nothing.

    Raises:
        RendezviewError: such as a model.
    """
    if not hasattr(value, "recognize"):
        check_types("Tracker(Recognizer(model, camera))", (value, _Recognizer))


def check_time(time_s: Any, last_s: float) -> None:
    """Refuse a time that does not follow, and what is no time.

    Raises:
        RendezviewError: no number: the arguments are in another order.
        ValueError: not finite, or not later than the last one by a nanosecond.
    """
    check_types("update(time_s, image), with the time in seconds first", (time_s, numbers.Real))
    if not (math.isfinite(time_s) and time_s - last_s >= _SHORTEST_S):
        raise ValueError(f"frames must come in order of time: {time_s} s after {last_s} s")


def check_prior(prior: Any) -> Pose | None:
    """The prior, if it is a pose or None.

    Raises:
        RendezviewError: another thing, such as a matrix.
    """
    if prior is not None:
        check_types("prior=Pose.from_matrix(matrix)", (prior, Pose))
    found: Pose | None = prior
    return found
