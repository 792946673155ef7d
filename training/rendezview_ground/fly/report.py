"""The page of a flight, and of many: one file without scripts or network."""

from __future__ import annotations

import math
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from rendezview.io.files import atomic_write_text
from rendezview_ground.evaluate.page import WEBM, Card, document, figure, table_of, tiles_of
from rendezview_ground.evaluate.pictures.palette import png
from rendezview_ground.fly.campaign import agreement, worst
from rendezview_ground.fly.faults import Fault
from rendezview_ground.fly.loop import Flight
from rendezview_ground.fly.options import EnvelopeOptions
from rendezview_ground.fly.pictures import (
    bars_picture,
    corridor_picture,
    error_picture,
    footprint_picture,
)
from rendezview_ground.fly.setup import Setup

FILM = "approach.webm"  # of rendered frames, in the folder of the page
_TALL = 1.115  # height over width of a drawn frame, with its bar of text
_WORST = 12  # flights of an end in the table of worst cases
_REPLAYED = 2  # of these with a page


def write_flight_page(
    folder: Path, name: str, setup: Setup, flight: Flight, seed: int, fault: Fault | None,
    service: str | None = None,
) -> Path:  # fmt: skip
    """One flight, perhaps at a service; the path of its page."""
    last, touch = flight.moments[-1], flight.contact
    good = flight.end != "outside"
    tiles = [(flight.end, "end of the flight", not good),
             (f"{last.time_s:.0f} s", "flown", False),
             (f"{last.spent_m_s:.2f} m/s", "thrust", False)]  # fmt: skip
    tiles.append((f"{flight.beyond} of {flight.known}", "steps beyond the protection level, "
                  "unalarmed", flight.beyond > 0))  # fmt: skip
    if touch is not None:
        rows = _contact_rows(setup.plan.envelope, {k: getattr(touch, k) for k in touch.__slots__})
        contact = "<h2>Contact conditions</h2>" + table_of(("", "at contact", "limit", ""), rows)
    else:
        contact = f"<h2>No contact</h2><p>{escape(last.reason or 'held')}</p>"
    cards: tuple[Card, ...] = (
        Card("corridor", "In the corridor", "The chaser's port before the target's. Grey: the "
             "corridor; dotted: hold points.", png(corridor_picture(flight, setup))),
        Card("errors", "The fused state", "Errors with protection levels, sensors in use, "
             "rival hypotheses weighed, thrust.",
             png(error_picture(flight))),
    )  # fmt: skip
    film = folder / FILM
    if setup.model is not None and film.exists():
        cards = (Card("film", "What the camera sees", "With the recognizer's pose.",
                      film.read_bytes(), WEBM, _TALL), *cards)  # fmt: skip
    frames = "modelled readings" if setup.model is None else "rendered frames"
    frames = frames if service is None else f"frames tracked by {escape(service)}"
    body = f"""<h1>{escape(name)}: flight to the port</h1>
<p class="quiet">Closed loop with {frames}, seed {seed}, {_fault(fault)}</p>
<div class="tiles">{tiles_of(tiles)}</div>
{contact}
<h2>The flight</h2>
<div class="wide">{"".join(map(figure, cards))}</div>
<h2>What the guidance decided</h2>
{table_of(("from, s", "mode", "port to port, m", "reason"), _decisions(flight))}
"""
    path = folder / "flight.html"
    atomic_write_text(path, document(f"{name}: flight", body))
    return path


def write_campaign_page(
    folder: Path, name: str, setup: Setup, lines: list[dict[str, Any]],
    beside: list[dict[str, Any]] | None = None,
) -> Path:  # fmt: skip
    """Many flights; the path of their page.

    Args:
        beside: other flights whose contacts are compared, such as rendered with modelled ones.
    """
    names = {key: words.split(",")[0] for words, key, *_ in _limits(setup.plan.envelope)}
    rows = [(names[key], str(m), str(n), f"{p:.2g}")
            for key, m, n, p in agreement(lines, beside or [])]  # fmt: skip
    compared = "" if not rows else (
        "<h2>Beside other flights</h2><p class=\"quiet\">Kolmogorov–Smirnov test of the faultless "
        "contacts; below 0.05 they differ.</p>" + table_of(("", "flights", "others", "p"), rows)
    )  # fmt: skip
    ends = [line["end"] for line in lines]
    plain = [line["end"] for line in lines if line["fault"] is None]
    beyond, steps = (sum(line[key] for line in lines) for key in ("beyond", "steps"))
    tiles = [(str(len(lines)), "flights", False),
             (f"{ends.count('contact')}", "in contact, inside the envelope", False),
             (f"{ends.count('outside')}", "in contact, outside", "outside" in ends),
             (f"{len(ends) - ends.count('contact') - ends.count('outside')}", "held or aborted",
              False)]  # fmt: skip
    if plain:
        share = 100.0 * plain.count("contact") / len(plain)
        tiles.append((f"{share:.1f} %", "of the faultless in contact", share < 99.0))
    tiles.append((f"{beyond} of {steps}", "steps beyond the protection level, unalarmed",
                  beyond > 1e-3 * steps))  # fmt: skip
    cards = (
        Card("ends", "How they ended", "", png(bars_picture(lines))),
        Card("footprint", "Contact conditions", "Green: inside the envelope.",
             png(footprint_picture(lines, setup))),
    )  # fmt: skip
    body = f"""<h1>{escape(name)}: {len(lines)} flights to the port</h1>
<div class="tiles">{tiles_of(tiles)}</div>
<h2>All flights</h2>
<div class="wide">{"".join(map(figure, cards))}</div>
<h2>Median and largest contact conditions</h2>
{table_of(("", "median", "largest", "limit"), _statistics(setup.plan.envelope, lines))}
{compared}
<h2>Worst flights</h2>
<p class="quiet">The first have a page. Any flight again, with its page: <code>--seed</code>, and
<code>--faults</code> where it had one.</p>
{_worst_table(shown(lines, setup), replayed(lines, setup))}
"""
    path = folder / "flights.html"
    atomic_write_text(path, document(f"{name}: flights", body))
    return path


