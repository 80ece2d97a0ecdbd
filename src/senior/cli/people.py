"""`senior label` and `senior labels`: people as teachers, and what they said."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from senior.cli.shared import DONE, PageOptions
from senior.label.serving import check_installed
from senior.options import parse
from senior.rundir import only_run
from senior.types import BadInput


@dataclass(frozen=True)
class LabelOptions:
    """Serve the labelling page of a run that people teach, without training it."""

    run: tyro.conf.Positional[Path]
    """A run directory, or one above it."""
    page: Annotated[PageOptions, tyro.conf.arg(name="")] = field(default_factory=PageOptions)


@dataclass(frozen=True)
class ExportOptions:
    """Write all that was asked in a run and said of it into files (docs/labels.md)."""

    run: tyro.conf.Positional[Path]
    """A run directory, or one above it."""
    out: Path
    """File to write, NAME.jsonl; the segments go to NAME.npz beside it."""


@dataclass(frozen=True)
class ImportOptions:
    """Put exported labels into a run of people's that has not asked anything yet."""

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """A run directory, or one above it."""
    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """NAME.jsonl, with NAME.npz beside it."""


@dataclass(frozen=True)
class StatsOptions:
    """Tell who said what in a run, and how far people agree."""

    run: tyro.conf.Positional[Path]
    """A run directory, or one above it."""
    json: bool = False
    """Print JSON."""


def label(arguments: list[str]) -> int:
    options = parse(LabelOptions, arguments, None, "label")
    check_installed()
    from senior.label import server

    served = server.serve(only_run(options.run), options.page.address(), "user")
    if served.process != os.getpid():
        print(f"The run is served already: {served.url}")
    return DONE


def labels(arguments: list[str]) -> int:
    actions = {"export": _export, "import": _import, "stats": _stats}
    if not arguments or arguments[0] in ("-h", "--help"):
        print("usage: senior labels export|import|stats RUN ...\n\nsenior labels export --help tells its options.")
        sys.exit(DONE)
    if arguments[0] not in actions:
        raise BadInput.unknown("action of senior labels", arguments[0], actions)
    return actions[arguments[0]](arguments[1:])


def _export(arguments: list[str]) -> int:
    options = parse(ExportOptions, arguments, None, "labels export")
    from senior import labels

    count = labels.export_labels(only_run(options.run), options.out)
    print(f"{count} pairs: {options.out} and {options.out.with_suffix('.npz')}")
    return DONE


def _import(arguments: list[str]) -> int:
    options = parse(ImportOptions, arguments, None, "labels import")
    from senior import labels

    run = only_run(options.run)
    print(f"{labels.import_into(run, options.file)} pairs taken over into {run}")
    return DONE


def _stats(arguments: list[str]) -> int:
    options = parse(StatsOptions, arguments, None, "labels stats")
    check_installed()
    from senior import labels

    found = labels.stats(only_run(options.run))
    print(json.dumps(found, indent=2) if options.json else labels.describe(found))
    return DONE
