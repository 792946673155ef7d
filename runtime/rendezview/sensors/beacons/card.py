"""A card of three dots to print and fold: its PDF page and its target file.

The strip folds into a hat: two flats at the ends hold the outer dots, the raised middle holds the
third, as the post of Book et al.'s target. A flat card of three dots would often have two poses.
"""

from __future__ import annotations

import math
from enum import StrEnum
from pathlib import Path

from rendezview.errors import RendezviewError
from rendezview.io.files import atomic_write, atomic_write_text


class Paper(StrEnum):
    """The size of a page."""

    A4 = "a4"
    LETTER = "letter"


# Across. Source: ISO 216; ANSI/ASME Y14.1, size A
_PAGES_MM = {Paper.A4: (297.0, 210.0), Paper.LETTER: (279.4, 215.9)}
_PANELS_MM = (70.0, 35.0, 60.0, 35.0, 70.0)  # flat, riser, top, riser, flat. Source: fits 279.4 mm
# Of the strip: white about the largest dot as far again as its diameter, with room for tilt.
_WIDTH_MM = 90.0  # Source: by construction
_OUTER_MM = 35.0  # of an outer dot from its end of the strip. Source: the middle of a flat
_POINTS_PER_MM = 72.0 / 25.4  # Source: ISO 32000-1, the unit of PDF
_ROUND = 0.5522847498  # of a circle's Bézier handles over its radius. Source: 4/3 (√2 − 1)
# By code the diameters of left, post and right over the given one: a larger right dot tells which
# way up, as in Book et al., and the post which card it is. Source: by construction
_DOTS = {1: (1.0, 1.0, 1.5), 2: (1.0, 1.5, 1.5)}


def dots_m(diameter_m: float, code: int = 1) -> list[tuple[str, tuple[float, float, float], float]]:
    """Name, place and diameter of every dot of the folded card: x right, y up, z to the viewer.

    ``code``, 1 or 2, tells two cards apart.
    """
    flat, height, top, _, _ = _PANELS_MM
    reach = 0.5 * top + flat - _OUTER_MM
    places = ((-reach, 0.0, 0.0), (0.0, 0.0, height), (reach, 0.0, 0.0))
    return [
        (name, (1e-3 * x, 1e-3 * y, 1e-3 * z), factor * diameter_m)
        for name, factor, (x, y, z) in zip(
            ("left", "post", "right"), _DOTS[code], places, strict=True
        )
    ]


def write_card(
    folder: Path, diameter_m: float = 0.016, paper: Paper = Paper.A4, code: int = 1
) -> None:
    """Write ``card.pdf`` and ``target.toml`` into a folder.

    Raises:
        RendezviewError: the dots do not fit, or a file cannot be written.
    """
    diameter_mm = 1e3 * diameter_m
    if not 4.0 <= diameter_mm <= 24.0:
        raise RendezviewError(f"a dot must be 4 to 24 mm wide, not {diameter_mm:g} mm")
    with atomic_write(folder / "card.pdf") as file:
        file.write(_pdf(diameter_mm, _PAGES_MM[paper], _DOTS[code]))
    name_of = "card" if code == 1 else f"card{code}"
    lines = [
        f'name = "{name_of}"',
        'description = "a strip of three dots folded into a hat; printed from card.pdf"',
    ]
    for name, place, wide in dots_m(diameter_m, code):
        lines += [
            "", "[[reflectors]]", f'name = "{name}"', f'group = "{name_of}"',
            f"position_m = [{', '.join(f'{value:.6g}' for value in place)}]",
            "normal = [0.0, 0.0, 1.0]", f"diameter_m = {wide:.6g}",
        ]  # fmt: skip
    atomic_write_text(folder / "target.toml", "\n".join(lines) + "\n")


def _pdf(
    diameter_mm: float, page_mm: tuple[float, float], factors: tuple[float, float, float]
) -> bytes:
    """One page: outline, fold lines, dots, a scale bar and a line of instructions."""
    left, bottom = 0.5 * (page_mm[0] - sum(_PANELS_MM)), 0.5 * (page_mm[1] - _WIDTH_MM)
    middle = 0.5 * page_mm[1]
    drawn = [f"{_POINTS_PER_MM:.6f} 0 0 {_POINTS_PER_MM:.6f} 0 0 cm", "0.2 w"]
    drawn.append(f"{left} {bottom} {sum(_PANELS_MM)} {_WIDTH_MM} re S")
    at = left
    drawn.append("[2 2] 0 d")
    for panel in _PANELS_MM[:-1]:
        at += panel
        drawn.append(f"{at} {bottom} m {at} {bottom + _WIDTH_MM} l S")
    drawn.append("[] 0 d 0 g")
    places = (left + _OUTER_MM, 0.5 * page_mm[0], left + sum(_PANELS_MM) - _OUTER_MM)
    for x, factor in zip(places, factors, strict=True):
        drawn.append(_circle(x, middle, 0.5 * factor * diameter_mm))
    drawn.append(f"0.4 w {left} 40 m {left + 100.0} 40 l S")
    for x in (left, left + 100.0):
        drawn.append(f"{x} 38 m {x} 42 l S")
    words = (
        (left, 33.0, "100 mm: print at 100 %, and measure this bar"),
        (left, 27.0, "Cut out; fold the dashed lines: 1 and 4 towards you, 2 and 3 away: a hat."),
        (
            left,
            15.0,
            "Is the bar 97 mm? Then so are ranges 3 % too long: calibrate pattern --length.",
        ),
        (left, 21.0, "Glue both ends flat on cardboard, 200 mm from edge to edge."),
    )
    for x, y, text in words:
        drawn.append(f"BT /F1 4 Tf {x} {y} Td ({text}) Tj ET")
    stream = "\n".join(drawn).encode("ascii")
    width, height = (_POINTS_PER_MM * side for side in page_mm)
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.3f} {height:.3f}] /Contents 4 0 R "
        "/Resources << /Font << /F1 5 0 R >> >> >>".encode(),
        f"<< /Length {len(stream)} >>\nstream\n".encode() + stream + b"\nendstream",
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    return _file(objects)


def _circle(x: float, y: float, radius: float) -> str:
    """A filled circle of four Bézier curves (0.03 % of the radius off)."""
    h = _ROUND * radius
    parts = [f"{x + radius:.4f} {y:.4f} m"]
    for k in range(4):
        c, s = round(math.cos(k * math.pi / 2)), round(math.sin(k * math.pi / 2))
        corners = ((radius, h), (h, radius), (0.0, radius))
        numbers = (f"{x + c * u - s * v:.4f} {y + s * u + c * v:.4f}" for u, v in corners)
        parts.append(" ".join(numbers) + " c")
    return "\n".join([*parts, "f"])


def _file(objects: list[bytes]) -> bytes:
    """A PDF of some objects, numbered from 1, the first the catalogue."""
    out, places = b"%PDF-1.4\n", []
    for number, content in enumerate(objects, 1):
        places.append(len(out))
        out += f"{number} 0 obj\n".encode() + content + b"\nendobj\n"
    table = "".join(f"{place:010d} 00000 n \n" for place in places)
    count, start = len(objects) + 1, len(out)
    return (
        out
        + (
            f"xref\n0 {count}\n0000000000 65535 f \n{table}trailer\n"
            f"<< /Size {count} /Root 1 0 R >>\n"
            f"startxref\n{start}\n%%EOF\n"
        ).encode()
    )
