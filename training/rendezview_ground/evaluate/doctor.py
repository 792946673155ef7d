"""What is wrong with a mesh, what is done about it, and what it costs in accuracy."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from rendezview.geometry.geodesic import Geodesic
from rendezview.geometry.symmetry import Symmetry
from rendezview.io.sequences import Sequence
from rendezview_ground.learn.look_alike_words import look_alike_words
from rendezview_ground.learn.look_alikes import look_alikes
from rendezview_ground.learn.options import TrainingOptions, view_geometry
from rendezview_ground.learn.views.drawn_view import draw_view
from rendezview_ground.mesh.bounding_sphere import smallest_enclosing_sphere
from rendezview_ground.mesh.colours import GREY
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.mesh.notes import counted
from rendezview_ground.mesh.simplify import MANY_FACES
from rendezview_ground.mesh.symmetries import described, find_symmetries
from rendezview_ground.mesh.triangles import Edges, crosses, twice_areas

# Times larger by one body: a question, and a warning. Source: one panel of a craft makes 1.5
_FAR, _TOO_FAR = 1.5, 2.0
_CANDIDATES = 12  # bodies at the outside that are tried. Source: a forgotten part is the largest
_BODY_SHARE = 0.05  # of all triangles: larger bodies belong to the target. Source: a chosen limit
_VIEW_PX = 512  # px; of a view that looks for hidden faces. Source: the views of `train`
_BORDER_PX = 4.0  # px around the target. Source: by construction
_HIDDEN_SHARE = 0.05  # of the area; fewer are no finding. Source: a chosen limit
# rad; a curved surface bends by this much from facet to facet, an edge of the craft by more.
_BENDS_RAD = (math.radians(0.5), math.radians(45.0))  # Source: 8 facets to a circle, and more
_FLAT_RAD = math.radians(25.0)  # sharper bends may be meant. Source: bodies of up to 14 sides
_FACET_SHARE = 0.001  # of the radius: a finding above it. Source: the range error of `track`


class Mark(StrEnum):
    """How much a finding matters."""

    FINE = "fine"
    NOTE = "note"
    ACT = "act"  # the user should change the mesh


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the report."""

    mark: Mark
    what: str
    done: str  # what the program does about it
    cost: str  # in accuracy, or in time


@dataclass(frozen=True, slots=True, eq=False)
class Diagnosis:
    """All findings, and what the picture shows of them."""

    mesh: Mesh
    findings: tuple[Finding, ...]
    symmetries: tuple[Symmetry, ...]
    open_edges: NDArray[np.int64]  # (K, 2) vertices
    mixed_edges: NDArray[np.int64]  # (K, 2) vertices
    far_faces: NDArray[np.bool_]  # (F,) of a body that should not be there

    @property
    def healthy(self) -> bool:
        """Whether nothing needs to be done."""
        return all(finding.mark is not Mark.ACT for finding in self.findings)


def diagnose(mesh: Mesh, progress: Callable[[int, int], None] | None = None) -> Diagnosis:
    """Examine a mesh as `load_mesh` gives it.

    Args:
        mesh: cleaned, metres.
        progress: called with the number of views drawn and their total.
    """
    edges, symmetries = Edges.of(mesh.faces), tuple(find_symmetries(mesh))
    far, far_finding = _far_body(mesh)
    findings = [
        Finding(Mark.FINE, " ".join(mesh.notes[:2]), "read as it is", "none"),
        *_asked(mesh.doubts, "all ranges, if it is wrong"),
        *[_reading(note) for note in _cleaning_notes(mesh)],
        *far_finding,
        *_topology(mesh, edges),
        *_facets(mesh, edges),
        *_hidden(mesh, progress),
        *_kind(mesh, symmetries),
    ]
    return Diagnosis(mesh, tuple(findings), symmetries, edges.open_edges, edges.mixed_edges, far)


def of_frames(sequence: Sequence) -> tuple[Finding, ...]:
    """What is odd about frames, their times and their camera."""
    doubts = tuple(doubt for frame in sequence.frames[:1] for doubt in frame.camera.doubts)
    notes = [note for note in sequence.notes if note not in doubts]
    return (
        *_asked(doubts, "all poses, if it is wrong"),
        *[Finding(Mark.NOTE, note, "read so", "see the note") for note in notes],
    )


