"""Readers of all supported mesh formats; they give unconnected triangles."""

from __future__ import annotations

import contextlib
import io
import logging
import re
import tempfile
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from logging.handlers import BufferingHandler
from pathlib import Path
from typing import Any

import numpy as np

from rendezview.errors import RendezviewError
from rendezview_ground.mesh.colours import Rgb, grey, visual_face_rgb
from rendezview_ground.mesh.containers import (
    check_3mf,
    colours_of_3mf,
    file_unit,
    has_decimal_commas,
    refers_to_texture,
)
from rendezview_ground.mesh.gltf import GLTF_SUFFIXES, plain_gltf
from rendezview_ground.mesh.mesh_file import MeshFile, Part, joined
from rendezview_ground.mesh.notes import counted
from rendezview_ground.mesh.obj import read_obj
from rendezview_ground.mesh.scenes import nodes_below, step_note, triangulate_step
from rendezview_ground.mesh.stl import read_stl
from rendezview_ground.mesh.text import COMMA_NOTE
from rendezview_ground.mesh.usd import USD_SUFFIXES, read_usd

STEP_SUFFIXES = (".step", ".stp")

_TEXTURE_TROUBLE = re.compile(r"pillow|image|texture|bumpmap", re.IGNORECASE)
_HEADER = 65_536  # bytes in which that of a PLY or OFF file ends
_LOGGERS = ("trimesh", "collada")
_MOST_RECORDS = 1_000_000  # of a log, which is emptied then. Source: a bound only


def read_mesh_file(path: Path, node: str | None = None) -> MeshFile:
    """Read one file of a supported format.

    Args:
        path: the file.
        node: of its scene; None: all of it.

    Raises:
        RendezviewError: the file cannot be read, or has no such node; the message names the file.
    """
    kind = path.suffix.lower().lstrip(".").upper()
    try:
        return READERS[path.suffix.lower()](path, node)
    except RendezviewError:
        raise
    except ImportError as error:
        raise RendezviewError(
            f"{path}: reading {kind} files needs another package ({error}). "
            "Install it with: pip install 'rendezview[training]'"
        ) from error
    except Exception as error:  # each format's reader raises its own kinds
        cause = " ".join(str(error).split())[:200] or "no message"
        raise RendezviewError(
            f"{path} cannot be read as {kind}: {type(error).__name__}: {cause}. "
            "The file is damaged, cut short or of another format; export it again."
        ) from error


def _read_gltf(path: Path, node: str | None) -> MeshFile:
    plain, notes = plain_gltf(path)
    found = _read_with_trimesh(path, node, None if plain is None else (plain, "gltf"))
    return replace(found, notes=(*notes, *found.notes))


def _read_ply(path: Path, node: str | None) -> MeshFile:
    """PLY, whose comments may be in any encoding."""
    with path.open("rb") as stream:
        start = stream.read(_HEADER)
    end = start.find(b"end_header")
    if end < 0 or start[:end].isascii():
        return _read_with_trimesh(path, node)
    plain = start[:end].decode("ascii", errors="replace").encode("ascii", errors="replace")
    return _read_with_trimesh(path, node, (plain + path.read_bytes()[end:], "ply"))


def _read_dae(path: Path, node: str | None) -> MeshFile:
    """Collada, whose numbers may have decimal commas throughout."""
    content = path.read_bytes()
    if not has_decimal_commas(content):
        return _read_with_trimesh(path, node)
    points = re.sub(rb"(?<=\d),(?=\d)", b".", content)
    found = _read_with_trimesh(path, node, (points, "dae"))
    return replace(found, notes=(COMMA_NOTE, *found.notes))


def _read_off(path: Path, node: str | None) -> MeshFile:
    """OFF, whose end trimesh does not miss."""
    found = _read_with_trimesh(path, node)
    with path.open("rb") as stream:
        start = re.sub(rb"#.*", b"", stream.read(_HEADER))
    counts = re.search(rb"OFF\s*\d+\s+(\d+)", start)
    if counts and len(found.faces) < int(counts[1]):
        raise ValueError(f"{counts[1].decode()} faces are announced, {len(found.faces)} are there")
    return found