def _fault(fault: Fault | None) -> str:
    return "no fault" if fault is None else f"fault: {fault.kind} from {fault.begin_s:.0f} s"


def _limits(envelope: EnvelopeOptions) -> list[tuple[str, str, float, str, float, float]]:
    """Words, key, unit, form, and both limits of each contact condition."""
    degrees, slow, fast = math.pi / 180.0, *envelope.closing_m_s
    return [
        ("lateral, m", "lateral_m", 1.0, "{:.4f}", 0.0, envelope.lateral_m),
        ("tilt, °", "tilt_rad", degrees, "{:.2f}", 0.0, envelope.angle_deg),
        ("roll, °", "roll_rad", degrees, "{:.2f}", 0.0, envelope.angle_deg),
        ("closing, m/s", "closing_m_s", 1.0, "{:.4f}", slow, fast),
        ("lateral speed, m/s", "lateral_m_s", 1.0, "{:.4f}", 0.0, envelope.lateral_m_s),
        ("rate across, °/s", "across_rad_s", degrees, "{:.3f}", 0.0, envelope.rate_deg_s),
        ("rate about, °/s", "about_rad_s", degrees, "{:.3f}", 0.0, envelope.rate_deg_s),
    ]


def _span(low: float, high: float) -> str:
    return f"{low:g}–{high:g}" if low else f"{high:g}"


def _contact_rows(envelope: EnvelopeOptions, touch: dict[str, float]) -> list[tuple[str, ...]]:
    return [
        (words, form.format(touch[key] / unit), _span(low, high),
         "inside" if low <= touch[key] / unit <= high else "outside")
        for words, key, unit, form, low, high in _limits(envelope)
    ]  # fmt: skip


def _statistics(envelope: EnvelopeOptions, lines: list[dict[str, Any]]) -> list[tuple[str, ...]]:
    touches = [line["contact"] for line in lines if line["contact"]]
    if not touches:
        return []
    rows: list[tuple[str, ...]] = []
    for words, key, unit, form, low, high in _limits(envelope):
        values = np.array([touch[key] for touch in touches]) / unit
        rows.append((words, form.format(float(np.median(values))),
                     form.format(float(values.max())), _span(low, high)))  # fmt: skip
    return rows


def _decisions(flight: Flight) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    last = None
    for moment in flight.moments:
        told = (moment.mode, moment.reason if moment.mode != "approach" else "")
        if last is None or told[0] != last:
            rows.append((f"{moment.time_s:.1f}", told[0], f"{moment.true.range_m:.2f}", told[1]))
        last = told[0]
    return rows


def shown(lines: list[dict[str, Any]], setup: Setup) -> list[tuple[float, dict[str, Any]]]:
    """The worst flights and the largest share of a limit that each used, NaN without contact.

    Contacts outside the envelope first, then flights without one, then the rest.
    """
    missed = [(math.nan, line) for line in lines if line["contact"] is None]
    touched = worst(lines, setup)
    outside = [pair for pair in touched if pair[1]["end"] == "outside"]
    inside = [pair for pair in touched if pair[1]["end"] != "outside"]
    return [*outside[:_WORST], *missed[:_WORST], *inside[:_WORST]]


def replayed(lines: list[dict[str, Any]], setup: Setup) -> list[dict[str, Any]]:
    """The flights whose pages a campaign keeps: the worst of each end."""
    ends: dict[str, list[dict[str, Any]]] = {}
    for _, line in shown(lines, setup):
        ends.setdefault(line["end"], []).append(line)
    return [line for some in ends.values() for line in some[:_REPLAYED]]


def replay_folder(line: dict[str, Any]) -> str:
    """Where the page of a campaign's flight is, beside that of the campaign."""
    return f"seed-{line['seed']}"


def _worst_table(rows: list[tuple[float, dict[str, Any]]], kept: list[dict[str, Any]]) -> str:
    cells = []
    for used, line in rows:
        again = f"--seed {line['seed']}" + (f" --faults {line['fault']}" if line["fault"] else "")
        if line in kept:
            again = f'<a href="{replay_folder(line)}/flight.html">{again}</a>'
        share = "–" if math.isnan(used) else f"{100.0 * used:.0f}"
        told = "".join(
            f"<td>{x}</td>" for x in (line["end"], share, f"{line['time_s']:.0f}", again)
        )
        cells.append(f"<tr>{told}</tr>")
    head = "<th>end</th><th>of a limit, %</th><th>time, s</th><th>again</th>"
    return f'<div class="table"><table><tr>{head}</tr>{"".join(cells)}</table></div>'
