"""Routes of sessions: open, frames, states, history, logs; and of the flights attached to them."""

from __future__ import annotations

import json
import time
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query, Request
from fastapi.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.routing import Route

from rendezview_service.http.answers import (
    BINARY,
    BYTES,
    FAULTS,
    JSON,
    Opened,
    answered,
    body_in_docs,
    download,
    frame_head,
    key_of,
    measure,
    pieces_of,
    sender_of,
    sensor_name,
    service_of,
    session_of,
    track,
)
from rendezview_service.hub.health import info_of
from rendezview_service.hub.session_defaults import approach_of
from rendezview_service.hub.sessions import Session
from rendezview_service.logs.log_file import is_own
from rendezview_service.messages.approach_messages import ApproachRequest, Flight, Order, Orders
from rendezview_service.messages.fusion_messages import Marks, Measured
from rendezview_service.messages.message_parts import NAME_PATTERN
from rendezview_service.messages.messages import (
    Contour,
    EventList,
    History,
    SessionInfo,
    SessionList,
    SessionRequest,
    State,
)
from rendezview_service.messages.model_messages import Geometry
from rendezview_service.messages.ros import pose_with_covariance_stamped, transform_stamped
from rendezview_service.tracker.tracking import camera_of, contour_shown

router = APIRouter(prefix="/v1/sessions", tags=["sessions"], responses=FAULTS)
flights = APIRouter(prefix="/v1/sessions/{name}", tags=["flights"], responses=FAULTS)

_JPEG: dict[int | str, dict[str, Any]] = {200: {"content": {"image/jpeg": BINARY}}}
_MCAP: dict[int | str, dict[str, Any]] = {200: {"content": {BYTES: BINARY}}}
Frame = Annotated[int, Query(ge=0, le=2**53)]


@router.get("")
async def list_sessions(request: Request) -> SessionList:
    """All sessions."""
    sessions = service_of(request).sessions.values()
    return SessionList(sessions=[info_of(session) for session in sessions])


@router.post("", status_code=201)
async def open_session(request: Request, asked: SessionRequest) -> SessionInfo:
    """Open a session: a camera and a target. With an ``Idempotency-Key`` it may be repeated."""
    service = service_of(request)

    async def opened() -> str:
        return (await service.open(asked)).id

    name = await service.once.do(key_of(request), asked.model_dump_json(), opened)
    return info_of(session_of(request, name))


@router.get("/{name}")
async def get_session(session: Opened) -> SessionInfo:
    """The present state of a session."""
    return info_of(session)


@router.delete("/{name}", status_code=204)
async def close_session(request: Request, session: Opened) -> None:
    """End a session and complete its log."""
    await service_of(request).close(session, "closed by a request")


def _number(text: str) -> float | str:
    """The number of a part of a query; other text remains, for the message."""
    try:
        return float(text)
    except ValueError:
        return text


@router.post(
    "/{name}/frames",
    openapi_extra=body_in_docs(dict.fromkeys(("image/png", "image/jpeg", BYTES), BINARY)),
    responses={200: {"model": State}, 410: FAULTS[404]},
)
async def post_frame(
    request: Request, name: str, time_s: float | None = None,
    roi: Annotated[str | None, Query(description="of the target: x,y,width,height, px")] = None,
) -> Response:  # fmt: skip
    """Track a frame: PNG, JPEG, or width × height grey bytes."""
    session = session_of(request, name)
    given = {"time_s": time_s, "roi": None if roi is None else [*map(_number, roi.split(","))]}
    head = frame_head(given, "the frame")
    pieces = await pieces_of(request, session.frame_bytes)
    if not any(pieces):
        raise HTTPException(422, "the frame is empty: send a PNG, a JPEG or grey bytes")
    told = sender_of(request), key_of(request)
    return answered(await track(session, pieces, head, *told))


async def _post_frame(request: Request) -> Response:
    time_s, roi = (request.query_params.get(name) for name in ("time_s", "roi"))
    given: Any = None if time_s is None else _number(time_s)
    return await post_frame(request, request.path_params["name"], given, roi)


# Frames take this plain route. It costs 0.06 ms per frame where FastAPI's costs 0.15 ms (median of
# 30 × 200 requests of 640 × 480 bytes in one process); FastAPI's only documents it.
FRAMES = Route("/v1/sessions/{name}/frames", _post_frame, methods=["POST"])


@router.post(
    "/{name}/measurements",
    openapi_extra=body_in_docs(
        {
            "application/json": {"schema": {"type": "object"}},
            "application/x-ndjson": {"schema": {"type": "string"}},
        }
    ),
    responses={200: {"model": Measured}, 410: FAULTS[404]},
)
async def post_measurements(
    request: Request,
    session: Opened,
    sensor: Annotated[str, Query(pattern=NAME_PATTERN, description="its name; not camera")],
) -> Response:
    """Give the session's filter lines of another sensor's log: as `ring`, `reflectors`,
    `stereo track` and `track` write them, or of a ranger (`range_m`, `sigma_m`)."""
    sensor_name(sensor)
    return answered(await measure(session, sensor, await request.body(), key_of(request)))


