"""Malformed frames, requests and messages by the ten thousand."""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

from experiments.frame import tests_module
from experiments.service.serving import serve
from rendezview import Client

harness = tests_module("service.fuzz")


# Cases of a block.
PARTS = {"by_routes": 1800, "by_http": 100, "by_stream": 100}


def run(
    model: Path,
    *,
    count: int = 50000,
    minutes: float = 600.0,
    seed: int = 0,
    hostile_s: float = 0.0,
) -> None:
    """Malformed frames and messages, by the ten thousand: none may crash, hang or leak.

    Most cases go to every route with every method, pictures among them, and to the socket itself.
    One in twenty is a damaged frame of any kind, lines of other sensors or JSON that is almost
    right, by HTTP, and one in twenty the same by WebSocket: these cost a search each. No block of
    cases begins after so many minutes. Failures: a server error (5xx other than 503), an answer
    that takes more than 10 s, more than 5 s of processor time or 200 MB for a case, a worker that
    ends, a session that remains, or a service that no longer tracks a good frame. With --hostile-s,
    clients that take what they can instead, each for so many seconds beside an innocent one.
    """
    if hostile_s:
        clients = tests_module("service.hostile_clients")
        with tempfile.TemporaryDirectory() as logs:
            served = serve(model, "--record", logs, record_all="false")
            for line in clients.campaign(served, Path(logs), hostile_s):
                print(line, flush=True)
            served.stop()
        return
    served = serve(model, spare_worker="false")
    fuzz, start = harness.Fuzz(served, seed), time.monotonic()
    with Client(served.url) as client:
        fuzz.open(client)
        fuzz.still_tracks()
        before = served.resident_mb()
        done = 0
        while done < count and time.monotonic() < start + 60.0 * minutes:
            for part, size in PARTS.items():
                getattr(fuzz, part)(size)
                done += size
            fuzz.still_tracks()
            told = f"{done} cases, {len(fuzz.failures)} failures, {served.resident_mb():.0f} MB"
            print(told, file=sys.stderr, flush=True)
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
    print(f"seed {seed}: {done} cases in {spent:.0f} s, {len(fuzz.failures)} failures")
    print(", ".join(f"{name}: {count}" for name, count in fuzz.outcomes.most_common()))
    print(f"memory {before:.0f} MB before, {after:.0f} MB after")
    print(f"most for one case {fuzz.worst_s[0]:.2f} s of processor time ({fuzz.worst_s[1]})")
    print(f"most memory for one case {fuzz.worst_mb[0]:.0f} MB ({fuzz.worst_mb[1]})")
    for failure in fuzz.failures[:20]:
        print(failure)
    if fuzz.failures:
        print("\n".join(["the service's last lines:", *list(served.lines)[-40:]]))
    sys.exit(bool(fuzz.failures))
