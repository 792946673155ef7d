"""Routes of recordings: the logs of the service's folder, to look back at."""

from __future__ import annotations

import json
from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request
from fastapi.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.responses import Response

from rendezview_service.http.answers import FAULTS, JSON, download, found, service_of
from rendezview_service.hub.session_defaults import approach_of
from rendezview_service.hub.session_events import events_of
from rendezview_service.logs.log_file import reading
from rendezview_service.logs.log_repair import LogPart
from rendezview_service.logs.recordings import Recording
from rendezview_service.messages.approach_messages import ApproachRequest
from rendezview_service.messages.messages import Contour, History
from rendezview_service.messages.model_messages import Geometry, RecordedList

router = APIRouter(prefix="/v1/recordings", tags=["recordings"], responses=FAULTS)


async def _found(request: Request, name: str) -> Recording:
    with reading(name[:80]):
        known = await run_in_threadpool(service_of(request).recordings.get, name)
    return found(known, f"recording {name[:80]!r}", "/v1/recordings")


Logged = Annotated[Recording, Depends(_found)]


@router.get("")
async def list_recordings(request: Request) -> RecordedList:
    """The logs of the service's folder, the newest first."""
    return RecordedList(recordings=await run_in_threadpool(service_of(request).recordings.list))


@router.get("/{name}/history", responses={200: {"model": History}})
async def get_history(
    recording: Logged, limit: Annotated[int, Query(ge=1, le=20_000)] = 2000
) -> Response:
    """States of a log, evenly thinned to at most ``limit``, and the events in these."""

    def answer() -> bytes:
        history = recording.history(limit)
        events = [event.model_dump(mode="json") for event in events_of(history["states"])]
        return json.dumps(history | {"events": events}).encode()

    return Response(await run_in_threadpool(answer), 200, None, JSON)


@router.get("/{name}/images/{frame}", response_class=Response)
async def get_image(recording: Logged, frame: int) -> Response:
    """The picture of a frame that ``history`` listed, or of the last one before it."""
    shown = await run_in_threadpool(recording.picture, frame)
    if shown is None:
        raise HTTPException(404, f"no picture of frame {frame} or earlier is in this log")
    return Response(shown[1], 200, {"X-Frame": str(shown[0])}, shown[2])


@router.get("/{name}/contour/{frame}")
async def get_contour(recording: Logged, frame: int) -> Contour | None:
    """Contour points at the pose of a frame; null without a pose."""
    return await run_in_threadpool(recording.contour, frame)


@router.get("/{name}/geometry", responses={200: {"model": Geometry}})
async def get_geometry(recording: Logged) -> Response:
    """Data for a 3-D view of the log's model."""
    text = await run_in_threadpool(lambda: recording.geometry_json)
    return Response(text, 200, None, JSON)


@router.get("/{name}/approach")
async def get_approach(recording: Logged) -> ApproachRequest:
    """Port, corridor, keep-out zone, limits and plan of the log's session."""
    return approach_of(recording.request)


@router.get("/{name}/log", response_class=Response)
async def get_log(recording: Logged) -> Response:
    """The log with all its parts as one complete MCAP file."""
    parts = [LogPart(path, path.stat().st_size) for path in recording.log.parts]
    return await download(recording.path.name, parts)
