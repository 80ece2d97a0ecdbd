"""From run directories to a page: ``senior report RUNS... --out DIR``. Reads files only and never imports JAX."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import NamedTuple

from senior.extras import require
from senior.report import comparison, pairs, sections, visitation
from senior.report.cells import Tasks
from senior.report.looks import Look, looks
from senior.report.page import Section, write
from senior.report.protocol import left_out, protocol
from senior.report.records import LeftOut
from senior.report.results import Results, read
from senior.types import BadInput


class Built(NamedTuple):
    """What became of a report."""

    page: Path
    runs: int
    """That are in it."""
    left_out: list[LeftOut]
    """Runs, and files of runs, that are not, with the reason."""


def check_installed() -> None:
    """`BadInput` if what a report needs is not there."""
    require("A report", "report", "jinja2", "rliable")


def report(
    places: Sequence[Path],
    out: Path,
    first: Sequence[Section] = (),
    unfinished: bool = False,
    until: int | None = None,
) -> Built:
    """Read all runs at or below ``places`` and write the page, its figures and tables into ``out``.

    first: sections that stand before all others. unfinished: show runs under way too, in curves as far as they have
    come; tables of success are of finished runs alone. until: look at all runs as if they had ended at that step.

    Raises `BadInput` if there is no run with an evaluation, if ``out`` cannot be written, or if what draws the page is
    not installed.
    """
    return page_of(found(places, unfinished, until), out, first)


def found(places: Sequence[Path], unfinished: bool = False, until: int | None = None) -> Results:
    """What a report on ``places`` is made of. `BadInput` as from `report`."""
    check_installed()
    results = read(places, unfinished, until)
    if not results.runs:
        raise BadInput(_nothing(places, results))
    return results


def page_of(results: Results, out: Path, first: Sequence[Section] = ()) -> Built:
    """The page of runs that are read already. `BadInput` if ``out`` cannot be written."""
    tasks = sections.by_task(results.runs)
    colours = looks(label for arms in tasks.values() for label in arms)
    title = f"{counted(len(results.runs), 'run')} of {counted(len(colours), 'arm')}"
    title += f" on {next(iter(tasks)) if len(tasks) == 1 else counted(len(tasks), 'task')}"
    page = write((part for part in chain(first, _parts(results, tasks, colours)) if part is not None), out, title)
    return Built(page, len(results.runs), list(results.left_out))


def _parts(results: Results, tasks: Tasks, colours: Mapping[str, Look]) -> Iterator[Section | None]:
    """One by one, when they are asked for."""
    yield sections.summary(tasks, results.shared, results.until)
    yield sections.curves(tasks, colours)
    yield sections.labels(tasks, colours)
    yield comparison.comparison(tasks, colours)
    yield sections.reward_model(tasks, colours)
    yield visitation.section(results.runs)
    yield pairs.section(results.runs)
    yield sections.cost(tasks)
    yield protocol(tasks)
    yield left_out(results.left_out)


def counted(number: int, word: str) -> str:
    """So many of them, in words."""
    return f"{number} {word}" if number == 1 else f"{number} {word}s"


def _nothing(places: Sequence[Path], results: Results) -> str:
    named = ", ".join(map(str, places))
    if not results.left_out:
        return f"There is no run in {named}."
    path, reason = results.left_out[0]
    more = f", and {len(results.left_out) - 1} more" if len(results.left_out) > 1 else ""
    return f"There is no run that can be reported in {named}. Left out: {path} ({reason}){more}."
