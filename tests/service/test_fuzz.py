"""A short run of experiment service-fuzz: every route and method, sockets, frames, streams."""

from __future__ import annotations

from collections import Counter

from experiments.service.fuzz import CAMERA, RING, Fuzz
from experiments.service.serving import Processes
from rendezview.client import Client

CASES = 600


def test_malformed_requests_neither_fail_nor_cost_much(start_service):
    served = start_service()
    fuzz = Fuzz(Processes(served.url, served.process.pid), seed=41)
    with Client(served.url) as client:
        session = client.open(CAMERA, name="fuzzed", fusion={"ring": RING}, idle_s=3600.0)
        fuzz.by_routes(CASES // 2, "fuzzed")
        fuzz.by_http(CASES // 4, "fuzzed")
        fuzz.by_stream(CASES // 4, "fuzzed")
        fuzz.still_tracks()
        assert [one["id"] for one in client.sessions()] == ["fuzzed"]
        assert b"rendezview_worker_restarts_total 0.0" in client.fetch("GET", "/metrics")
        session.close()
    assert fuzz.failures == []
    kinds = Counter(name.split()[0].rstrip(":0123456789") for name in fuzz.outcomes.elements())
    assert {"raw", "stream"} <= set(kinds)  # each way was taken
    assert served.process.poll() is None
