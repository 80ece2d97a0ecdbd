"""The page that a report is: sections of words, figures and tables, as one HTML file with nothing outside of it.

Beside ``index.html`` lie ``figures/NAME.png``, ``.svg`` and ``.csv``, and ``tables/NAME.csv`` and ``.tex``. Equal
sections give equal files, byte for byte. Nothing in the page has a style attribute, so that it can be served under a
strict policy. Imports no JAX.
"""

from __future__ import annotations

import base64
import gc
import io
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

from matplotlib.figure import Figure

from senior.files import slug, write_atomically
from senior.report.tables import Cell, latex, numbers, shown, to_csv
from senior.types import BadInput

GENERATOR = "senior report"
"""What is told in the head of every page to have made it."""
LINK = re.compile(r'href="((?:figures|tables)/[^"/]+)"')
"""Files beside a page."""
UNENCODED = "backslashreplace"
"""How names of directories are written that are not text."""
LARGEST_SVG = 400_000
"""Bytes of a drawing above which the page shows its PNG instead."""
DOTS = 150
"""Per inch of the PNG files."""
REPRODUCIBLE: dict[Any, Any] = {"svg.hashsalt": "senior", "svg.fonttype": "path"}
ADAPTED = "<style>svg{color:#1c1e21;fill:currentColor}@media (prefers-color-scheme:dark){svg{color:#dfe3e8}}</style>"
"""Within a drawing: what matplotlib draws in black takes the page's colour."""


@dataclass(frozen=True)
class Table:
    """Columns with a head. Cells may hold anything; None and NaN are shown as a dash."""

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    name: str = ""
    """Of its files; left out: made from the section's title."""
    folded: bool = False
    """Shown when it is asked for."""


@dataclass(frozen=True)
class Drawing:
    """A figure and the numbers that it shows."""

    name: str
    """Of its files."""
    caption: str
    figure: Figure
    """What is black in it takes the page's colour, and the page's background is seen through it."""
    rows: Sequence[Sequence[Cell]]
    """The numbers, the first row being the head."""


@dataclass(frozen=True)
class Section:
    """A part of the page: paragraphs, then figures, then tables."""

    title: str
    text: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    figures: tuple[Drawing, ...] = ()


def write(sections: Iterable[Section], out: Path, title: str) -> Path:
    """Write the page and the files beside it into ``out``, and return the page.

    Figures are emptied when they are written, and each section is let go of before the next is asked for: where
    sections are made one by one, memory for the largest of them is enough. Names are made safe for files and, where two
    are the same, told apart by a number.

    Files that an earlier page there links and this one does not are removed. Raises `BadInput` if ``out`` cannot be
    written, or holds a page of something else.
    """
    template, page = _template(), out / "index.html"
    try:
        before = page.read_text(errors="replace") if page.exists() else None
        if before is not None and f'content="{GENERATOR}"' not in before[:1000]:
            raise BadInput(f"{page} is no page of a report, and would be overwritten; choose another directory.")
        for folder in ("figures", "tables"):
            (out / folder).mkdir(parents=True, exist_ok=True)
        names, parts = _Names(), []
        for section in sections:
            parts.append(_written(section, out, names))
            del section
            gc.collect()  # figures hold on to themselves
        written = template.render(title=title, generator=GENERATOR, sections=parts)
        write_atomically(page, written.encode(errors=UNENCODED))
        for link in set(LINK.findall(before or "")) - set(LINK.findall(written)):
            (out / link).unlink(missing_ok=True)
    except OSError as error:
        raise BadInput(f"The report cannot be written into {out}: {error.strerror or error}.") from error
    return page


class _Names:
    """Names that are taken, by kind."""

    def __init__(self) -> None:
        self._taken: set[tuple[str, str]] = set()

    def free(self, kind: str, text: str) -> str:
        name = first = slug(text)[:80]
        number = 1
        while (kind, name) in self._taken:
            number += 1
            name = f"{first}-{number}"
        self._taken.add((kind, name))
        return name


def _written(section: Section, out: Path, names: _Names) -> dict[str, Any]:
    return {
        "anchor": names.free("section", section.title),
        "title": section.title,
        "text": section.text,
        "figures": [_write_drawing(drawing, out, names) for drawing in section.figures],
        "tables": [_write_table(table, section.title, out, names) for table in section.tables],
    }


def _write_drawing(drawing: Drawing, out: Path, names: _Names) -> dict[str, Any]:
    name = names.free("figure", drawing.name)
    place = out / "figures" / name
    with matplotlib.rc_context(REPRODUCIBLE):
        svg, png = io.BytesIO(), io.BytesIO()
        drawing.figure.savefig(svg, format="svg", transparent=True, metadata={"Date": None})
        drawing.figure.set_layout_engine("none")  # everything has its place; to find it takes longer than to draw
        drawing.figure.savefig(png, format="png", dpi=DOTS, facecolor="white")
    width, height = (round(float(side) * 96) for side in drawing.figure.get_size_inches())  # an inch of a page
    drawing.figure.clear()
    _beside(place, ".svg").write_bytes(svg.getvalue())
    _beside(place, ".png").write_bytes(png.getvalue())
    _beside(place, ".csv").write_text(to_csv(drawing.rows), errors=UNENCODED)
    vector = len(svg.getvalue()) <= LARGEST_SVG
    kind, data = ("svg+xml", _adapted(svg.getvalue())) if vector else ("png", png.getvalue())
    source = f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
    return {
        "name": name,
        "caption": drawing.caption,
        "source": source,
        "width": width,
        "height": height,
        "vector": vector,
    }


def _adapted(svg: bytes) -> bytes:
    """A drawing that takes the page's colour for what is black in it, by day and by night."""
    text = svg.decode()
    text = re.sub(r"(<svg\b[^>]*>)", lambda found: found[1] + ADAPTED, text, count=1)
    return re.sub(r"stroke: ?#000000", "stroke: currentColor", text).encode()


def _write_table(table: Table, section: str, out: Path, names: _Names) -> dict[str, Any]:
    name = names.free("table", table.name or section)
    place = out / "tables" / name
    _beside(place, ".csv").write_text(to_csv([table.head, *table.rows]), errors=UNENCODED)
    _beside(place, ".tex").write_text(latex(table.caption, table.head, table.rows), errors=UNENCODED)
    return {
        "name": name,
        "caption": table.caption,
        "head": table.head,
        "numbers": numbers(table.head, table.rows),
        "rows": [[shown(cell) for cell in row] for row in table.rows],
        "folded": table.folded,
    }


def _beside(place: Path, suffix: str) -> Path:
    return place.with_name(place.name + suffix)


def _template() -> Any:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    loader = FileSystemLoader(Path(__file__).parent)
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template("page.html")
