"""The kept ratios over the history of their file: what has become faster, and what slower."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

from rich.table import Table

from experiments.frame import table_of


def kept_ratios(path: Path) -> dict[str, dict[str, float]]:
    """By day, the ratios of the day's last commit by row, the oldest first.

    Raises:
        SystemExit: with the reason, where no git repository holds the file.
    """
    days: dict[str, dict[str, float]] = {}
    for line in _git(path.parent, "log", "--reverse", "--format=%h %as", "--", path.name):
        commit, day = line.split()
        text = "\n".join(_git(path.parent, "show", f"{commit}:./{path.name}"))
        days[day] = {key: float(row["ratio"]) for key, row in json.loads(text).items()}
    if not days:
        raise SystemExit(f"{path}: no commit holds it")
    return days


def history_table(days: dict[str, dict[str, float]]) -> Table:
    """Rows that are kept today; "–": not measured on that day."""
    table = table_of("kept ratios, less is better", ["what / beside", *days])
    for key in list(days.values())[-1]:
        table.add_row(key, *(f"{day[key]:.3g}" if key in day else "–" for day in days.values()))
    return table


def _git(folder: Path, *arguments: str) -> list[str]:
    command = ["git", "-C", str(folder), *arguments]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stderr.strip())
    return done.stdout.splitlines()
