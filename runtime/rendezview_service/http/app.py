"""The application: routes, page, health checks and the guard in front of them."""

from __future__ import annotations

import contextlib
import mimetypes
from collections.abc import AsyncIterator
from pathlib import Path

from fastapi import Depends, FastAPI, Request
from fastapi.security import HTTPBearer
from starlette.responses import Response
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Scope

from rendezview_service.http import (
    model_routes,
    recording_routes,
    session_routes,
    streams,
)
from rendezview_service.http.answers import answer_errors, service_of
from rendezview_service.http.security import Guard, Token
from rendezview_service.hub.health import VERSION
from rendezview_service.hub.service import Service
from rendezview_service.messages.message_parts import Health

PAGE = Path(__file__).parents[1] / "page"

# A minimal system may not know these types.
for _suffix, _type in {".js": "text/javascript", ".mjs": "text/javascript"}.items():
    mimetypes.add_type(_type, _suffix)


class _Page(StaticFiles):
    """The page's files; a browser asks each time and receives only what has changed."""

    async def get_response(self, path: str, scope: Scope) -> Response:
        response = await super().get_response(path, scope)
        response.headers["Cache-Control"] = "no-cache"
        return response


def page_files() -> StaticFiles:
    """The page."""
    return _Page(directory=PAGE, html=True)


def make_app(service: Service, tokens: list[Token]) -> ASGIApp:
    """The application of a service that is not started yet, behind its guard."""
    guard = Guard(make_routes(service), service.settings, tokens, service.metrics)
    service.budgets |= guard.budgets
    return guard


def make_routes(service: Service) -> FastAPI:
    """The application without a guard: for callers that have passed one."""

    @contextlib.asynccontextmanager
    async def life(_: FastAPI) -> AsyncIterator[None]:
        await service.start()
        try:
            yield
        finally:
            await service.stop()

    app = FastAPI(
        title="rendezview",
        summary="Where a spacecraft is relative to another one: frames in, poses out.",
        version=VERSION,
        docs_url=None,  # its scripts come from another server
        redoc_url=None,
        lifespan=life,
    )
    app.state.service = service
    answer_errors(app)
    app.router.routes.append(session_routes.FRAMES)  # before the routers, whose routes come later
    # Described only: `Guard` checks the tokens before a request arrives here.
    secured = [Depends(HTTPBearer(auto_error=False, description="a token of the tokens file"))]
    for routes in (session_routes, model_routes, recording_routes):
        app.include_router(routes.router, dependencies=secured)
    app.include_router(session_routes.flights, dependencies=secured)
    app.include_router(streams.router)

    @app.get("/healthz", tags=["operations"])
    async def healthz(request: Request) -> Health:
        """The service is alive."""
        return service_of(request).health()

    @app.get("/readyz", tags=["operations"], responses={503: {"model": Health}})
    async def readyz(request: Request, response: Response) -> Health:
        """The service can track frames."""
        health = service_of(request).health()
        response.status_code = 200 if health.status in ("ok", "degraded") else 503
        return health

    @app.get("/metrics", tags=["operations"], response_class=Response)
    async def metrics(request: Request) -> Response:
        """Metrics for Prometheus."""
        service = service_of(request)
        health = service.health()
        service.metrics.faults.set(len(health.reasons))
        return Response(
            service.metrics.text(health.budgets), 200, None, "text/plain; version=0.0.4"
        )

    if PAGE.is_dir():
        app.mount("/", page_files(), name="page")
    return app
