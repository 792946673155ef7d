"""Runs the application with uvicorn."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import os
import resource
import socket
import sys
import threading
from collections.abc import Callable
from types import FrameType

import uvicorn
from starlette.types import ASGIApp

from rendezview.errors import RendezviewError
from rendezview_service.http.app import make_app
from rendezview_service.http.connections import BoundedProtocol, BoundedSocket, bounded
from rendezview_service.http.security import Token, read_tokens
from rendezview_service.http.streams import MOST_HEAD
from rendezview_service.hub.service import Service
from rendezview_service.settings import Settings

_OTHER_FILES = 200  # files that are open beside connections. Source: a chosen limit
_SHUTDOWN_S = 2  # s, for open requests. Source: chosen
_LEAVE_S = 2.0  # s, for threads that are still at work at the end. Source: chosen
_LOOK_S = 0.1  # s, between looks whether the service can track. Source: chosen


class _Server(uvicorn.Server):
    """Reports its address once it listens."""

    on_listening: Callable[[str], None] = staticmethod(lambda address: None)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        if self.config.ssl is not None:
            # A ticket that a client's thread receives while another one writes can stop the write
            # for ever: Python's ssl before 3.13, in one of 300 streams that open.
            self.config.ssl.num_tickets = 0
        await super().startup(sockets)
        gc.collect()
        gc.freeze()  # what exists now stays: the collector need not scan it again
        if self.started and sockets:
            host, port = sockets[0].getsockname()[:2]
            scheme = "https" if self.config.is_ssl else "http"
            address = f"{scheme}://{f'[{host}]' if ':' in host else host}:{port}/"
            self.on_listening(address)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        await super().shutdown(sockets)
        # Logs and checkpoints are complete. A thread that waits for a disk must not stay for ever.
        end = threading.Timer(_LEAVE_S, os._exit, (0,))
        end.daemon = True
        end.start()

    def stop(self) -> None:
        """End the service in order."""
        self.should_exit = True

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """The first signal ends the service in order, with code 0; the second ends it at once."""
        self.force_exit = self.should_exit
        self.should_exit = True


def run(
    service: Service,
    on_ready: Callable[[str], None],
    on_listening: Callable[[str], None] = lambda address: None,
) -> None:
    """Serve until SIGINT or SIGTERM; the logs are complete afterwards.

    Args:
        on_ready: receives the address once the service can track.
        on_listening: the same before; page and health answer from then on.

    Raises:
        RendezviewError: the address is taken, or the service cannot start.
    """
    settings = service.settings
    app = make_app(service, tokens_of(settings))
    protocol = bounded(_connections(settings.connections))
    service.budgets |= protocol.budgets()
    server = _Server(_config(app, settings, protocol))
    service.on_failure = server.stop
    telling: set[asyncio.Task[None]] = set()  # as long as it runs

    async def tell(address: str) -> None:
        while (status := service.health().status) == "not ready" and service.failure is None:
            await asyncio.sleep(_LOOK_S)
        if status in ("ok", "degraded"):
            on_ready(address)

    def listens(address: str) -> None:
        on_listening(address)
        telling.add(asyncio.create_task(tell(address)))

    _serve(server, settings, listens)
    if isinstance(service.failure, RendezviewError):
        raise service.failure
    if service.failure is not None:
        raise RendezviewError(f"the service cannot start: {service.failure}") from service.failure


def run_gateway(settings: Settings, on_ready: Callable[[str], None]) -> None:
    """Serve as a gateway of a Ray cluster. Errors as in `run`."""
    from rendezview_service.cluster.gateway import make_gateway

    app = make_gateway(settings, tokens_of(settings))
    protocol = bounded(_connections(settings.connections))
    _serve(_Server(_config(app, settings, protocol)), settings, on_ready)


def tokens_of(settings: Settings) -> list[Token]:
    """The tokens of the settings' file. Errors as in `read_tokens`."""
    return [] if settings.tokens_file is None else read_tokens(settings.tokens_file)


def _config(app: ASGIApp, settings: Settings, protocol: type[BoundedProtocol]) -> uvicorn.Config:
    return uvicorn.Config(
        app,
        http=protocol,
        ws=BoundedSocket,
        loop="uvloop" if sys.platform != "win32" else "asyncio",
        lifespan="on",
        access_log=False,
        log_config=None,
        server_header=False,
        ws_max_size=settings.frame_bytes + MOST_HEAD,
        ws_per_message_deflate=False,  # frames hardly compress
        ws_ping_interval=20.0,
        ws_ping_timeout=20.0,
        timeout_graceful_shutdown=_SHUTDOWN_S,
        timeout_keep_alive=75,
        limit_concurrency=None,
        ssl_certfile=settings.tls_certificate,
        ssl_keyfile=settings.tls_key,
    )


def _serve(server: _Server, settings: Settings, on_listening: Callable[[str], None]) -> None:
    server.on_listening = on_listening
    listener = listen(settings.host, settings.port)
    try:
        with contextlib.suppress(KeyboardInterrupt):
            server.run(sockets=[listener])
    except SystemExit:
        pass
    except OSError as error:
        raise RendezviewError(f"the service cannot start: {error}") from None
    finally:
        listener.close()


def _connections(wanted: int) -> int:
    """As many as wanted, or as open files allow: for a moment there are twice so many."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = 2 * wanted + _OTHER_FILES
    if soft != resource.RLIM_INFINITY and soft < needed:
        allowed = needed if hard == resource.RLIM_INFINITY else min(needed, hard)
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (allowed, hard))
            soft = allowed
    most = wanted if soft == resource.RLIM_INFINITY else (soft - _OTHER_FILES) // 2
    return max(1, min(wanted, most))


def listen(host: str, port: int) -> socket.socket:
    """A socket at an address. Raises: RendezviewError: it is taken, or not this machine's."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
    except OSError as error:
        listener.close()
        raise RendezviewError(
            f"{host}:{port}: cannot listen there ({error.strerror}): choose another --port"
        ) from None
    return listener
