"""The page of a report: one HTML file with its pictures inside, without scripts or network."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from collections.abc import Sequence as Ordered
from dataclasses import dataclass
from html import escape

import numpy as np

from rendezview.io.sequences import Sequence
from rendezview.sensors.appearance import AppearanceObservation, ViewModel
from rendezview_ground.evaluate.evaluation import Evaluation, summary_rows
from rendezview_ground.evaluate.pictures.palette import (
    ACTIVE,
    BACKGROUND,
    GRID,
    INK,
    MUTED,
    PANEL,
    PROBLEM,
)

PNG, WEBM = "image/png", "video/webm"
# Names of the pictures in a column of their own, and of those over the whole width.
_PAIR = ("sphere", "signature", "cloud", "model")
_WIDE = ("curves", "stages")


@dataclass(frozen=True, slots=True)
class Card:
    """One picture or video of the page."""

    name: str  # of its file, without suffix
    title: str
    words: str
    picture: bytes
    kind: str = PNG  # or WEBM
    tall: float | None = None  # height of a video over its width: its player stands below it then


_PLAYER_PX = 72  # px; height of a browser's player. Source: measured in Chromium, rounded up

_STYLE = f"""
:root {{ color-scheme: dark }}
* {{ box-sizing: border-box }}
body {{ margin: 0; background: {BACKGROUND}; color: {INK};
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif }}
main {{ max-width: 1240px; margin: 0 auto; padding: 28px 20px 48px }}
h1 {{ font-size: 1.7rem; line-height: 1.2; margin: 0 0 4px }}
h2 {{ font-size: 1.15rem; margin: 36px 0 12px }}
h3 {{ font-size: 1rem; margin: 0 0 4px }}
p {{ margin: 0 0 10px; max-width: 75ch }}
.quiet, figcaption p {{ color: {MUTED}; font-size: .9rem }}
.tiles {{ display: grid; gap: 12px; grid-template-columns: repeat(auto-fit, minmax(140px, 1fr));
  margin: 20px 0 0 }}
.tile {{ background: {PANEL}; border: 1px solid {GRID}; border-radius: 8px; padding: 12px 14px }}
.tile b {{ display: block; font-size: 1.5rem; line-height: 1.25;
  font-variant-numeric: tabular-nums }}
.tile span {{ color: {MUTED}; font-size: .85rem }}
.bad b {{ color: {PROBLEM} }}
.table {{ overflow-x: auto }}
table {{ border-collapse: collapse; font-variant-numeric: tabular-nums; min-width: min(100%, 560px) }}
th, td {{ padding: 6px 14px 6px 0; text-align: right; border-bottom: 1px solid {GRID} }}
th {{ color: {MUTED}; font-weight: 500; font-size: .9rem }}
th:first-child, td:first-child, th:last-child, td:last-child {{ text-align: left }}
.strip {{ display: grid; gap: 10px; grid-template-columns: repeat(auto-fill, minmax(280px, 1fr)) }}
.pair {{ display: grid; gap: 14px; grid-template-columns: repeat(auto-fit, minmax(min(100%, 480px), 1fr)) }}
figure {{ margin: 0; background: {BACKGROUND}; border: 1px solid {GRID}; border-radius: 8px;
  overflow: hidden }}
.pair figure, .wide figure {{ margin-bottom: 0 }}
.wide figure {{ margin-bottom: 14px; max-width: 1000px }}
figcaption {{ padding: 12px 16px 2px }}
img, video {{ display: block; width: 100%; height: auto }}
figure:has(video) {{ container-type: inline-size }}
video.apart {{ height: calc(100cqw * var(--tall) + {_PLAYER_PX}px); object-fit: contain;
  object-position: top }}
.key i {{ font-style: normal; font-weight: 600 }}
@media (max-width: 600px) {{ .plot {{ overflow-x: auto }} th, td {{ padding-right: 8px }}
  .pair img {{ width: 520px }} .wide img {{ width: 760px }}
  figure:has(.plot) figcaption p::after {{ content: " The plot goes on to the right: swipe." }} }}
details {{ margin-top: 36px; color: {MUTED}; font-size: .9rem }}
dl {{ display: grid; grid-template-columns: max-content 1fr; gap: 2px 18px; margin: 10px 0 }}
dd {{ margin: 0; color: {INK}; overflow-wrap: anywhere }}
"""  # noqa: E501


def page(
    target_name: str,
    model: ViewModel,
    sequence: Sequence,
    observations: Ordered[AppearanceObservation],
    evaluation: Evaluation | None,
    cards: Ordered[Card],
) -> str:
    """The HTML text.

    Args:
        target_name: for the title.
        model: of the target.
        sequence: the frames.
        observations: of these frames.
        evaluation: if there is truth.
        cards: pictures; those named ``frame_…`` are the row of frames. Videos come first, and
            pictures that a report does not always have come after the frames.
    """
    by_name = {card.name: card for card in cards}
    frames = (card for card in cards if card.name.startswith("frame_"))
    pictures = (_tag(card, f"{card.title} {card.name[6:]}") for card in frames)
    strip = "".join(f"<figure>{picture}</figure>" for picture in pictures)
    pair = "".join(figure(by_name[n]) for n in _PAIR if n in by_name)
    wide = "".join(figure(by_name[n]) for n in _WIDE if n in by_name)
    videos = [card for card in cards if card.kind == WEBM]
    films = "".join(map(figure, videos))
    others = [c for c in cards if c.kind == PNG and c.name not in (*_PAIR, *_WIDE)
              and not c.name.startswith("frame_")]  # fmt: skip
    more = "".join(map(figure, others))
    camera = sequence.frames[0].camera
    body = f"""<h1>{escape(target_name)}</h1>
