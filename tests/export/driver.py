"""Compiles exported flight code and asks it questions through ``driver.c``."""

from __future__ import annotations

import shutil
import struct
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt

from rendezview.export import write_c
from rendezview.geometry.camera import Camera
from rendezview.sensors.appearance import ViewModel
from rendezview.sensors.appearance.model.signature import Readings, Signature, twist
from rendezview.sensors.appearance.outline.votes import Match, Matcher
from rendezview.sensors.observation import Status

Array = npt.NDArray[np.float64]

STRICT = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"]
MORE_WARNINGS = ["-Wconversion", "-Wshadow", "-Wdouble-promotion", "-Wcast-qual", "-Wvla"]
SANITIZED = ["-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
DRIVER = Path(__file__).with_suffix(".c")
STATUSES: list[Status | str] = [
    Status.OK,
    Status.EMPTY,
    Status.FULL,
    Status.BORDER,
    Status.SMALL,
    Status.RIVALS,
    Status.UNRECOGNIZED,
    "no room",
    "bad input",
]


def compiler() -> str | None:
    """The C compiler of this machine, if it has one."""
    return shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")


def build(model: ViewModel, folder: Path, flags: list[str]) -> Path:
    """Export a model into a folder and compile it with the driver."""
    cc = compiler()
    assert cc is not None, "no C compiler"
    sources = [str(path) for path in write_c(model, folder) if path.suffix == ".c"]
    program = folder / "driver"
    done = subprocess.run(
        [cc, *STRICT, *flags, f"-I{folder}", *sources, str(DRIVER), "-lm", "-o", str(program)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert not done.stderr, done.stderr
    return program


def object_bytes(model: ViewModel, folder: Path) -> dict[str, int]:
    """What each object file takes on board: code and constants, `size`'s text + data + bss."""
    cc, size = compiler(), shutil.which("size")
    assert cc is not None, "no C compiler"
    assert size is not None, "no size command"
    taken = {}
    for path in write_c(model, folder):
        if path.suffix == ".c":
            target = path.with_suffix(".o")
            subprocess.run([cc, "-std=c99", "-O2", "-c", str(path), "-o", str(target)], check=True)
            said = subprocess.run([size, str(target)], capture_output=True, text=True, check=True)
            taken[path.name] = int(said.stdout.splitlines()[1].split()[3])
    return taken


@dataclass(frozen=True, slots=True, eq=False)
class ActiveNodes:
    """What `rdv_search` found."""

    nodes: npt.NDArray[np.uint16]  # (K,)
    trust: Array  # (K,)
    weights: Array  # (K,)
    support: float
    direction: Array  # (3,)


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """What `rdv_silhouette` found."""

    outlines_px: list[Array]
    area_px: float
    sky_grey: float
    level_grey: float
    box_px: tuple[int, int, int, int]


class Pipe:
    """A program that answers binary questions; the block fails where the program failed."""

    def __init__(self, command: list[str]) -> None:
        self.name = type(self).__name__
        # A pipe that nobody reads would fill.
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  # closed with the block
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors
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


class FlightCode(Pipe):
    """A running driver; ends with the block."""

    def __init__(self, program: Path, model: ViewModel) -> None:
        super().__init__([str(program)])
        self.bins, self.node_count = model.bins, len(model.forest)

    def trees(self, readings: npt.ArrayLike, rolls_rad: npt.ArrayLike) -> Array | Status | str:
        """Trust of every node, 0 where it is off."""
        self.send(b"T", _f32(readings), _f64(rolls_rad))
        status, trust = self._status(), self.take("d", self.node_count)
        return trust if status is Status.OK else status

    def search(
        self, readings: npt.ArrayLike, attitude: npt.ArrayLike, reach_rad: float
    ) -> ActiveNodes | Status | str:
        """`rdv_search`."""
        return self._search(b"S", readings, attitude, reach_rad)

    def search_around(
        self, readings: npt.ArrayLike, attitude: npt.ArrayLike, error_rad: float
    ) -> ActiveNodes | Status | str:
        """`rdv_search_around`."""
        return self._search(b"A", readings, attitude, error_rad)

    def forest_search(
        self, readings: npt.ArrayLike, attitude: npt.ArrayLike, reach_rad: float
    ) -> ActiveNodes | Status | str:
        """`rdv_forest_search`."""
        return self._search(b"P", readings, attitude, reach_rad)

    def forest_score(
        self, readings: npt.ArrayLike, attitude: npt.ArrayLike
    ) -> float | Status | str:
        """`rdv_forest_score`."""
        self.send(b"O", _f32(readings), _f64(attitude))
        status, (score,) = self._status(), self.take("d", 1)
        return float(score) if status is Status.OK else status

    def _search(
        self, letter: bytes, readings: npt.ArrayLike, attitude: npt.ArrayLike, angle_rad: float
    ) -> ActiveNodes | Status | str:
        self.send(letter, _f32(readings), _f64(attitude), _f64([angle_rad]))
        status = self._status()
        if status is not Status.OK:
            return status
        (count,) = self.take("I", 1)
        nodes = self.take("H", int(count)).astype(np.uint16)
        trust, weights = self.take("d", int(count)), self.take("d", int(count))
        (support,) = self.take("d", 1)
        return ActiveNodes(nodes, trust, weights, float(support), self.take("d", 3))

    def signature(self, outlines: list[Array]) -> Signature | Status | str:
        """`rdv_signature_of` of outlines (M, 2) or (M, 3) as rays x, y[, 1]."""
        ends = np.cumsum([len(o) for o in outlines], dtype=np.uint32)
        rays = np.concatenate([np.asarray(o)[:, :2] for o in outlines] or [np.zeros((0, 2))])
        self.send(
            b"G",
            struct.pack("I", len(outlines)),
            ends.tobytes(),
            struct.pack("I", len(rays)),
            _f64(rays),
        )
        return self._signature()

    def frame(
        self,
        image: npt.NDArray[np.uint8],
        camera: Camera,
        expected_px: npt.ArrayLike | None = None,
        most_points: int = 1 << 18,
    ) -> tuple[Outline, Signature | Status | str] | Status | str:
        """`rdv_silhouette`, `rdv_rays` and `rdv_signature_of`."""
        height, width = image.shape
        numbers = struct.pack("4I", width, height, most_points, expected_px is not None)
        place = _f64([0.0, 0.0] if expected_px is None else expected_px)
        lens = _f64([camera.fx, camera.fy, camera.cx, camera.cy])
        self.send(b"F", numbers, place, lens, np.ascontiguousarray(image).tobytes())
        status = self._status()
        if status is not Status.OK:
            return status
        area_px, sky, level = map(float, self.take("d", 3))
        left, top, right, bottom = map(int, self.take("i", 4))
        (outlines,) = self.take("I", 1)
        ends = self.take("I", int(outlines)).astype(int)
        points = self.take("d", 2 * int(ends[-1])).reshape(-1, 2)
        found = Outline(
            np.split(points, ends[:-1]), area_px, sky, level, (left, top, right, bottom)
        )
        return found, self._signature()

    def trees_ns(self, readings: Array, rolls_rad: Array) -> Array:
        """Nanoseconds of `rdv_all_trees` for each of n signatures (n, N) at rolls (n, T)."""
        return self._speed(b"B", readings, rolls_rad)

    def search_ns(self, readings: Array, attitudes: Array) -> Array:
        """Nanoseconds of `rdv_search` for each of n signatures at attitudes (n, 3, 3)."""
        return self._speed(b"Q", readings, attitudes)

    def search_around_ns(self, readings: Array, attitudes: Array) -> Array:
        """Nanoseconds of `rdv_search_around`, the attitudes known to 20°."""
        return self._speed(b"R", readings, attitudes)

    def forest_score_ns(self, readings: Array, attitudes: Array) -> Array:
        """Nanoseconds of `rdv_forest_score`, which the model must have."""
        return self._speed(b"D", readings, attitudes)

    def _speed(self, letter: bytes, readings: Array, more: Array) -> Array:
        pairs = [_f32(r) + _f64(m) for r, m in zip(readings, more, strict=True)]
        self.send(letter, struct.pack("I", len(pairs)), *pairs)
        return self.take("d", len(pairs))

    def _signature(self) -> Signature | Status | str:
        status = self._status()
        if status is not Status.OK:
            return status
        readings = self.take("f", self.bins).astype(np.float32)
        (area_sr,) = self.take("d", 1)
        return Signature(readings, float(area_sr), self.take("d", 9).reshape(3, 3))

    def _status(self) -> Status | str:
        (number,) = self.take("i", 1)
        return STATUSES[int(number)]


def runtime_search(
    matcher: Matcher, readings: Readings, attitude: Array, reach_rad: float
) -> ActiveNodes | None:
    """What `rdv_search` does, of the runtime's parts."""
    nodes = matcher.model.geodesic.within(-attitude[2], reach_rad)
    rolls = twist(attitude, matcher.model.views.centred_from_target[nodes])
    trust = matcher.trust_of(matcher.model.forest.leaves(readings, nodes, rolls))
    on, trust = nodes[trust > 0.0], trust[trust > 0.0]
    if len(on) == 0:
        return None
    direction, weights = matcher.consensus(on, trust)
    return ActiveNodes(on.astype(np.uint16), trust, weights, float(weights.sum()), direction)


def runtime_search_around(
    matcher: Matcher, readings: Readings, attitude: Array, error_rad: float
) -> ActiveNodes | None:
    """What `rdv_search_around` does."""
    step = np.deg2rad(2.0)
    most = int(np.ceil(error_rad / step))
    reach = error_rad + matcher.options.margin_edges * matcher.model.geodesic.mean_edge_rad
    best: ActiveNodes | None = None
    for roll in step * np.arange(-most, most + 1):
        turn = np.array(
            [[np.cos(roll), -np.sin(roll), 0.0], [np.sin(roll), np.cos(roll), 0.0], [0.0, 0.0, 1.0]]
        )
        found = runtime_search(matcher, readings, turn @ attitude, reach)
        if found is not None and (best is None or found.support > best.support):
            best = found
    return best


def same_search(c: ActiveNodes | Status | str, python: ActiveNodes | None) -> bool:
    """Active nodes and trust exactly; direction and weights but for the last bits of exp."""
    if python is None:
        return c is Status.UNRECOGNIZED
    return (
        isinstance(c, ActiveNodes)
        and np.array_equal(c.nodes, python.nodes)
        and np.array_equal(c.trust, python.trust)
        and np.abs(c.weights - python.weights).max() < 1e-12
        and np.abs(c.direction - python.direction).max() < 1e-12
    )


def same_match(c: ActiveNodes | Status | str, python: Match | None) -> bool:
    """The same of `rdv_forest_search` and `Matcher.at`."""
    if python is None:
        return c is Status.UNRECOGNIZED
    return (
        isinstance(c, ActiveNodes)
        and np.array_equal(c.nodes, python.active_nodes)
        and np.abs(c.weights - python.weights).max() < 1e-12
        and np.abs(c.direction - python.direction).max() < 1e-12
    )


def _f32(values: npt.ArrayLike) -> bytes:
    return np.ascontiguousarray(values, dtype=np.float32).tobytes()


def _f64(values: npt.ArrayLike) -> bytes:
    return np.ascontiguousarray(values, dtype=np.float64).tobytes()
