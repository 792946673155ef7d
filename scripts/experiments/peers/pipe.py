"""A program that answers binary questions through its standard input and output."""

from __future__ import annotations

import os
import struct
import subprocess
import tempfile
from typing import Self

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


class Pipe:
    """The running program; ends with the block, which fails where the program failed."""

    def __init__(self, command: list[str], environment: dict[str, str] | None = None) -> None:
        self.name = type(self).__name__
        # A pipe that nobody reads would fill.
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  # closed with the block
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            env=os.environ | (environment or {}),
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        self._process.communicate()
        said = self._said()
        self._errors.close()
        if kind is None:
            assert self._process.returncode == 0, (self._process.returncode, said)

    def send(self, *parts: bytes) -> None:
        """Ask a question."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(b"".join(parts))
            self._process.stdin.flush()
        except BrokenPipeError:
            raise self._ended() from None

    def take(self, code: str, count: int) -> Array:
        """So many numbers of an answer; ``code`` as in `struct`."""
        assert self._process.stdout is not None
        wanted = count * struct.calcsize(code)
        data = self._process.stdout.read(wanted)
        if len(data) < wanted:
            raise self._ended()
        return np.frombuffer(data, dtype=code)

    def _ended(self) -> AssertionError:
        self._process.wait()
        return AssertionError(f"{self.name} ended ({self._process.returncode}): {self._said()}")

    def _said(self) -> str:
        self._errors.seek(0)
        return self._errors.read()[-2000:].decode(errors="replace")