<p class="quiet">Pose from one camera, {camera.width} × {camera.height} px, in {len(sequence)}
frames of {escape(sequence.source.name)}</p>
<div class="tiles">{_tiles(observations, evaluation)}</div>
{_table(evaluation)}
{_section("Videos", "pair", films)}
<h2>Frames</h2>
<p class="quiet key"><i style="color:{ACTIVE}">Outline</i> and inner edges: of the model at the
pose, or the silhouette found. Axes: the target's X, Y, Z at its view centre; ellipse: its 1 σ. A
<i style="color:{PROBLEM}">red edge</i> marks a frame without a pose or with a wrong pose.</p>
<div class="strip">{strip}</div>
{_section("All sensors", "wide", more)}
<h2>Recognition</h2>
<div class="pair">{pair}</div>
<h2>All frames</h2>
<div class="wide">{wide}</div>
{_facts(model)}
"""
    return document(f"{target_name}: recognition report", body)


def document(title: str, body: str) -> str:
    """A whole page, without scripts or network."""
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
  content="default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'">
<title>{escape(title)}</title>
<style>{_STYLE}</style>
</head>
<body>
<main>
{body}</main>
</body>
</html>
"""


def _section(title: str, style: str, figures: str) -> str:
    return f'<h2>{title}</h2>\n<div class="{style}">{figures}</div>' if figures else ""


def _tiles(observations: Ordered[AppearanceObservation], evaluation: Evaluation | None) -> str:
    found = sum(observation.pose is not None for observation in observations)
    spent = [sum(s.stage_ms.values()) for s in observations if s.stage_ms]
    tiles = [(f"{found} of {len(observations)}", "frames with a pose", found < len(observations))]
    if evaluation is not None:
        wrong, degrees = len(evaluation.wrong), np.rad2deg(evaluation.wrong_rad)
        tiles.append((str(wrong), f"wrong by more than {degrees:g}°", wrong > 0))
        if evaluation.found:
            rotation = np.rad2deg(evaluation.statistics("rotation_rad").median)
            distance = 100.0 * evaluation.statistics("range_fraction").median
            tiles.append((f"{rotation:.2f}°", "median attitude error", False))
            tiles.append((f"{distance:.2f} %", "median range error", False))
    if evaluation is None and spent:  # else the table has the time
        tiles.append((f"{float(np.median(spent)):.1f} ms", "median time per frame", False))
    return tiles_of(tiles)


def tiles_of(tiles: Ordered[tuple[str, str, bool]]) -> str:
    """Numbers with their words; true: bad."""
    return "".join(
        f'<div class="tile{" bad" if bad else ""}"><b>{escape(number)}</b>'
        f"<span>{escape(words)}</span></div>"
        for number, words, bad in tiles
    )


def _table(evaluation: Evaluation | None) -> str:
    if evaluation is None:
        return '<p class="quiet" style="margin-top:20px">The sequence has no truth, so \
there are no errors.</p>'
    table = table_of(("error", "median", "95 %", "max", ""), summary_rows(evaluation))
    notes = "".join(f'<p class="quiet">{escape(note)}</p>' for note in evaluation.notes)
    return f"<h2>Errors of the poses found</h2>{table}{notes}"


def table_of(head: Ordered[str], rows: Iterable[Ordered[str]]) -> str:
    """A table that scrolls on a narrow screen."""
    heads = "".join(f"<th>{escape(name)}</th>" for name in head)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>" for cells in rows
    )
    return f'<div class="table"><table><tr>{heads}</tr>{body}</table></div>'


def _facts(model: ViewModel) -> str:
    held_out = model.held_out
    facts = {
        "model": f"{model.name}, order {model.order}, {len(model.geodesic.nodes)} nodes, "
        f"{model.bins} readings",
        "view centre": f"{np.round(model.centre_m, 3).tolist()} m in the target's frame",
        "target radius": f"{model.target_radius_m:.3f} m",
        "sphere radius": f"{model.sphere_radius_m:.2f} m",
        "stated errors": f"direction {np.rad2deg(held_out.direction_rad):.2f}° each axis, "
        f"roll {np.rad2deg(held_out.roll_rad):.2f}°, range {100 * held_out.range_fraction:.2f} %",
        "mesh": f"{model.provenance.get('triangles', '?')} triangles, "
        f"SHA-256 {str(model.provenance.get('mesh_sha256', '?'))[:16]}",
    }
    terms = "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in facts.items())
    return f"<details><summary>About the model</summary><dl>{terms}</dl></details>"


def figure(card: Card) -> str:
    words = f"<p>{escape(card.words)}</p>" if card.words else ""
    shown = _tag(card, card.title)
    if card.kind == PNG:  # wider than a phone
        shown = f'<div class="plot">{shown}</div>'
    return f"<figure><figcaption><h3>{escape(card.title)}</h3>{words}</figcaption>{shown}</figure>"


def _tag(card: Card, words: str) -> str:
    data = base64.b64encode(card.picture).decode("ascii")
    if card.kind == WEBM:
        apart = "" if card.tall is None else f'class="apart" style="--tall: {card.tall:.4f}" '
        return (
            f'<video {apart}aria-label="{escape(words)}" controls autoplay muted loop playsinline '
            f'src="data:{WEBM};base64,{data}"></video>'
        )
    return f'<img alt="{escape(words)}" src="data:{PNG};base64,{data}">'
