"""Malformed frames, requests and messages by the ten thousand."""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

from experiments.frame import tests_module
from experiments.service.serving import Served
from rendezview_service.client import Client

harness = tests_module("service.fuzz")


def run(model: Path, *, count: int = 50000, seed: int = 0, hostile_s: float = 0.0) -> None:
    """Malformed frames and messages, by the ten thousand: none may crash, hang or leak.

    Half of the cases go to every route with every method, and to the socket itself; a quarter are
    damaged frames of all kinds, lines of other sensors and JSON that is almost right, by HTTP; a
    quarter the same by WebSocket. Failures: a server error (5xx other than 503), an answer that
    takes more than 10 s, more than 5 s of processor time or 200 MB for a case, a worker that ends,
    a session that remains, or a service that no longer tracks a good frame. With --hostile-s,
    clients that take what they can instead, each for so many seconds beside an innocent one.
    """
    if hostile_s:
        clients = tests_module("service.hostile_clients")
        with tempfile.TemporaryDirectory() as logs:
            served = Served(model, "--record", logs, record_all="false")
            served.await_ready()
            for line in clients.campaign(served, Path(logs), hostile_s):
                print(line, flush=True)
            served.stop()
        return
    served = Served(model, spare_worker="false")
    served.await_ready()
    fuzz, start = harness.Fuzz(served, seed), time.monotonic()
    with Client(served.url) as client:
        fuzz.open(client)
        fuzz.still_tracks()
        before = served.resident_mb()
        for part, share in ((fuzz.by_routes, 2), (fuzz.by_http, 4), (fuzz.by_stream, 4)):
            part(count // share)
            print(f"{part.__name__}: {len(fuzz.failures)} failures", file=sys.stderr, flush=True)
        fuzz.still_tracks()
        sessions = [s["id"] for s in client.sessions()]
        ended, after = harness.RESTARTS not in client.fetch("GET", "/metrics"), served.resident_mb()
    served.stop()
    if sessions != [harness.SESSION]:
        fuzz.failures.append(f"sessions stay: {sessions}")
    if after - before > harness.MOST_MB:
        fuzz.failures.append(f"memory grew by {after - before:.0f} MB in all")
    if ended:
        fuzz.failures.append("workers ended")
    spent = time.monotonic() - start
    print(f"seed {seed}: {count} cases in {spent:.0f} s, {len(fuzz.failures)} failures")
    print(", ".join(f"{name}: {count}" for name, count in fuzz.outcomes.most_common()))
    print(f"memory {before:.0f} MB before, {after:.0f} MB after")
    print(f"most for one case {fuzz.worst_s[0]:.2f} s of processor time ({fuzz.worst_s[1]})")
    print(f"most memory for one case {fuzz.worst_mb[0]:.0f} MB ({fuzz.worst_mb[1]})")
    for failure in fuzz.failures[:20]:
        print(failure)
    if fuzz.failures:
        print("\n".join(["the service's last lines:", *served.log[-40:]]))
    sys.exit(bool(fuzz.failures))
