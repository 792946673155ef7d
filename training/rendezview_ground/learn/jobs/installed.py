"""Versions of the software that decides the bytes of a result."""

from __future__ import annotations

import functools
import hashlib
import platform
from importlib import metadata
from pathlib import Path

import rendezview
import rendezview_ground
from rendezview_ground.learn.jobs.shard_executor import ClusterError

# These decide the bytes of a result. All machines of a cluster need the same versions.
_PACKAGES = ("numpy", "scipy", "opencv-python-headless", "numba", "scikit-learn", "trimesh")
_MESSAGES = ("dask", "distributed", "cloudpickle")  # the machines of a cluster talk with these

Installed = dict[str, str]


@functools.cache
def installed() -> Installed:
    """Versions of the packages that compute here, and a digest of this project's own code."""
    versions = {name: metadata.version(name) for name in (*_PACKAGES, *_MESSAGES)}
    versions["Python"] = platform.python_version()
    digest = hashlib.sha256()
    for root in (Path(rendezview.__path__[0]), Path(rendezview_ground.__path__[0])):
        for source in sorted(root.rglob("*.py")):
            digest.update(source.relative_to(root).as_posix().encode())
            digest.update(source.read_bytes())
    versions["rendezview's code"] = digest.hexdigest()[:12]
    return versions


def check_versions(there: Installed, here: Installed, worker: str) -> None:
    """Compare a worker's versions with those of the command.

    Raises:
        ClusterError: they differ; the message names each difference.
    """
    different = [
        f"{name} {there.get(name)} there, {here.get(name)} here"
        for name in sorted({*there, *here})
        if there.get(name) != here.get(name)
    ]
    if different:
        raise ClusterError(
            f"worker {worker} has other versions, and would give other results: "
            f"{'; '.join(different)}"
        )
