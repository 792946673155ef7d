"""Shards of work, whose results outlive a killed job."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import shutil
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.io.file_lock import FolderLock
from rendezview.io.files import atomic_write
from rendezview.io.results import partial
from rendezview_ground.learn.jobs.shard_executor import ShardExecutor, Shared

Arrays = dict[str, npt.NDArray[Any]]
Join = Callable[[list[npt.NDArray[Any]]], npt.NDArray[Any]]
Progress = Callable[[str, int, int], None]  # stage, done, of


def shares(count: int, size: int) -> list[range]:
    """0 … count − 1 in shards of at most ``size``.

    Shards shrink to a quarter of ``size`` towards the end, so that no worker waits long for the
    last one.
    """
    parts, start = [], 0
    while start < count:
        left = count - start
        some = min(size, left, max(left // 8, size // 4, 1))
        parts.append(range(start, start + some))
        start += some
    return parts


def together(parts: Sequence[Arrays], join: Join = np.concatenate) -> Arrays:
    """The arrays of one name in all parts, joined."""
    return {name: join([part[name] for part in parts]) for name in parts[0]}


class Shards:
    """A folder of finished shards beside the output, valid for one set of inputs.

    Use it as a context manager: meanwhile no other run computes this output.

    Args:
        output: the file that the shards are for.
        inputs: what decides the shards.

    Raises:
        RendezviewError: another run computes it, or the folder cannot be written.
    """

    def __init__(self, output: Path, inputs: dict[str, Any]) -> None:
        key = json.dumps(inputs, sort_keys=True)
        self._parent = partial(output)
        self._folder = self._parent / hashlib.sha256(key.encode()).hexdigest()[:16]
        self._lock = FolderLock(self._parent, output)
        try:
            for other in self._parent.iterdir():
                if other != self._folder:
                    shutil.rmtree(other)
            self._folder.mkdir(exist_ok=True)
        except OSError as error:
            self._lock.release()
            raise RendezviewError(f"{self._parent}: {error.strerror or error}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def run(
        self,
        stage: str,
        task: Callable[..., Arrays],
        shared: Shared,
        arguments: Sequence[tuple[Any, ...]],
        executor: ShardExecutor,
        progress: Progress | None,
    ) -> list[Arrays]:
        """Results of ``task(*shared, *own)`` for the arguments of each shard, in their order.

        Finished shards are read from the folder. The executor computes the others, and each is
        written as soon as it is finished.
        """
        results: dict[int, Arrays] = {}
        for k in range(len(arguments)):
            done = self._read(stage, k)
            if done is not None:
                results[k] = done
        todo = [k for k in range(len(arguments)) if k not in results]
        if progress:
            progress(stage, len(results), len(arguments))
        if not todo:
            return [results[k] for k in range(len(arguments))]
        computed = executor.results(task, shared, [arguments[k] for k in todo])
        with contextlib.closing(computed):
            for i, result in computed:
                self._write(stage, todo[i], result)
                results[todo[i]] = result
                if progress:
                    progress(stage, len(results), len(arguments))
        return [results[k] for k in range(len(arguments))]

    def remove(self) -> None:
        """Delete the shards, after the output is written."""
        shutil.rmtree(self._parent, ignore_errors=True)

    def _path(self, stage: str, index: int) -> Path:
        return self._folder / f"{stage}-{index:05d}.npz"

    def _read(self, stage: str, index: int) -> Arrays | None:
        path = self._path(stage, index)
        if not path.exists():
            return None
        try:
            with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
                return {name: file[name] for name in file.files}
        except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile):
            return None  # incomplete after a kill: computed again

    def _write(self, stage: str, index: int, result: Arrays) -> None:
        buffer = io.BytesIO()
        np.savez(buffer, **result)  # type: ignore[arg-type]
        with atomic_write(self._path(stage, index), durable=False) as file:
            file.write(buffer.getvalue())