def _read_with_trimesh(
    path: Path, node: str | None, replaced: tuple[bytes, str] | None = None
) -> MeshFile:
    """The triangles of a file, or of the content and its kind that replace it."""
    suffix = path.suffix.lower()
    if suffix in STEP_SUFFIXES:
        with tempfile.TemporaryDirectory() as folder:
            triangles = Path(folder) / "from-step.glb"
            count = triangulate_step(path, triangles)
            found = _read_with_trimesh(triangles, node)
        return replace(
            found,
            unit=(1.0, "STEP, converted to metres"),
            notes=(step_note(count, found.faces), *found.notes),
        )
    if suffix == ".3mf":
        check_3mf(path)
    unit = file_unit(path)
    with _quiet() as messages:
        import trimesh

        options: dict[str, Any] = {"process": False}
        if suffix == ".3mf":
            options["postprocess"] = False  # it would rename and merge bodies
        if replaced is None:
            scene = trimesh.load_scene(str(path), file_type=suffix[1:], **options)
        else:
            beside = trimesh.resolvers.FilePathResolver(str(path))
            scene = trimesh.load_scene(
                io.BytesIO(replaced[0]), file_type=replaced[1], resolver=beside, **options
            )
    notes = _texture_notes(path, messages)
    lost_texture = any(note.startswith("Textures") for note in notes)
    colours = _special_colours(path, scene, notes)
    parts: list[Part] = []
    others = grey_faces = 0
    chosen = nodes_below(scene.graph, node, path)
    for part in scene.graph.nodes_geometry:
        if chosen is not None and part not in chosen:
            continue
        matrix, name = scene.graph[part]
        geometry = scene.geometry[name]
        if getattr(geometry, "faces", None) is None or len(geometry.faces) == 0:
            others += 1
            continue
        vertices = np.asarray(geometry.vertices, dtype=np.float64)
        faces = np.asarray(geometry.faces, dtype=np.int64)
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise ValueError(f"a face uses a vertex that is not there (there are {len(vertices)})")
        rgb = colours.get(str(name))
        if rgb is None:
            rgb = visual_face_rgb(geometry, suffix in (".glb", ".gltf"), lost_texture)
        if rgb is None:
            grey_faces += len(faces)
            rgb = grey(len(faces))
        with np.errstate(invalid="ignore"):  # NaN, which is dropped and counted later
            parts.append((vertices @ matrix[:3, :3].T + matrix[:3, 3], faces, rgb))
    if len(parts) > 1:
        notes.append(f"{len(parts)} bodies joined into one.")
    if others:
        notes.append(f"{counted(others, 'body')} without triangles (points, lines) ignored.")
    total = sum(len(faces) for _, faces, _ in parts)
    if 0 < grey_faces < total:
        notes.append(f"{counted(grey_faces, 'face')} without a colour: grey.")
    return joined(parts, unit, notes)


def _special_colours(path: Path, scene: Any, notes: list[str]) -> dict[str, Rgb]:
    """Colours by geometry name that trimesh does not read: 3MF."""
    if path.suffix.lower() == ".3mf":
        colours = colours_of_3mf(path)
        counts = [len(geometry.faces) for geometry in scene.geometry.values()]
        if [len(rgb) for rgb in colours] == counts:
            return dict(zip(scene.geometry, colours, strict=True))
        notes.append("Colours ignored: the 3MF file spreads its meshes over several parts.")
    return {}


def _texture_notes(path: Path, messages: list[tuple[int, str]]) -> list[str]:
    """Notes from the library's log; it reports lost textures at debug level only."""
    notes: list[str] = []
    troubled = [text for _, text in messages if _TEXTURE_TROUBLE.search(text)]
    if refers_to_texture(path) and troubled:
        if any("pillow" in text.lower() for text in troubled) or not _has_pillow():
            notes.append(
                "Textures ignored: install Pillow (pip install pillow) to use their colours."
            )
        else:
            notes.append("Textures not found or not readable: their faces keep their plain colour.")
    warned = [text for level, text in messages if level >= logging.WARNING]
    notes += [
        f"trimesh reports: {text.rstrip('.')}."
        for text in dict.fromkeys(warned)
        if text not in troubled
    ]
    return notes


def _has_pillow() -> bool:
    try:
        import PIL.Image  # noqa: F401
    except ImportError:
        return False
    return True


@contextlib.contextmanager
def _quiet() -> Iterator[list[tuple[int, str]]]:
    """Record the library's logs and warnings, and keep its output off the terminal.

    What is yielded is filled at the end: level and first line of each.
    """
    recorder, messages = BufferingHandler(_MOST_RECORDS), list[tuple[int, str]]()
    loggers = [logging.getLogger(name) for name in _LOGGERS]
    before = [(logger.level, logger.propagate, list(logger.handlers)) for logger in loggers]
    try:
        for logger in loggers:
            logger.setLevel(logging.DEBUG)
            logger.propagate = False
            logger.handlers = [recorder]
        with (
            warnings.catch_warnings(record=True) as caught,
            contextlib.redirect_stdout(io.StringIO()),
            contextlib.redirect_stderr(io.StringIO()),
        ):
            warnings.simplefilter("always")
            yield messages
    finally:
        for logger, (level, propagate, handlers) in zip(loggers, before, strict=True):
            logger.setLevel(level)
            logger.propagate = propagate
            logger.handlers = handlers
    said = [(record.levelno, record.getMessage()) for record in recorder.buffer]
    said += [
        (logging.WARNING, str(warning.message))
        for warning in caught
        if not issubclass(warning.category, (DeprecationWarning, ResourceWarning))
    ]
    messages += [(level, text.partition("\n")[0]) for level, text in said]


# Reader of each suffix. A new format is a file with a reader, and its line here.
READERS: dict[str, Callable[[Path, str | None], MeshFile]] = {
    ".stl": read_stl,
    ".obj": read_obj,
    ".ply": _read_ply,
    ".off": _read_off,
    **dict.fromkeys(GLTF_SUFFIXES, _read_gltf),
    ".3mf": _read_with_trimesh,
    ".dae": _read_dae,
    **dict.fromkeys(STEP_SUFFIXES, _read_with_trimesh),
    **dict.fromkeys(USD_SUFFIXES, read_usd),
}
