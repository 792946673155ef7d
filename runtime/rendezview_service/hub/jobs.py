"""Training jobs, each in its own process: the service never imports the ground side."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import secrets
import shutil
import signal
import sys
import time
from pathlib import Path

from pydantic import PrivateAttr

from rendezview.errors import RendezviewError
from rendezview_service.hub.model_store import ModelStore
from rendezview_service.logs.log_lock import TemporaryFolder
from rendezview_service.messages.model_messages import JobInfo, JobState
from rendezview_service.settings import Settings

log = logging.getLogger("rendezview_service")

MESH_SUFFIXES = (".stl", ".obj", ".ply", ".glb", ".3mf", ".dae")
_KEPT = 100  # finished jobs in the list. Source: a chosen limit
_QUEUED = 16  # jobs that may wait. Source: a chosen limit
# The training's process: little priority and bounded memory. It limits itself: Python between fork
# and exec may wait for ever for a lock that another thread of the service held.
_TRAIN = """
import os, resource, sys
os.nice(10)
resource.setrlimit(resource.RLIMIT_AS, (int(sys.argv[1]),) * 2)
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
del sys.argv[1]
from rendezview.cli.main import main
main()
"""


class Job(JobInfo):
    """One training job, and its process."""

    _temporary: TemporaryFolder | None = None
    _folder: Path = Path()
    _arguments: list[str] = PrivateAttr(default_factory=list)
    _started_s: float | None = None
    _process: asyncio.subprocess.Process | None = None
    _task: asyncio.Task[None] | None = None

    @property
    def is_over(self) -> bool:
        """Whether it has finished, failed or been cancelled."""
        return self.state in (JobState.DONE, JobState.FAILED, JobState.CANCELLED)

    def count_time(self) -> None:
        """Note the time since its start, as long as it runs."""
        if self._started_s is not None:
            self.elapsed_s = time.monotonic() - self._started_s


class Jobs:
    """All training jobs: waiting, running and finished."""

    def __init__(self, store: ModelStore, settings: Settings) -> None:
        """No jobs yet."""
        self._store, self._settings = store, settings
        self._jobs: dict[str, Job] = {}
        self._turns = asyncio.Semaphore(settings.jobs)

    def list(self) -> list[Job]:
        """All jobs, newest first."""
        for job in self._jobs.values():
            job.count_time()
        return list(self._jobs.values())[::-1]

    def get(self, job_id: str) -> Job | None:
        """A job by its id."""
        job = self._jobs.get(job_id)
        if job is not None:
            job.count_time()
        return job

    def add(
        self,
        model: str,
        file_name: str,
        mesh: Path,
        options: dict[str, str],
        camera: str | None = None,
    ) -> Job:
        """Queue a training of an uploaded mesh.

        Args:
            file_name: only its suffix is used.
            mesh: the file; it is moved away.
            camera: content of a camera file, of any kind that `load_camera` reads.
            options: of ``rendezview train``: unit, order, views, held-out, seed.

        Raises:
            RendezviewError: a name is invalid or taken, or too many jobs wait.
        """
        if self._settings.jobs == 0:
            raise RendezviewError("training is switched off: see the setting `jobs`")
        suffix = Path(file_name).suffix.lower()
        if suffix not in MESH_SUFFIXES:
            raise RendezviewError(
                f"file {file_name[:80]!r}: no mesh: its name must end in {' '.join(MESH_SUFFIXES)}"
            )
        if sum(job.state is JobState.QUEUED for job in self._jobs.values()) >= _QUEUED:
            raise RendezviewError(f"{_QUEUED} training jobs wait already: try again later")
        path = self._store.path_for(model)
        if any(job.model == model and not job.is_over for job in self._jobs.values()):
            raise RendezviewError(f"model {model}: is being trained: choose another name")
        temporary = TemporaryFolder("rendezview-job-")
        folder = temporary.path
        target = folder / f"{model}{suffix}"
        shutil.move(mesh, target)
        arguments = [str(target), "-o", str(folder / path.name)]
        if camera is not None:
            given = folder / "camera"
            given.write_text(camera, encoding="utf-8")
            options = options | {"camera": str(given)}
        for name, value in options.items():
            arguments += [f"--{name}", value]
        job = Job(id=secrets.token_hex(6), model=model, created_unix_s=time.time())
        job._temporary, job._folder, job._arguments = temporary, folder, arguments
        self._jobs[job.id] = job
        job._task = asyncio.create_task(self._run(job))
        return job

    async def cancel(self, job: Job) -> None:
        """Cancel a job; a finished one does not change."""
        if job.state is JobState.QUEUED:
            self._over(job, JobState.CANCELLED)
        elif job.state is JobState.RUNNING:
            job.state = JobState.CANCELLED
            _kill(job)
            assert job._task is not None
            with contextlib.suppress(asyncio.CancelledError):
                await job._task

    async def stop(self) -> None:
        """Cancel all jobs."""
        for job in list(self._jobs.values()):
            await self.cancel(job)

    async def _run(self, job: Job) -> None:
        async with self._turns:
            if job.state is JobState.QUEUED:
                await self._train(job)

    async def _train(self, job: Job) -> None:
        job.state, job._started_s = JobState.RUNNING, time.monotonic()
        last, ended, most_s = "", JobState.CANCELLED, self._settings.job_s
        most_bytes = str(self._settings.job_bytes)
        try:
            # Its own process group: the processes that it starts end with it.
            job._process = await asyncio.create_subprocess_exec(
                *(sys.executable, "-c", _TRAIN, most_bytes, "train", *job._arguments),
                stdin=asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.DEVNULL,
                stderr=asyncio.subprocess.PIPE,
                cwd=job._folder,
                env=os.environ | {"RENDEZVIEW_PROGRESS": "json"},
                start_new_session=True,
            )
            if job.state is JobState.CANCELLED:  # while the process started
                _kill(job)
            assert job._process.stderr is not None
            async with asyncio.timeout(most_s):
                async for line in job._process.stderr:
                    last = _progress(job, line.decode(errors="replace").strip()) or last
                code = await job._process.wait()
            if job.state is not JobState.CANCELLED:
                if code != 0:
                    raise RendezviewError(last or f"the training ended with code {code}")
                made = job._folder / f"{job.model}.rvm"
                await asyncio.to_thread(self._store.add, job.model, made)
                ended = JobState.DONE
        except (OSError, RendezviewError, ValueError) as error:  # the time is over, too
            late = f"the training took longer than {most_s:g} s: see `job_s`"
            job.reason = late if isinstance(error, TimeoutError) else str(error)
            ended = JobState.FAILED
        finally:
            _kill(job)
            self._over(job, ended)

    def _over(self, job: Job, state: JobState) -> None:
        job.count_time()
        job.state, job._started_s = state, None
        log.info("training", extra={"job": job.id, "state": str(state), "reason": job.reason})
        assert job._temporary is not None
        job._temporary.remove()
        over = [j for j in self._jobs.values() if j.is_over]
        for old in over[:-_KEPT]:
            del self._jobs[old.id]


def _progress(job: Job, line: str) -> str:
    """Take a line of progress. Any other line is returned: it may be the reason of a failure."""
    line = line.replace(str(job._folder) + os.sep, "")
    try:
        progress = json.loads(line)
        if "doubt" in progress:
            job.warnings.append(str(progress["doubt"]))
            return ""
        job.stage = str(progress["stage"])
        job.progress = float(progress["done"]) / max(float(progress["total"]), 1.0)
    except (ValueError, KeyError, TypeError):
        return line.removeprefix("rendezview: ")
    return ""


def _kill(job: Job) -> None:
    if job._process is not None and job._process.returncode is None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(job._process.pid, signal.SIGKILL)
