"""The building blocks of the report: HTML that stands in one file and opens anywhere.

Text is escaped here and nowhere else; what these functions return is HTML.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from html import escape
from pathlib import Path

from PIL import Image

#: Pictures wider than this are reduced: a report is read on a screen.
WIDEST_PX = 1600
JPEG_QUALITY = 85

STYLE = """
:root { --ink: #22262b; --faint: #6c757d; --line: #dfe3e8; --good: #1b7f5c; --bad: #b02a1f }
* { box-sizing: border-box }
body { font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; color: var(--ink); background: #fff;
       margin: 0 auto; padding: 1.5rem; max-width: 72rem }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 0 0 .2rem } h2 { font-size: 1.25rem; margin: 2.4rem 0 .6rem;
     border-top: 1px solid var(--line); padding-top: 1.2rem } h3 { font-size: 1rem; margin: 1.4rem 0 .4rem }
p { margin: .4rem 0; max-width: 46rem } .faint { color: var(--faint) } .note { color: var(--bad) }
.verdict { display: flex; flex-wrap: wrap; gap: .8rem; margin: 1.2rem 0 }
.verdict div { border: 1px solid var(--line); border-radius: .5rem; padding: .6rem .9rem; min-width: 9rem }
.verdict b { display: block; font-size: 1.35rem } .up { color: var(--good) } .down { color: var(--bad) }
nav { font-size: .9rem; display: flex; flex-wrap: wrap; gap: .2rem 1rem } nav a { color: inherit }
figure { margin: .8rem 0 } img { max-width: 100%; height: auto; display: block }
figcaption { color: var(--faint); font-size: .9rem; margin-top: .3rem }
.scroll { overflow-x: auto } table { border-collapse: collapse; font-size: .92rem; margin: .4rem 0 }
th, td { padding: .25rem .8rem .25rem 0; text-align: right; border-bottom: 1px solid var(--line); white-space: nowrap }
th:first-child, td:first-child { text-align: left } th { font-weight: 600; vertical-align: bottom }
pre { font-size: .85rem; overflow-x: auto; background: #f6f7f9; padding: .8rem; border-radius: .4rem }
summary { cursor: pointer } @media print { h2 { break-after: avoid } figure, table { break-inside: avoid } }
"""


def document(title: str, body: Sequence[str]) -> str:
    """A whole page."""
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n" + "\n".join(body)
        + "\n</body>\n</html>\n"
    )  # fmt: skip


def section(anchor: str, title: str, parts: Sequence[str]) -> str:
    return f'<section id="{escape(anchor)}">\n<h2>{escape(title)}</h2>\n' + "\n".join(parts) + "\n</section>"


def heading(text: str) -> str:
    return f"<h3>{escape(text)}</h3>"


def paragraph(text: str, kind: str = "") -> str:
    return f'<p class="{escape(kind)}">{escape(text)}</p>' if kind else f"<p>{escape(text)}</p>"


def missing(what: str) -> str:
    """What is said where a file is not there yet."""
    return paragraph(f"{what}: not there yet.", "faint")


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Cells are text; the first column is aligned to the left."""
    titles = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    lines = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>\n" for row in rows)
    return f'<div class="scroll"><table>\n<thead><tr>{titles}</tr></thead>\n<tbody>\n{lines}</tbody>\n</table></div>'


def details(title: str, text: str) -> str:
    return f"<details><summary>{escape(title)}</summary><pre>{escape(text)}</pre></details>"


def verdict(items: Sequence[tuple[str, str, str]]) -> str:
    """Boxes of (what, figure, class)."""
    boxes = "".join(
        f'<div><span class="faint">{escape(what)}</span><b class="{escape(kind)}">{escape(figure)}</b></div>'
        for what, figure, kind in items
    )
    return f'<div class="verdict">{boxes}</div>'


def picture(path: Path, caption: str, widest: int = WIDEST_PX, photograph: bool = False) -> str:
    """An image file inside the page; a sentence where it is missing or damaged.

    Figures stay lossless where that is small; `photograph` always makes a JPEG.
    """
    if not path.is_file():
        return missing(caption)
    try:
        with Image.open(path) as opened:
            image = opened.convert("RGB")
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        return paragraph(f"{caption}: {path.name} cannot be read ({error}).", "note")
    return figure(image, caption, widest, photograph)


def figure(image: Image.Image, caption: str, widest: int = WIDEST_PX, photograph: bool = False) -> str:
    """A picture inside the page."""
    if image.width > widest:
        image = image.resize((widest, max(1, round(image.height * widest / image.width))), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    if photograph:
        image.save(buffer, "JPEG", quality=JPEG_QUALITY)
    else:  # charts have few colours
        image.quantize(256, dither=Image.Dither.NONE).save(buffer, "PNG", optimize=True)
    kind = "jpeg" if photograph else "png"
    data = base64.b64encode(buffer.getvalue()).decode()
    return (
        f'<figure><img src="data:image/{kind};base64,{data}" width="{image.width}" height="{image.height}" '
        f'alt="{escape(caption)}"><figcaption>{escape(caption)}</figcaption></figure>'
    )
