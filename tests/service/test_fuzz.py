"""A short run of experiment service-fuzz: every route and method, sockets, frames, streams."""

from __future__ import annotations

from collections import Counter

from tests.service import fuzz as fuzz_module
from tests.service.fuzz import SESSION, Fuzz
from tests.waiting import MOST_S

from experiments.service.serving import Processes
from rendezview_service.client import Client

CASES = 600


def test_malformed_requests_neither_fail_nor_cost_much(start_service, monkeypatch):
    monkeypatch.setattr(fuzz_module, "SLOW_S", MOST_S)  # processor time and memory count here
    served = start_service()
    fuzz = Fuzz(Processes(served.url, served.process.pid), seed=41)
    with Client(served.url) as client:
        fuzz.open(client)
        fuzz.by_routes(CASES // 2)
        fuzz.by_http(CASES // 4)
        fuzz.by_stream(CASES // 4)
        fuzz.still_tracks()
        assert [one["id"] for one in client.sessions()] == [SESSION]
        assert b"rendezview_worker_restarts_total 0.0" in client.fetch("GET", "/metrics")
    assert fuzz.failures == []
    kinds = Counter(name.split()[0].rstrip(":0123456789") for name in fuzz.outcomes.elements())
    assert {"raw", "stream"} <= set(kinds)  # each way was taken
    assert served.process.poll() is None
