"""The command line: parse, call, print. Bad input ends with one sentence and code 2."""

from __future__ import annotations

import sqlite3
import sys
from collections.abc import Callable, Sequence

from senior.cli import experiments, judge, lists, people, train
from senior.cli.shared import DONE, FAILED, INTERRUPTED
from senior.types import BAD_INPUT, BadInput

COMMANDS: dict[str, tuple[Callable[[list[str]], int], str]] = {
    "train": (train.train, "train one run, or several seeds in one program"),
    "resume": (train.resume, "continue an interrupted run, or all runs under a directory"),
    "eval": (judge.evaluate, "judge a run's policy on fresh episodes, and film it"),
    "sweep": (experiments.sweep, "train every combination of options, on this machine or a Ray cluster"),
    "reproduce": (experiments.reproduce, "train a paper's studies, and set its numbers beside ours"),
    "report": (experiments.report, "put finished runs on one page, with curves and intervals"),
    "watch": (experiments.watch, "serve that page, live, while runs are trained"),
    "label": (people.label, "serve the page on which people compare a run's clips"),
    "labels": (people.labels, "export, import, or look at what people said"),
    "tasks": (lists.tasks, "list the tasks"),
    "methods": (lists.methods, "list the methods, cell by cell"),
    "bench": (judge.bench, "measure steps per second and where the time goes"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns its exit code."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        if not arguments or arguments[0] in ("-h", "--help"):
            print(_overview())
            return DONE
        if arguments[0] == "--version":
            from importlib.metadata import version

            print(f"senior {version('senior-rl')}")
            return DONE
        if arguments[0] not in COMMANDS:
            raise BadInput.unknown("command", arguments[0], COMMANDS)
        run, _ = COMMANDS[arguments[0]]
        return run(arguments[1:])
    except BadInput as error:
        print(f"senior: {error}", file=sys.stderr)
        return BAD_INPUT
    except BrokenPipeError:
        return FAILED
    except (OSError, sqlite3.Error) as error:  # a full disk, say
        print(f"senior: {' '.join(str(error).split())}. What was saved is kept.", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        return INTERRUPTED


def _overview() -> str:
    lines = ["usage: senior COMMAND [OPTIONS]", "", "Teach robots by preference.", ""]
    lines += [f"  {name:9} {summary}" for name, (_, summary) in COMMANDS.items()]
    return "\n".join([*lines, "", "senior COMMAND --help tells a command's options."])
