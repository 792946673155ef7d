"""Catalogues: one model per combination of target, shells and lighting."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Iterator
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from rendezview.errors import RendezviewError
from rendezview.io.bundled import find_target
from rendezview.io.camera_files import load_camera
from rendezview.io.files import checked, describe, make_folder, read_toml
from rendezview_ground.learn.jobs.shard_executor import ClusterError, ShardExecutor
from rendezview_ground.learn.jobs.stages import Progress
from rendezview_ground.learn.options import OLD_NAMES, TrainingOptions
from rendezview_ground.learn.target_job import is_trained, train_target
from rendezview_ground.mesh.mesh import load_mesh


class _Row(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _TargetRow(_Row):
    target: str
    name: str | None = None
    unit: str | None = None
    camera: Path | None = None
    options: dict[str, Any] = Field(default_factory=dict)


class _VariantRow(BaseModel):
    model_config = ConfigDict(extra="allow", frozen=True)
    name: str


class _File(_Row):
    targets: list[_TargetRow] = Field(min_length=1)
    shells: list[_VariantRow] = Field(default_factory=list)
    lighting: list[_VariantRow] = Field(default_factory=list)
    options: dict[str, Any] = Field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Entry:
    """One model of a catalogue."""

    name: str  # of the model: target-shells-lighting
    target: str
    unit: str | None
    camera: Path | None
    options: TrainingOptions


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a catalogue, by the names of its models."""

    trained: tuple[str, ...]
    there_already: tuple[str, ...]
    refused: dict[str, str]  # name: reason


def read_catalogue(path: Path) -> list[Entry]:
    """The models of a catalogue file: targets × shells × lighting.

    Raises:
        RendezviewError: no such file, unknown keys or options, or two models with one name.
    """
    file = checked(TypeAdapter(_File), read_toml(path, "a catalogue file"), str(path))
    entries = list(_entries(file, path))
    seen: set[str] = set()
    for entry in entries:
        if entry.name in seen or "/" in entry.name or not entry.name.strip("."):
            raise RendezviewError(
                f"{path}: {entry.name!r} is not a valid name of a model, or names two: "
                "give each target, set of shells and lighting its own name"
            )
        seen.add(entry.name)
    return entries


def _entries(file: _File, path: Path) -> Iterator[Entry]:
    none = [_VariantRow(name="")]
    for target, shells, light in product(file.targets, file.shells or none, file.lighting or none):
        where = target.target
        if (path.parent / where).exists():
            where = str(path.parent / where)
        own = target.name or Path(where if Path(where).name != "target.toml" else where[:-12]).stem
        name = "-".join(part for part in (own, shells.name, light.name) if part)
        given = [file.options, target.options, shells.model_extra or {}, light.model_extra or {}]
        merged = {OLD_NAMES.get(k, k): v for options in given for k, v in options.items()}
        camera = None if target.camera is None else path.parent / target.camera
        yield Entry(name, where, target.unit, camera, _options(merged, f"{path}: {name}"))


def _options(given: dict[str, Any], where: str) -> TrainingOptions:
    known = {f.name for f in dataclasses.fields(TrainingOptions)}
    for name in given:
        if name not in known:
            raise RendezviewError(
                f"{where}: there is no training option {name}; there are {', '.join(sorted(known))}"
            )
    try:
        return TypeAdapter(TrainingOptions).validate_python(given)
    except ValidationError as error:
        raise RendezviewError(f"{where}: {describe(error)}") from None
    except RendezviewError as error:
        raise RendezviewError(f"{where}: {error}") from None


def train_catalogue(
    entries: list[Entry],
    folder: Path,
    executor: ShardExecutor,
    *,
    at_once: int = 1,
    progress: Progress | None = None,
) -> Outcome:
    """Train every missing model of a catalogue, as ``folder``/name.rvm.

    Args:
        at_once: models at a time. With more than one, a cluster has work while the command joins
            the results of a stage.
        progress: receives models and shards; the number of shards grows as stages begin.

    Returns:
        The outcome. Targets that cannot be trained (no mesh, flat …) are in ``refused``.

    Raises:
        RendezviewError: the folder cannot be written.
        Exception: of the executor, such as a lost cluster. Finished work is kept and used again
            when the call is repeated.
    """
    make_folder(folder)
    count = _Count(len(entries), progress)
    trained, there, refused = set[str](), set[str](), dict[str, str]()

    def one(entry: Entry) -> None:
        path = folder / f"{entry.name}.rvm"
        try:
            target = dataclasses.replace(find_target(entry.target), name=entry.name)
            mesh = load_mesh(target.mesh_path, entry.unit or target.unit)
            camera = load_camera(entry.camera) if entry.camera else None
            if is_trained(target, mesh, path, entry.unit, entry.options, camera):
                there.add(entry.name)
                return
            train_target(
                target, mesh, path, entry.unit, options=entry.options, camera=camera,
                executor=executor, progress=count.shards(),
            )  # fmt: skip
            trained.add(entry.name)
        except ClusterError:
            raise
        except RendezviewError as error:
            refused[entry.name] = str(error)
        finally:
            count.model()

    with ThreadPoolExecutor(max_workers=at_once) as pool:
        running = [pool.submit(one, entry) for entry in entries]
        try:
            done, _ = wait(running, return_when=FIRST_EXCEPTION)
        except BaseException:
            count.stop.set()
            pool.shutdown(wait=True, cancel_futures=True)
            raise
        failed = [f for f in done if f.exception() is not None]
        if failed:
            count.stop.set()
            pool.shutdown(wait=True, cancel_futures=True)
            failed[0].result()
    names = [entry.name for entry in entries]
    return Outcome(
        tuple(name for name in names if name in trained),
        tuple(name for name in names if name in there),
        refused,
    )


class _Stopped(Exception):
    """Another model's training failed."""


class _Count:
    """Counts models and shards of parallel trainings."""

    def __init__(self, models: int, progress: Progress | None) -> None:
        self.stop = threading.Event()
        self._lock = threading.Lock()
        self._progress = progress
        self._models = [0, models]
        self._shards = [0, 0]

    def model(self) -> None:
        """Count one more finished model."""
        with self._lock:
            self._models[0] += 1
            if self._progress:
                self._progress("models", *self._models)

    def shards(self) -> Progress:
        """A progress callback for one training."""
        stages: dict[str, int] = {}

        def report(stage: str, done: int, of: int) -> None:
            if self.stop.is_set():
                raise _Stopped
            with self._lock:
                if stage not in stages:
                    self._shards[1] += of
                self._shards[0] += done - stages.get(stage, 0)
                stages[stage] = done
                if self._progress:
                    self._progress("shards", *self._shards)

        return report
