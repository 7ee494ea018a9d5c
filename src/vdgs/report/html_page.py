"""The building blocks of the page. Text goes in as it is and is escaped here, nowhere else."""

from __future__ import annotations

import html
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NewType

from vdgs.report.embedded_images import EmbeddedImage

#: Markup, as against text.
Html = NewType("Html", str)

#: The browser may load nothing: all is in the file.
SECURITY_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
PAGE_STYLE = """
:root {
  color-scheme: light dark;
  --page: #fff; --ink: #22262b; --muted: #59626b; --line: #d5d9dd; --faint: #eceff1; --link: #1f5f8b; --code: #f5f7f8;
  --note: #fff8e6;
}
@media (prefers-color-scheme: dark) {
  :root {
    --page: #16191c; --ink: #e4e7ea; --muted: #a3adb6; --line: #3b434a; --faint: #2a3036; --link: #7db8e8;
    --code: #20252a; --note: #33290f;
  }
  figure img { background: #fff; border-radius: 4px; }
}
* { box-sizing: border-box; }
body { margin: 0; background: var(--page); color: var(--ink); }
body { font: 16px/1.5 system-ui, -apple-system, "Segoe UI", sans-serif; }
main { max-width: 68rem; margin: 0 auto; padding: 1.5rem 1rem 4rem; overflow-wrap: anywhere; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 0.5rem 0; }
h2 { font-size: 1.25rem; margin: 2.5rem 0 0.5rem; padding-top: 0.75rem; border-top: 1px solid var(--line); }
h3 { font-size: 1rem; margin: 1.5rem 0 0.25rem; }
p { margin: 0.5rem 0; max-width: 46rem; }
.facts, figcaption { color: var(--muted); font-size: 0.875rem; }
.verdict { font-size: 1.15rem; font-weight: 600; margin: 1rem 0; }
.note { border-left: 4px solid #d08700; padding: 0.3rem 0.8rem; background: var(--note); }
.absent { color: var(--muted); font-style: italic; }
nav { font-size: 0.875rem; margin: 1rem 0; }
nav a { margin-right: 1rem; white-space: nowrap; }
a { color: var(--link); }
.scroll { overflow-x: auto; margin: 0.75rem 0; }
table { border-collapse: collapse; font-size: 0.9rem; font-variant-numeric: tabular-nums; overflow-wrap: normal; }
th, td { padding: 0.25rem 0.9rem 0.25rem 0; text-align: right; vertical-align: top; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
table.wordy td:last-child, table.wordy th:last-child { text-align: left; white-space: normal; min-width: 12rem; }
thead th { border-bottom: 1px solid #8a939b; font-weight: 600; }
tbody tr + tr td { border-top: 1px solid var(--faint); }
figure { margin: 1rem 0; break-inside: avoid; }
figcaption { margin-top: 0.25rem; }
img { display: block; max-width: 100%; height: auto; }
.tall img { width: 34rem; }
.gallery { display: flex; flex-wrap: wrap; gap: 0.5rem 1.25rem; }
.gallery figure { flex: 1 1 17rem; max-width: 30rem; margin: 0.5rem 0; }
.beside { display: flex; flex-wrap: wrap; gap: 0.5rem 1.75rem; align-items: flex-start; margin: 0.75rem 0; }
.beside > * { flex: 1 1 22rem; min-width: 0; margin: 0; }
.sheet { position: relative; margin: 0 auto; line-height: 1.2; }
.sheet img { width: 100%; }
.bar, .north { position: absolute; background: #ffffffd9; color: #16191c; font-size: 0.8rem; font-weight: 600; }
.bar { left: 3%; bottom: 3%; padding-top: 2px; text-align: center; white-space: nowrap; border: solid #16191c; }
.bar { border-width: 0 2px 3px; overflow-wrap: normal; }
.north { right: 3%; top: 3%; padding: 2px 7px; text-align: center; }
.north::before { content: "\\2191"; display: block; font-size: 1.3rem; line-height: 1; }
.north::before { transform: rotate(var(--north, 0deg)); }
table.known { width: 100%; font-size: 0.9rem; }
table.known th { font-weight: 600; width: 9.5rem; white-space: normal; padding-right: 1rem; }
table.known td { text-align: left; white-space: normal; }
table.known th, table.known td { border-top: 1px solid var(--faint); }
details { margin: 0.75rem 0; }
summary { cursor: pointer; color: var(--link); }
pre { overflow-x: auto; background: var(--code); padding: 0.75rem; font-size: 0.8rem; line-height: 1.4; }
@media (max-width: 44rem) {
  .wide img { max-width: none; width: 44rem; }
  td:first-child { white-space: normal; min-width: 7rem; }
}
@media print {
  body { font-size: 10pt; }
  main { max-width: none; padding: 0; }
  nav { display: none; }
  h2, h3 { break-after: avoid; }
  tr { break-inside: avoid; }
  .scroll { overflow: visible; }
  table { font-size: 8pt; }
  th, td { padding-right: 0.5rem; }
  thead th { white-space: normal; vertical-align: bottom; }
  img { max-height: 17cm; }
  .wide img, .tall img { max-width: 100%; width: auto; }
  .gallery figure { flex-basis: 45%; max-width: 48%; }
  pre { white-space: pre-wrap; }
}
"""
#: How high a map is on a wide screen: with what stands beside it, it fills the first screen of a laptop.
_MAP_HEIGHT_REM = 30
#: Control characters but tab and line feed, and halves of surrogate pairs: no page may hold them.
_FORBIDDEN = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")


