"""Requirement, test, result: the matrix of docs/requirements.toml and a run of pytest."""

from __future__ import annotations

import tomllib
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

REQUIREMENTS = Path(__file__).resolve().parents[1] / "docs" / "requirements.toml"
KEYS = {"id", "text", "verified", "experiment"}
OUTCOMES = {"passed": "passed", "failed": "failed", "error": "failed", "skipped": "skipped"}


@dataclass(frozen=True, kw_only=True)
class Requirement:
    """One promise and its verification."""

    id: str
    text: str
    verified: str  # how
    experiment: str = ""  # the run that measures it beyond the test
    results: Counter[str] = field(default_factory=Counter)  # of its tests, by outcome

    @property
    def holds(self) -> bool:
        """At least one test verified it, and none of them failed."""
        return self.results["passed"] > 0 and not self.results["failed"]

    def __str__(self) -> str:
        counts = ", ".join(
            f"{self.results[kind]} {kind}" for kind in ("passed", "failed", "skipped")
        )
        return f"{self.id}: {'holds' if self.holds else 'NOT VERIFIED'} ({counts}). {self.text}"


def requirements(path: Path = REQUIREMENTS) -> dict[str, Requirement]:
    """All requirements by id; ValueError where one is not complete, odd, or stands twice."""
    found: dict[str, Requirement] = {}
    for entry in tomllib.loads(path.read_text(encoding="utf-8"))["requirement"]:
        odd = set(entry) - KEYS or KEYS - {"experiment"} - set(entry)
        if odd or entry["verified"] != "test":
            raise ValueError(f"{path}: {entry.get('id', entry)}: wrong or missing: {odd or 'test'}")
        if entry["id"] in found:
            raise ValueError(f"{path}: {entry['id']} stands twice")
        found[entry["id"]] = Requirement(**entry)
    return found


def matrix(
    reports: Mapping[str, Iterable[Any]], known: dict[str, Requirement]
) -> tuple[list[str], list[str]]:
    """Lines of all requirements, and the faults: ids that are not known or do not hold.

    ``reports``: pytest's, by outcome; the property "requirement" names what a test verifies.
    """
    unknown = set()
    for outcome, kind in OUTCOMES.items():
        for report in reports.get(outcome, ()):
            said = getattr(report, "user_properties", ())  # a module skipped as a whole has none
            for name in (value for key, value in said if key == "requirement"):
                if name in known:
                    known[name].results[kind] += 1
                else:
                    unknown.add(name)
    faults = [f"{name} is not in {REQUIREMENTS.name}" for name in sorted(unknown)]
    faults += [f"{one.id} has no passing test" for one in known.values() if not one.holds]
    return [str(one) for one in known.values()], faults
