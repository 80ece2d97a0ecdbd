"""Cells as text, and tables as CSV and LaTeX. Imports no JAX."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence

Cell = str | int | float | None
"""What a table holds; NumPy's numbers count as ours."""

NOTHING = "–"  # noqa: RUF001
SPECIAL = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': r"\textquotedbl{}",
    "±": r"$\pm$",
    "–": "--",  # noqa: RUF001
    "×": r"$\times$",  # noqa: RUF001
    "·": r"$\cdot$",
    "…": r"\ldots{}",
    "\n": " ",
    "\r": " ",
}


def shown(cell: Cell) -> str:
    """A cell as people read it: numbers to three digits, whole ones with separators, a dash for what is not there."""
    if cell is None or cell == "":
        return NOTHING
    if isinstance(cell, str):
        return cell
    if not math.isfinite(cell):
        return NOTHING if math.isnan(cell) else str(cell)
    if float(cell).is_integer() and not isinstance(cell, float):
        return f"{cell:,}"
    return f"{cell:,.0f}" if abs(cell) >= 1000 else f"{cell:.3g}"


def plain(cell: Cell) -> str:
    """A cell as programs read it: numbers to nine digits, nothing for what is not there."""
    if cell is None or isinstance(cell, str):
        return cell or ""
    if isinstance(cell, int):
        return str(cell)
    return "" if math.isnan(cell) else format(float(cell), ".9g")


def to_csv(rows: Sequence[Sequence[Cell]]) -> str:
    """Rows, the first of them the head, as CSV."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([plain(cell) for cell in row] for row in rows)
    return text.getvalue()


def latex(caption: str, head: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    """A table for a paper, with the rules of the package ``booktabs``; columns of numbers stand to the right."""
    columns = "".join("r" if number else "l" for number in numbers(head, rows))
    lines = [
        r"\begin{table}",
        r"\centering",
        rf"\caption{{{escape(caption)}}}",
        rf"\begin{{tabular}}{{{columns}}}",
        r"\toprule",
        _line(head),
        r"\midrule",
        *(_line([shown(cell) for cell in row]) for row in rows),
        r"\bottomrule",
        r"\end{tabular}",
        r"\end{table}",
    ]
    return "\n".join(lines) + "\n"


def escape(text: str) -> str:
    """Text that LaTeX prints as it stands."""
    return "".join(SPECIAL.get(letter, letter) for letter in text)


def _line(cells: Sequence[str]) -> str:
    return " & ".join(escape(cell) for cell in cells) + r" \\"


def numbers(head: Sequence[str], rows: Sequence[Sequence[Cell]]) -> list[bool]:
    """Which columns hold nothing but numbers."""
    return [all(not isinstance(row[place], str) for row in rows) for place in range(len(head))]
