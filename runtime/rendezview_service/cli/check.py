"""``rendezview serve --check``: what the service needs, a line each, without starting it."""

from __future__ import annotations

import contextlib
import functools
import json
import os
import shutil
import ssl
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import numba

from rendezview.errors import RendezviewError, without_cache
from rendezview.io.file_lock import lock_if_possible
from rendezview.sensors.appearance import ViewModel
from rendezview_service.hub.model_store import SUFFIX
from rendezview_service.hub.session_defaults import SessionDefaults
from rendezview_service.logs.log_folder import last_unix_s
from rendezview_service.server import listen, tokens_of
from rendezview_service.settings import Settings

# Of a part of a log; of copies of models. Source: chosen
_LEAST_LOG_BYTES, _LEAST_BYTES = 1_000_000_000, 100_000_000
_AHEAD_S = 86_400.0  # s; a clock this far behind its files is wrong. Source: chosen
_ANSWER_S = 3.0  # s, for a service that runs. Source: chosen

# What is looked at, and what was found: raises an error with fault and remedy.
Check = tuple[str, Callable[[], str]]


def check(settings: Settings, model: Path | None) -> bool:
    """Print a line for each thing that the service needs; whether all is well."""
    well = True
    for name, look in checks(settings, model):
        try:
            print(f"OK     {name}: {look()}")
        except (RendezviewError, OSError) as error:
            well = False
            print(f"FAULT  {name}: {error}")
    return well


def checks(settings: Settings, model: Path | None) -> Iterator[Check]:
    """All checks, in the order of a start."""
    yield "settings", lambda: "valid"
    if settings.tokens_file is not None:
        yield f"tokens {settings.tokens_file}", lambda: f"{len(tokens_of(settings))} can be read"
    if settings.tls_certificate is not None:
        yield f"certificate {settings.tls_certificate}", lambda: _certificate(settings)
    if {settings.camera, settings.target, settings.approach, settings.plan} != {None}:
        yield "camera, target, approach, plan", lambda: _files(settings)
    folders = {name: folder for name, folder in settings if name.endswith("_folder")}
    folders |= {"record": settings.record_folder, "temporary files": Path(tempfile.gettempdir())}
    for name, folder in folders.items():
        if folder is not None:
            least = _LEAST_LOG_BYTES if name == "record" else _LEAST_BYTES
            yield f"{name} {folder}", functools.partial(_folder, folder, least)
    yield "clock", lambda: _clock(settings.record_folder)
    ports = [(settings.host, settings.port)]
    viewers = (settings.foxglove_port, settings.rerun_port)
    ports += [(settings.viewer_host, port) for port in viewers if port is not None]
    for host, port in ports:
        yield f"port {host}:{port}", functools.partial(_port, settings, host, port)
    folder = settings.models_folder
    stored = sorted(folder.glob(f"*{SUFFIX}")) if folder is not None and folder.is_dir() else []
    for path in [*([] if model is None else [model]), *stored]:
        yield f"model {path}", functools.partial(_model, path)
    yield "compiled loops", _cache


def _certificate(settings: Settings) -> str:
    assert settings.tls_certificate is not None
    try:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(settings.tls_certificate, settings.tls_key)
    except (ssl.SSLError, OSError) as error:
        raise RendezviewError(f"cannot be used ({error}): give a PEM file and its key") from None
    return "it and its key can be read"


def _files(settings: Settings) -> str:
    camera = SessionDefaults(settings).camera
    doubts = () if camera is None else camera.doubts
    return "; check: ".join(["can be read", *doubts])


def _folder(folder: Path, least_bytes: int) -> str:
    """Whether files can be made, locked and forced to the disk there, and its free space."""
    there = folder
    while not there.exists():
        there = there.parent
    if not os.access(there, os.W_OK | os.X_OK):
        raise RendezviewError(
            f"cannot be written: give the user of the service ({os.geteuid()}) the folder {there}"
        )
    notes = "" if there == folder else "will be made, "
    with tempfile.NamedTemporaryFile(dir=there, prefix=".rendezview-check-") as file:
        file.write(bytes(4096))
        file.flush()
        os.fsync(file.fileno())
        if lock_if_possible(file.fileno()) is None:
            notes += "no locks (no other service may use it), "
    free = shutil.disk_usage(there).free
    if free < least_bytes:
        raise RendezviewError(
            f"only {free / 1e9:.2f} GB are free, of {least_bytes / 1e9:g} GB at least: make room, "
            "or set logs_bytes to remove old logs"
        )
    return f"{notes}writable, {free / 1e9:.0f} GB free"


def _clock(logs: Path | None) -> str:
    """A clock behind what is on the disk has no battery or no network time."""
    now_s, newest = time.time(), Path(__file__)
    times = {newest: newest.stat().st_mtime}
    for path in logs.glob("*.mcap") if logs is not None and logs.is_dir() else ():
        with contextlib.suppress(OSError, RendezviewError):
            times[path] = last_unix_s(path)
    newest = max(times, key=lambda path: times[path])
    behind_s = times[newest] - now_s
    said = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(now_s))
    if behind_s > _AHEAD_S:
        raise RendezviewError(
            f"{said} is {behind_s / 86400:.0f} days before {newest}: set the clock, or remove the "
            "file if its date is wrong"
        )
    return said


def _port(settings: Settings, host: str, port: int) -> str:
    try:
        listen(host, port).close()
        return "free"
    except RendezviewError as taken:
        health = _health(settings, host, port)
        if health is None:
            raise taken from None
    if health["status"] != "ok":
        raise RendezviewError(
            f"a service answers: {health['status']}: {'; '.join(health['reasons'])}"
        )
    return f"a service answers, with {health['sessions']} sessions"


def _health(settings: Settings, host: str, port: int) -> dict | None:  # type: ignore[type-arg]
    """The health of the service that has the port; None: it is another program."""
    context = ssl._create_unverified_context()  # its own machine's
    scheme = "http" if settings.tls_certificate is None else "https"
    at = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
    url = f"{scheme}://{f'[{at}]' if ':' in at else at}:{port}/healthz"
    try:
        with urllib.request.urlopen(url, timeout=_ANSWER_S, context=context) as answer:
            found = json.load(answer)
    except (OSError, ValueError, urllib.error.HTTPError):
        return None
    return found if isinstance(found, dict) and {"status", "reasons"} <= set(found) else None


def _model(path: Path) -> str:
    model = ViewModel.load(path)
    return f"target {model.name}, {len(model.forest)} nodes"


def _cache() -> str:
    """Whether numba has a folder to keep loops in: else each process compiles for minutes."""
    try:
        probe = numba.njit(cache=True)(_nothing)
    except RuntimeError as error:
        raise without_cache(error) or error from None
    place = Path(probe._cache.cache_path)  # type: ignore[attr-defined]
    if not os.access(place, os.W_OK):
        raise RendezviewError(f"{place} cannot be written: set NUMBA_CACHE_DIR to one that can")
    return f"kept in {place}"


def _nothing() -> None:
    pass