def _asked(doubts: Iterable[str], cost: str) -> list[Finding]:
    return [Finding(Mark.ACT, doubt, "taken as it is", cost) for doubt in doubts]


def _cleaning_notes(mesh: Mesh) -> list[str]:
    """The notes of reading, without those on topology, which have findings of their own."""
    return [
        note
        for note in mesh.notes[2:]
        if note not in mesh.doubts
        and not note.startswith(("Not watertight", "Mixed winding", "No usable colours"))
    ]


def _reading(note: str) -> Finding:
    """A note of reading the file as a finding."""
    if note.endswith("dropped."):
        return Finding(Mark.NOTE, note, "left out", "none")
    if "grey" in note or "olour" in note or "exture" in note:
        return Finding(
            Mark.NOTE, note, "shown in the colour that is known, else 0.6 grey",
            "brightness tells less where colours are missing",
        )  # fmt: skip
    return Finding(Mark.NOTE, note, "accepted", "none")


def _topology(mesh: Mesh, edges: Edges) -> Iterator[Finding]:
    still_open, mixed = len(edges.open_edges), len(edges.mixed_edges)
    if still_open:
        share = 100.0 * still_open / len(edges.count)
        yield Finding(
            Mark.NOTE,
            f"The surface has {counted(still_open, 'open edge')} ({share:.1f} % of its edges).",
            "both sides of every face are drawn; nothing is closed",
            "none for sheets and joints; a real hole in the hull shows the inside or the sky",
        )
    else:
        yield Finding(Mark.FINE, "The surface is closed.", "–", "none")
    if mixed:
        yield Finding(
            Mark.NOTE,
            f"Neighbouring faces are wound in opposite directions at {counted(mixed, 'edge')}.",
            "winding is not used anywhere",
            "none",
        )
    doubled = len(mesh.faces) - len(np.unique(np.sort(mesh.faces, axis=1), axis=0))
    if doubled:
        yield Finding(
            Mark.NOTE, f"{counted(doubled, 'face')} of the same three corners as another.",
            "the first is seen", "none; of two colours the wrong one may show",
        )  # fmt: skip


def _far_body(mesh: Mesh) -> tuple[NDArray[np.bool_], list[Finding]]:
    """The body without which the target is much smaller."""
    none = np.zeros(len(mesh.faces), dtype=bool)
    vertices = len(mesh.vertices_m)
    links = mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    graph = coo_array((np.ones(len(links), np.int8), (links[:, 0], links[:, 1])), (vertices,) * 2)
    total, body = connected_components(graph, directed=False)
    if total < 2:
        return none, []
    centre_m, radius_m = mesh.bounding_sphere
    of_face = body[mesh.faces[:, 0]]
    sizes = np.bincount(of_face, minlength=total)
    out_m = np.linalg.norm(mesh.vertices_m - centre_m, axis=1)
    reach = np.zeros(total)
    np.maximum.at(reach, body, out_m)
    for candidate in np.argsort(-reach)[:_CANDIDATES]:
        if sizes[candidate] > _BODY_SHARE * len(mesh.faces):
            continue
        rest = mesh.vertices_m[np.unique(mesh.faces[of_face != candidate])]
        _, without_m = smallest_enclosing_sphere(rest)
        if radius_m > _FAR * without_m:
            times = radius_m / without_m
            return of_face == candidate, [
                Finding(
                    Mark.ACT if times > _TOO_FAR else Mark.NOTE,
                    f"One body of {counted(int(sizes[candidate]), 'triangle')} makes the target "
                    f"{times:.1f} times larger: {2.0 * radius_m:.3g} m across instead of "
                    f"{2.0 * without_m:.3g} m. Is it a floor, a datum plane or a stand?",
                    "kept",
                    f"if it does not fly, remove it: views are {times:.1f} times smaller, and "
                    f"errors are {times:.1f} times larger",
                )
            ]
    return none, []


