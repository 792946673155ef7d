"""The order of pictures by their times: late ones sorted, doubled and missing ones left out."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rendezview.io.ccsds import DATED_S


def in_order(times_s: Sequence[float], lead: int = 0) -> tuple[list[int], list[str]]:
    """Numbers of the pictures that are used, by their times, and notes on the others.

    Args:
        times_s: of all pictures, as they come.
        lead: the first ones, of a video, that cannot be decoded.
    """
    # 0 is where durations begin. Among dates, and later, it is no stamp.
    others = [time_s for time_s in times_s if time_s != 0.0]
    begins = bool(others) and min(others) < DATED_S
    stamped = [
        k
        for k in range(lead, len(times_s))
        if times_s[k] != 0.0 or not others or (begins and k == lead)
    ]
    order: list[int] = []
    latest, late = -math.inf, 0
    for k in stamped:
        late += times_s[k] < latest
        latest = max(latest, times_s[k])
    for k in sorted(stamped, key=lambda k: times_s[k]):
        if not order or times_s[k] > times_s[order[-1]]:
            order.append(k)
    counts = (
        (late, "come after pictures of a later stamp: sorted by their stamps"),
        (len(stamped) - len(order), "have the stamp of another one: left out"),
        (len(times_s) - lead - len(stamped), "have no stamp: left out"),
        (lead, "come before the first key picture of the video: left out"),
    )
    return order, [f"{n} of {len(times_s)} pictures {words}" for n, words in counts if n]
