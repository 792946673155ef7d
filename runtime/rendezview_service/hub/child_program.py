"""Programs that the service has started, and that end with it."""

from __future__ import annotations

import subprocess


def end(program: subprocess.Popen[bytes], within_s: float) -> None:
    """Ask a program to end, and kill it if it has not after a time."""
    program.terminate()
    try:
        program.wait(within_s)
    except subprocess.TimeoutExpired:
        program.kill()
