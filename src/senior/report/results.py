"""All runs below some places: found, read, and sorted into arms that may be averaged.

Reading never fails over a run: one that is unfinished, broken or there twice is left out and named. Imports no JAX.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from senior.config import Config
from senior.report.names import words
from senior.report.records import NOT_TOLD, Arm, Fingerprint, LeftOut, Run, Unusable, read_run, up_to
from senior.rundir import is_run

MOST_NAMED = 2
"""Differences that an arm's label tells; where there are more they get a number."""


class Results(NamedTuple):
    """What was found below some places."""

    runs: tuple[Run, ...]
    """By task, label and seed."""
    left_out: tuple[LeftOut, ...]
    shared: tuple[str, ...] = ()
    """Options that all arms have and their labels do not tell."""
    until: int | None = None
    """The step at which runs are looked at as if they had ended; None: each at its own end."""

    def arms(self) -> dict[Arm, list[Run]]:
        """Runs by arm, both in order."""
        found: dict[Arm, list[Run]] = defaultdict(list)
        for run in self.runs:
            found[run.arm].append(run)
        return dict(found)


def read(places: Sequence[Path], unfinished: bool = False, until: int | None = None) -> Results:
    """All run directories at or below ``places``.

    unfinished: take in runs under way that were evaluated once. until: look at all runs as if they had ended at that
    step; those that were not evaluated there are left out.
    """
    left_out: list[LeftOut] = []
    runs: list[Run] = []
    known: dict[str, Config | None] = {}
    for path in _found(places, left_out):
        missed: list[LeftOut] = []
        try:
            run = read_run(path, known, missed)
            run = run if until is None else up_to(run, until, missed)
            if not (run.finished or unfinished):
                raise Unusable(f"unfinished: it stands at step {run.step:,} of {run.steps:,}")
            runs.append(run)
            left_out += missed
        except Unusable as reason:
            left_out.append(LeftOut(path, str(reason)))
    runs = _of_one_measure(runs, left_out)
    runs, shared = _unshared(_once(runs, left_out))
    return Results(tuple(sorted(_told_apart(runs), key=_order)), tuple(left_out), shared, until)


def _order(run: Run) -> tuple[Any, ...]:
    return run.arm.task, run.arm.label, run.arm.fingerprint, run.seed


def _found(places: Sequence[Path], left_out: list[LeftOut]) -> Iterator[Path]:
    seen: set[Path] = set()
    for place in places:
        before = len(seen)
        if not place.is_dir():
            left_out.append(LeftOut(place, "there is no such directory"))
            continue
        runs = list(_below(place, seen, left_out))
        if not runs and len(seen) > before:
            left_out.append(LeftOut(place, "there is no run in it"))
        yield from runs


def _below(place: Path, seen: set[Path], left_out: list[LeftOut]) -> Iterator[Path]:
    """Run directories at or below ``place``, in order; none lies within another. Nothing is visited twice."""
    try:
        own = place.resolve()
        if own in seen:
            return
        seen.add(own)
        if is_run(place):
            yield place
            return
        children = sorted(child for child in place.iterdir() if child.is_dir())
    except OSError as error:
        left_out.append(LeftOut(place, f"it cannot be read: {error.strerror or error}"))
        return
    for child in children:
        yield from _below(child, seen, left_out)


def _of_one_measure(runs: list[Run], left_out: list[LeftOut]) -> list[Run]:
    """Where some runs of a task tell success, those that do not are left out."""
    telling = {run.arm.task for run in runs if run.evaluation.success is not None}
    kept = []
    for run in runs:
        if run.arm.task in telling and run.evaluation.success is None:
            left_out.append(LeftOut(run.path, "it tells no success, and other runs of its task do"))
        else:
            kept.append(run)
    return kept


def _once(runs: list[Run], left_out: list[LeftOut]) -> list[Run]:
    """Each seed of an arm once: a finished run before others, else the first."""
    kept: dict[tuple[Arm, int], Run] = {}
    for run in sorted(runs, key=lambda run: not run.finished):
        first = kept.setdefault((run.arm, run.seed), run)
        if first is not run:
            left_out.append(LeftOut(run.path, f"seed {run.seed} of {run.arm} was taken from {first.path} already"))
    return list(kept.values())


def _unshared(runs: Sequence[Run]) -> tuple[list[Run], tuple[str, ...]]:
    """Runs of several methods without the options that all of those that ask have, and these options."""
    asking = [words(run.config) for run in runs if run.asks and run.config is not None]
    if len({run.method for run in runs if run.asks}) < 2 or not asking:
        return list(runs), ()
    shared = tuple(word for word in asking[0] if all(word in own for own in asking))
    return [
        replace(
            run, arm=replace(run.arm, name=" ".join([run.method, *(w for w in words(run.config) if w not in shared)]))
        )
        if run.config is not None
        else run
        for run in runs
    ], shared


def _told_apart(runs: Sequence[Run]) -> list[Run]:
    """With labels that tell arms of one task apart, in the same way in every task.

    Arms of one name and task that differ in one or two things bear these; in more, a number.
    """
    by_name: dict[str, dict[str, set[Fingerprint]]] = defaultdict(lambda: defaultdict(set))
    for run in runs:
        by_name[run.arm.name][run.arm.task].add(run.arm.fingerprint)
    suffixes: dict[tuple[str, Fingerprint], str] = {}
    for name, by_task in by_name.items():
        telling = sorted({entry for prints in by_task.values() for entry in unlike(prints)})
        prints = {one for found in by_task.values() for one in found}
        values = {one: tuple(dict(one).get(entry, NOT_TOLD) for entry in telling) for one in prints}
        numbers = {value: number for number, value in enumerate(sorted(set(values.values())), 1)}
        for one, value in values.items() if telling else ():
            few = ", ".join(f"{entry} {text}" for entry, text in zip(telling, value, strict=True))
            suffixes[name, one] = few if len(telling) <= MOST_NAMED else f"protocol {numbers[value]}"
    return [
        replace(run, arm=replace(run.arm, suffix=suffixes.get((run.arm.name, run.arm.fingerprint), ""))) for run in runs
    ]


def unlike(prints: Iterable[Fingerprint]) -> list[str]:
    """Names of the entries in which fingerprints differ, in order."""
    entries = [dict(one) for one in prints]
    names = dict.fromkeys(name for one in entries for name in one)
    return [name for name in names if len({one.get(name) for one in entries}) > 1]


def grouped(left_out: Sequence[LeftOut]) -> list[str]:
    """A line for every reason, with the first path and how many more there are."""
    reasons: dict[str, list[Path]] = defaultdict(list)
    for path, reason in left_out:
        reasons[reason].append(path)
    return [
        f"{paths[0]}{f' and {len(paths) - 1} more' if len(paths) > 1 else ''}: {reason}"
        for reason, paths in reasons.items()
    ]
