"""A short run of experiment service-faults: every route and method, sockets, frames, streams."""

from __future__ import annotations

from collections import Counter

from tests.service import fuzz_pictures
from tests.service.fuzz import campaign


def test_malformed_requests_neither_fail_nor_cost_much(start_service):
    served = start_service(RENDEZVIEW_SERVE_SENDER_HOLD_S="0")
    fuzz = campaign(served, seed=41, count=600, block=600)
    assert fuzz.failures == []
    kinds = Counter(name.split()[0].rstrip(":0123456789") for name in fuzz.outcomes.elements())
    assert {"raw", "stream"} <= set(kinds)  # each way was taken
    assert fuzz.outcomes["stream 409"] == 0  # none as of another sender: all were read
    assert served.process.poll() is None


def test_damaged_pictures_neither_fail_nor_cost_much():
    assert fuzz_pictures.campaign(seed=42, count=1500) == []