@router.get(
    "/{name}/state",
    responses={200: {"model": State, "description": "or geometry_msgs, field for field"}},
)
async def get_state(
    session: Opened,
    as_: Annotated[
        Literal["state", "pose_with_covariance_stamped", "transform_stamped"], Query(alias="as")
    ] = "state",
) -> Response:
    """The last state; 404 if there is none (for a ROS type: no pose)."""
    last = session.progress.last
    if last is None:
        raise HTTPException(404, "no frame has been tracked yet")
    if as_ == "state":
        return Response(last, 200, None, JSON)
    convert = transform_stamped if as_ == "transform_stamped" else pose_with_covariance_stamped
    message = convert(json.loads(last))
    if message is None:
        raise HTTPException(404, "the last frame gave no pose: its state has the reason")
    return Response(json.dumps(message), 200, None, JSON)


@router.get("/{name}/history", responses={200: {"model": History}})
async def get_history(
    session: Opened,
    seconds: Annotated[float, Query(gt=0.0, le=1e6)] = 300.0,
    limit: Annotated[int, Query(ge=1, le=100_000)] = 2000,
    since_frame: Frame = 0,
) -> Response:
    """States of the last minutes, evenly thinned to at most ``limit``."""
    states = session.past.states(time.monotonic() - seconds, since_frame, limit)
    head = {
        "session": session.id,
        "oldest_frame": states[0][0] if states else None,
        "newest_frame": states[-1][0] if states else None,
        "images": session.past.image_frames,
    }
    text = json.dumps(head).encode()
    joined = b",".join(state for _, state in states)
    return Response(text[:-1] + b',"states":[' + joined + b"]}", 200, None, JSON)


@router.get("/{name}/images/{frame}", responses=_JPEG, response_class=Response)
async def get_image(session: Opened, frame: int) -> Response:
    """The JPEG of a frame, or of the last frame before it that has one."""
    shown, picture, _ = _kept(session, frame)
    headers = {"X-Frame": str(shown), "Cache-Control": "private, max-age=600"}
    return Response(picture, 200, headers, "image/jpeg")


@router.get("/{name}/marks/{frame}", responses={200: {"model": list[Marks]}})
async def get_marks(session: Opened, frame: int) -> Response:
    """Ellipses and spots of other sensors in the picture that is kept for a frame."""
    return Response(_kept(session, frame)[2], 200, None, JSON)


def _kept(session: Session, frame: int) -> tuple[int, bytes, bytes]:
    kept = session.past.image(frame)
    if kept is None:
        raise HTTPException(404, f"no picture of frame {frame} or earlier is kept")
    return kept


@router.get("/{name}/contour/{frame}")
async def get_contour(session: Opened, frame: int) -> Contour | None:
    """Contour points at the pose of a frame; null without a pose."""
    kept = session.past.state(frame)
    if kept is None:
        raise HTTPException(404, f"no state of frame {frame} or earlier is kept")
    model = await run_in_threadpool(lambda: session.stored.model)
    assert session.request.camera is not None
    return contour_shown(model, camera_of(session.request.camera), json.loads(kept))


@router.get("/{name}/events")
async def get_events(session: Opened, since: Frame = 0) -> EventList:
    """What happened, from an event's number on."""
    return EventList(events=session.events.since(since))


@router.get("/{name}/approach")
async def get_approach(session: Opened) -> ApproachRequest:
    """Port, corridor, keep-out zone, limits and plan of a session, as its frames are compared."""
    return approach_of(session.request)


@router.get("/{name}/geometry", responses={200: {"model": Geometry}})
async def get_geometry(session: Opened) -> Response:
    """Data for a 3-D view of the session's model."""
    text = await run_in_threadpool(lambda: session.stored.geometry_json)
    return Response(text, 200, {"Cache-Control": "private, max-age=600"}, JSON)


@router.get("/{name}/log", responses=_MCAP, response_class=Response)
async def get_log(session: Opened) -> Response:
    """The log so far, all its parts, as one complete MCAP file."""
    parts = session.log.parts
    if not parts:
        raise HTTPException(404, "this session is not recorded")
    return await download(parts[0].path.name, [part for part in parts if is_own(part.path)])


@flights.put("/flight")
async def report_flight(session: Opened, flight: Flight) -> Orders:
    """A flight says what it does, at least every ten seconds; the orders since its last report."""
    return Orders(orders=session.flight.reported(flight))


@flights.post("/orders", status_code=204)
async def order(session: Opened, order: Order) -> None:
    """An order of the operator to the flight, which takes it at its next step."""
    if not session.flight.order(order):
        raise HTTPException(
            409, "no flight with this switch is attached: see `flight` of the session"
        )
