"""Options on a command line, or of a cell of a sweep: read by tyro, with its complaints made one sentence."""

from __future__ import annotations

import argparse
import contextlib
import difflib
import io
import re
from typing import Any, TypeVar

import tyro

from senior.config import Config
from senior.presets import preset, release, with_budget
from senior.types import BadInput

Options = TypeVar("Options")


def parse(
    kind: type[Options], arguments: list[str], default: Options | None, command: str, text: str | None = None
) -> Options:
    """The options in ``arguments``; `BadInput` with one sentence where they make no sense.

    kind: a dataclass of options. default: what is taken where an option is left out. text: what --help begins with.
    """
    complaint = io.StringIO()
    extra: dict[str, Any] = {} if default is None else {"default": default}
    try:
        with contextlib.redirect_stderr(complaint):
            options, unknown = tyro.cli(
                kind,
                prog=f"senior {command}",
                description=text,
                args=arguments,
                return_unknown_args=True,
                config=(tyro.conf.AvoidSubcommands,),
                **extra,
            )
    except SystemExit as end:
        if not end.code:
            raise
        raise BadInput(_one_sentence(complaint.getvalue())) from None
    if unknown:
        raise BadInput(_unknown_option(kind, unknown[0], default, command))
    return options


def _unknown_option(kind: type[Any], option: str, default: Any, command: str) -> str:
    if not option.startswith("-"):
        return f"senior {command} has no use for {option!r}; see senior {command} --help."
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown), contextlib.suppress(SystemExit):
        tyro.cli(kind, args=["--help"], **({} if default is None else {"default": default}))
    options = sorted(set(re.findall(r"--[a-z][a-z0-9.-]*", shown.getvalue())))
    near = difflib.get_close_matches(option.split("=")[0].replace("_", "-"), options, n=1, cutoff=0.4)
    return f"Unknown option {option}; did you mean {near[0]}?" if near else f"Unknown option {option}."


def _one_sentence(box: str) -> str:
    """What tyro complains of, in our words; where they are not known, its own without their frame."""
    lines = [re.sub(r"[│╭╮╰╯─┌┐└┘|]|-{3,}|\x1b\[[0-9;]*m", " ", line) for line in box.splitlines()]
    text = " ".join(" ".join(lines).split())
    if found := re.search(r"invalid choice '(.*)' for argument '(\S+)'\. Expected one of \((.*?)\)", text):
        return str(BadInput.unknown(found[2], found[1], re.findall(r"'([^']*)'", found[3])))
    if found := re.search(r"Missing value for argument '(\S+)'", text):
        return f"{found[1]} needs a value."
    if found := re.search(r"Missing from (senior [\w ]+): (\S+)", text):
        return f"{found[1]} needs a {found[2]}; see {found[1]} --help."
    if found := re.search(r"Error parsing (\S+):.*(literal for int|to float).*?: ('.*?')", text):
        kind = "a whole number" if found[2] == "literal for int" else "a number"
        return f"{found[1]} needs {kind}, not {found[3]}."
    return text.split("Argument helptext")[0].split("For full helptext")[0].strip()


def starting_from(arguments: list[str]) -> Config:
    """The configuration that options change: that of the task, method, preset, budget and compat among them."""
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    starts = {"task": "door-lock", "method": "m-senior", "preset": "paper", "env": None, "compat": "none"}
    for name, default in starts.items():
        first.add_argument(f"--{name}", default=default)
    first.add_argument("--budget", type=int)
    try:
        known, _ = first.parse_known_args(arguments)
    except argparse.ArgumentError as error:
        needs = "a whole number" if "invalid int" in str(error) else "a value"
        raise BadInput(f"{error.argument_name} needs {needs}.") from error
    start = preset(known.preset, known.task, known.method)
    if known.budget is not None:
        start = with_budget(start, known.budget)
    return release(start) if known.compat == "release" else start