def escape_html(text: str) -> Html:
    """Text as markup: `<` and its like stand for themselves, characters that a page may not hold become �."""
    return Html(html.escape(_FORBIDDEN.sub("\N{REPLACEMENT CHARACTER}", text)))


def join_html(parts: Iterable[Html]) -> Html:
    return Html("\n".join(part for part in parts if part))


def paragraph(text: str, css_class: str = "") -> Html:
    """`css_class` is "", facts, verdict, note or absent. Nothing if there is no text."""
    return Html(f"<p{_class_attribute(css_class)}>{escape_html(text)}</p>") if text else Html("")


def link(address: str, text: str, more: str = "") -> Html:
    """A paragraph that leads to a file, and what follows the link."""
    return Html(f'<p><a href="{escape_html(address)}">{escape_html(text)}</a>{escape_html(more)}</p>')


def heading(text: str) -> Html:
    return Html(f"<h3>{escape_html(text)}</h3>")


def table(
    head: Sequence[str], rows: Sequence[Sequence[str]], caption: str = "", wrap_last_column: bool = False
) -> Html:
    """Cells are right-aligned but in the first column and, with `wrap_last_column`, the last. Nothing without rows."""
    if not rows:
        return Html("")
    cells = "".join(f'<th scope="col">{escape_html(cell)}</th>' for cell in head)
    lines = "\n".join("<tr>" + "".join(f"<td>{escape_html(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    # The caption stands outside, so that it does not scroll with a wide table.
    attribute = _class_attribute("wordy" if wrap_last_column else "")
    return Html(
        f'{paragraph(caption, "facts")}\n<div class="scroll"><table{attribute}>\n<thead><tr>{cells}</tr></thead>\n'
        f"<tbody>\n{lines}\n</tbody></table></div>"
    )


def figure(image: EmbeddedImage | None, caption: str, alt: str, wide: bool = False, tall: bool = False) -> Html:
    """A `wide` image scrolls on a phone; a `tall` one does not fill a desktop screen. Nothing without an image."""
    if image is None:
        return Html("")
    text = f"<figcaption>{escape_html(caption)}</figcaption>" if caption else ""
    attribute = _class_attribute("wide" if wide else "tall" if tall else "")
    return Html(f'<figure{attribute}><div class="scroll">{_image_tag(image, alt)}</div>{text}</figure>')


@dataclass(frozen=True)
class Overlay:
    """A scale bar over a map."""

    text: str
    width_percent: float
    """Of the width of the map."""


def map_figure(image: EmbeddedImage, caption: str, alt: str, bar: Overlay | None, north_deg: float | None) -> Html:
    """A map with a scale bar and an arrow to the north, so many degrees clockwise from its upper side, both as text:
    they stay legible at any width."""
    parts = [_image_tag(image, alt)]
    if bar is not None:
        parts.append(f'<div class="bar" style="width:{bar.width_percent:.3f}%">{escape_html(bar.text)}</div>')
    if north_deg is not None:
        turn = f' style="--north:{north_deg:.1f}deg"' if abs(north_deg) >= 0.1 else ""
        parts.append(f'<div class="north"{turn}>N</div>')
    shown, width = "".join(parts), f"min(100%, {_MAP_HEIGHT_REM * image.width / image.height:.2f}rem)"
    note = f"<figcaption>{escape_html(caption)}</figcaption>"
    return Html(f'<figure><div class="sheet" style="width:{width}">{shown}</div>{note}</figure>')


def facts_table(rows: Sequence[tuple[str, str]]) -> Html:
    """Pairs of what and how much, without a head; texts wrap. Nothing without rows."""
    if not rows:
        return Html("")
    lines = "".join(f'<tr><th scope="row">{escape_html(a)}</th><td>{escape_html(b)}</td></tr>\n' for a, b in rows)
    return Html(f'<table class="known"><tbody>\n{lines}</tbody></table>')


def side_by_side(*parts: Html) -> Html:
    """Beside each other where the screen is wide enough."""
    shown = "".join(f"<div>{part}</div>" for part in parts if part)
    return Html(f'<div class="beside">{shown}</div>') if shown else Html("")


def gallery(figures: Iterable[Html]) -> Html:
    """Small figures side by side, as many as fit."""
    shown = join_html(figures)
    return Html(f'<div class="gallery">\n{shown}\n</div>') if shown else shown


def details(summary: str, content: Html) -> Html:
    """What is shown on demand."""
    return Html(f"<details><summary>{escape_html(summary)}</summary>\n{content}\n</details>") if content else content


def preformatted(text: str) -> Html:
    return Html(f"<pre>{escape_html(text)}</pre>")


def section(name: str, title: str, parts: Iterable[Html], notes: Iterable[str] = ()) -> Html:
    """A section that links reach as `#name`; `notes` say what of the run could not be read."""
    body = join_html([*(paragraph(note, "note") for note in notes), *parts])
    return Html(f'<section id="{escape_html(name)}">\n<h2>{escape_html(title)}</h2>\n{body}\n</section>')


def table_of_contents(entries: Iterable[tuple[str, str]]) -> Html:
    """Links to sections, given as name and title."""
    links = " ".join(f'<a href="#{escape_html(name)}">{escape_html(title)}</a>' for name, title in entries)
    return Html(f"<nav>{links}</nav>")


def document(title: str, parts: Iterable[Html], metadata: Mapping[str, str] | None = None) -> str:
    """A whole page; `metadata` is written into its head, for programs."""
    meta = "".join(f'<meta name="{escape_html(k)}" content="{escape_html(v)}">\n' for k, v in (metadata or {}).items())
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{escape_html(SECURITY_POLICY)}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"{meta}<title>{escape_html(title)}</title>\n<style>{PAGE_STYLE}</style>\n</head>\n<body>\n<main>\n"
        f"{join_html(parts)}\n</main>\n</body>\n</html>\n"
    )


def _image_tag(image: EmbeddedImage, alt: str) -> str:
    size = f'width="{image.width}" height="{image.height}"'
    return f'<img src="{image.data_uri()}" {size} alt="{escape_html(alt)}">'


def _class_attribute(name: str) -> str:
    return f' class="{name}"' if name else ""
