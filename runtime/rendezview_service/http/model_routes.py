"""Routes of models and trainings."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Query, Request
from fastapi.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.responses import Response

from rendezview.errors import RendezviewError
from rendezview_service.http.answers import (
    BINARY,
    BYTES,
    FAULTS,
    JSON,
    body_in_docs,
    file_of,
    found,
    key_of,
    service_of,
)
from rendezview_service.hub.jobs import Job
from rendezview_service.hub.model_store import StoredModel
from rendezview_service.messages.message_parts import Name
from rendezview_service.messages.model_messages import (
    Geometry,
    JobInfo,
    JobList,
    ModelInfo,
    ModelList,
)

router = APIRouter(prefix="/v1", tags=["models"], responses=FAULTS)

_BODY = body_in_docs({BYTES: BINARY})


async def _job(request: Request, job_id: str) -> Job:
    return found(service_of(request).jobs.get(job_id), f"training {job_id[:80]!r}", "/v1/jobs")


async def _stored(request: Request, name: str) -> StoredModel:
    return found(service_of(request).models.get(name), f"model {name[:80]!r}", "/v1/models")


Stored = Annotated[StoredModel, Depends(_stored)]


@router.get("/models")
async def list_models(request: Request) -> ModelList:
    """All models."""
    known = service_of(request).models.all()
    return ModelList(models=[await run_in_threadpool(_listed, stored) for stored in known])


@router.get("/models/{name}")
async def get_model(stored: Stored) -> ModelInfo:
    """A model."""
    return await run_in_threadpool(lambda: stored.info)


@router.get("/models/{name}/geometry", responses={200: {"model": Geometry}})
async def get_geometry(stored: Stored) -> Response:
    """Data for a 3-D view: contour points and the view sphere."""
    text = await run_in_threadpool(lambda: stored.geometry_json)
    return Response(text, 200, {"Cache-Control": "private, max-age=600"}, JSON)


@router.put("/models/{name}", status_code=201, openapi_extra=_BODY)
async def put_model(request: Request, name: Name, replace: bool = False) -> ModelInfo:
    """Upload a model file (*.rvm). It is read and checked; nothing in it is executed.

    With ``replace`` it takes the place of an uploaded or trained model of this name. Sessions that
    are open keep theirs.
    """
    service = service_of(request)
    service.models.path_for(name, replace)  # refuses before the body is read
    present = service.models.get(name)
    async with file_of(request, service.models.folder) as sent:
        stored = await run_in_threadpool(service.models.add, name, sent, replace)
    if present is not None:
        service.release()
    return await run_in_threadpool(lambda: stored.info)


@router.delete("/models/{name}", status_code=204)
async def delete_model(request: Request, stored: Stored) -> None:
    """Delete a model that was uploaded or trained."""
    service = service_of(request)
    if any(session.stored is stored for session in service.sessions.values()):
        raise HTTPException(409, f"model {stored.name}: a session uses it: close the session first")
    service.models.remove(stored.name)
    service.release()


@router.get("/jobs")
async def list_jobs(request: Request) -> JobList:
    """All training jobs, newest first."""
    return JobList(jobs=[*service_of(request).jobs.list()])


@router.post("/jobs", status_code=201, openapi_extra=_BODY)
async def add_job(
    request: Request,
    model: Annotated[Name, Query(description="name of the model to make")],
    file: Annotated[
        str, Query(max_length=200, description="name of the mesh file; its suffix gives the format")
    ],
    unit: Annotated[
        Literal["m", "cm", "mm", "in", "ft"] | None,
        Query(description="default: as the file says, else m; a size that is odd is a warning"),
    ] = None,
    camera: Annotated[
        str | None, Query(max_length=16_000, description="content of the flight camera's file")
    ] = None,
    order: Annotated[int | None, Query(ge=0, le=4)] = None,
    views: Annotated[int | None, Query(ge=100, le=1_000_000)] = None,
    held_out: Annotated[int | None, Query(ge=10, le=100_000)] = None,
    seed: Annotated[int | None, Query(ge=0, le=2**31)] = None,
) -> JobInfo:
    """Upload a mesh and train a model of it, in a separate process."""
    service = service_of(request)
    given = {"unit": unit, "order": order, "views": views, "held-out": held_out, "seed": seed}
    options = {name: str(value) for name, value in given.items() if value is not None}

    async with file_of(request, Path(tempfile.gettempdir())) as mesh:
        if not (length := mesh.stat().st_size):
            raise HTTPException(422, "the mesh is empty: send the file as the body")

        async def added() -> str:
            return service.jobs.add(model, file, mesh, options, camera).id

        job_id = await service.once.do(key_of(request), (model, file, length), added)
    return await _job(request, job_id)


@router.get("/jobs/{job_id}")
async def get_job(job: Annotated[Job, Depends(_job)]) -> JobInfo:
    """A training job and its progress."""
    return job


@router.delete("/jobs/{job_id}")
async def cancel_job(request: Request, job: Annotated[Job, Depends(_job)]) -> JobInfo:
    """Cancel a training job; a finished one does not change."""
    await service_of(request).jobs.cancel(job)
    return job


def _listed(stored: StoredModel) -> ModelInfo:
    """A model that cannot be read is listed with the reason."""
    try:
        return stored.info
    except (RendezviewError, OSError) as error:
        return ModelInfo(name=stored.name, loaded=False, error=str(error))
