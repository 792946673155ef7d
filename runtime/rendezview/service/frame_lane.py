"""The way of the frames that come by HTTP: past the router and all that stands before it.

What the framework does around a route takes half as long as the service itself, at every frame.
"""

from __future__ import annotations

import re

from fastapi import FastAPI
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.types import ASGIApp, Receive, Scope, Send

from rendezview.service.answers import fault_of
from rendezview.service.session_routes import post_frame

_FRAMES = re.compile(r"/v1/sessions/([^/]+)/frames")


class FrameLane:
    """In front of the application."""

    def __init__(self, app: FastAPI) -> None:
        self._app = app
        self._rest: ASGIApp = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """ASGI."""
        post = scope["type"] == "http" and scope["method"] == "POST"
        found = _FRAMES.fullmatch(scope["path"]) if post else None
        if found is None:
            await self._rest(scope, receive, send)
            return
        scope["app"] = self._app
        request = Request(scope, receive, send)
        try:
            answer = await post_frame(request, found[1], _time_s(request))
        except Exception as error:
            told = fault_of(error)
            if told is None:
                raise
            answer = told
        await answer(scope, receive, send)


def _time_s(request: Request) -> float | None:
    text = request.query_params.get("time_s")
    try:
        return None if text is None else float(text)
    except ValueError:
        raise HTTPException(422, f"time_s: {text!r:.40} is no number") from None
