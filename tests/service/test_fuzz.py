"""A short run of experiment service-fuzz: every route and method, sockets, frames, streams."""

from __future__ import annotations

from collections import Counter

from tests.service.fuzz import SESSION, Fuzz

CASES = 600


def test_malformed_requests_neither_fail_nor_cost_much(start_service):
    served = start_service()
    fuzz = Fuzz(served, seed=41)
    with served.client() as client:
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