def _facets(mesh: Mesh, edges: Edges) -> list[Finding]:
    """How far the facets of curved surfaces are inside them: w tan(α/4) / 2 for a bend α."""
    inner = edges.count == 2
    cross = crosses(mesh.vertices_m[mesh.faces])
    twice = np.linalg.norm(cross, axis=1)
    normal = cross / twice[:, None]
    a, b = edges.faces[inner].T
    cosine = np.abs((normal[a] * normal[b]).sum(axis=1))  # winding may be mixed
    bend = np.arccos(np.clip(cosine, -1.0, 1.0))
    ends = mesh.vertices_m[edges.ends[inner]]
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    width = np.minimum(twice[a], twice[b]) / np.maximum(length, 1e-12)
    curved = (bend > _BENDS_RAD[0]) & (bend < _BENDS_RAD[1])
    if not curved.any():
        return []
    depth = 0.5 * width[curved] * np.tan(0.25 * bend[curved])
    order = np.argsort(depth)
    share = np.cumsum(length[curved][order]) / length[curved].sum()
    depth_m = float(depth[order][np.searchsorted(share, 0.9)])
    _, radius_m = mesh.bounding_sphere
    part = depth_m / radius_m
    place = int(np.searchsorted(share, 0.9))
    flat = part > _FACET_SHARE and bool(bend[curved][order][place] > _FLAT_RAD)
    return [
        Finding(
            Mark.ACT if part > 10.0 * _FACET_SHARE and not flat
            else Mark.NOTE if part > _FACET_SHARE else Mark.FINE,
            f"Facets of curved surfaces are {1e3 * depth_m:.2g} mm inside them "
            f"({100.0 * part:.2g} % of the radius; 90 % are better).",
            "drawn as they are",
            f"range too short by up to about {100.0 * part:.2g} %"
            + ("; none if the craft is built of flat sides" if flat
               else "; export with a finer tolerance" if part > _FACET_SHARE else ""),
        )
    ]  # fmt: skip


def _hidden(mesh: Mesh, progress: Callable[[int, int], None] | None) -> list[Finding]:
    """Faces that no view shows."""
    geometry = view_geometry(mesh, TrainingOptions(), None)
    seen = np.zeros(len(mesh.faces), dtype=bool)
    directions = Geodesic.of_order(1).nodes
    for k, direction in enumerate(directions):
        view = draw_view(mesh, geometry, direction, geometry.sphere_radius_m, _VIEW_PX, _BORDER_PX)
        seen[view.owner[view.owner >= 0]] = True
        if progress is not None:
            progress(k + 1, len(directions))
    area = twice_areas(mesh.vertices_m[mesh.faces])
    share = float(area[~seen].sum() / area.sum())
    words = f"{100.0 * share:.0f} % of the surface is never seen from outside"
    if share < _HIDDEN_SHARE:
        return [Finding(Mark.FINE, words + ".", "–", "none")]
    return [
        Finding(
            Mark.NOTE,
            f"{words} ({counted(int((~seen).sum()), 'face')}): interior parts, or the backs of "
            "double walls.",
            "kept",
            "none; training is faster without them",
        )
    ]


def _kind(mesh: Mesh, symmetries: tuple[Symmetry, ...]) -> Iterator[Finding]:
    """What is known of the target beside its surface."""
    if symmetries:
        yield Finding(
            Mark.NOTE,
            f"It {described(symmetries)}.",
            "written into the model; poses are one of the equivalent ones",
            "the attitude is known only up to that turn; a coloured marking decides it",
        )
    if np.allclose(mesh.face_rgb, GREY):
        yield Finding(
            Mark.NOTE, "The file has no colours.", "all surfaces are equally bright",
            "brightness tells less of the Sun and of nearly symmetric sides",
        )  # fmt: skip
    if len(mesh.faces) > MANY_FACES:
        yield Finding(
            Mark.NOTE, f"{counted(len(mesh.faces), 'triangle')} are more than accuracy needs.",
            "views are drawn with fewer, of the same shape", "none; a little time in training",
        )  # fmt: skip


def of_look_alikes(mesh: Mesh, symmetries: tuple[Symmetry, ...]) -> list[Finding]:
    """Turns that change little of a mesh, beside its symmetries: some seconds of work."""
    near = look_alikes(mesh, mesh.bounding_sphere[0])
    turns = np.array([one.turn for one in near]).reshape(-1, 3, 3)
    alike = np.array([one.alike for one in near])
    words = look_alike_words(turns, alike, symmetries)
    if words is None:
        return []
    return [
        Finding(
            Mark.NOTE,
            f"It {words}.",
            "the poses that look alike are drawn beside each first pose",
            "a first pose is ambiguous where the frame does not tell them apart; a prior, the "
            "Sun's direction or another view does",
        )
    ]
