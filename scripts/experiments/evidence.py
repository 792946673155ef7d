"""Requirement, test, result: the matrix of docs/requirements.toml and a run of pytest."""

from __future__ import annotations

import sys
import tomllib
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated
from xml.etree import ElementTree

from experiments.frame import ROOT, show, table_of

REQUIREMENTS = ROOT / "docs" / "requirements.toml"
KEYS = {"id", "text", "verified", "experiment"}


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


def count_results(junit: Path, known: dict[str, Requirement]) -> list[str]:
    """Add the results of a JUnit file to the requirements; returns ids that are not known."""
    unknown = []
    outcomes = {"failure": "failed", "error": "failed", "skipped": "skipped"}
    for case in ElementTree.parse(junit).iter("testcase"):
        marks = [p for p in case.iter("property") if p.get("name") == "requirement"]
        found = (outcomes[kind] for kind in outcomes if case.find(kind) is not None)
        outcome = next(found, "passed")
        for name in (mark.get("value", "") for mark in marks):
            if name in known:
                known[name].results[outcome] += 1
            else:
                unknown.append(name)
    return unknown


def run(junit: Annotated[Path, "of pytest --junit-xml"]) -> None:
    """Print every requirement with the results of its tests; exit 1 where one does not hold."""
    known = requirements()
    unknown = count_results(junit, known)
    table = table_of("requirements", "id | requirement | passed | failed | skipped | ", left=2)
    for one in known.values():
        counts = [str(one.results[outcome]) for outcome in ("passed", "failed", "skipped")]
        table.add_row(one.id, one.text, *counts, "holds" if one.holds else "NOT VERIFIED")
    show(table, width=150)
    missing = [one.id for one in known.values() if not one.holds]
    print(f"{len(known) - len(missing)} of {len(known)} requirements hold")
    if unknown:
        sys.exit(f"not in {REQUIREMENTS.name}: {', '.join(sorted(set(unknown)))}")
    if missing:
        sys.exit(f"without a passing test: {', '.join(missing)}")
