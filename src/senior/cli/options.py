"""Options of a command, read by tyro, with its complaints made one sentence; and what several commands share."""

from __future__ import annotations

import contextlib
import difflib
import io
import re
from dataclasses import asdict, dataclass
from typing import Any, Literal, TypeVar

import tyro

from senior.label.serving import Address
from senior.types import BadInput

Options = TypeVar("Options")

DONE, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
"""Exit codes."""


@dataclass(frozen=True)
class Machine:
    """How the runs of a command share this machine."""

    workers: int | Literal["auto"] = "auto"
    """Processes that the environments live in; 0: this one. auto: 0 on a CPU, one per processor on a GPU."""
    runs_per_device: int | Literal["auto"] = "auto"
    """How many runs are trained at a time, the others after them. auto: as many as the memory holds."""

    def arguments(self) -> dict[str, Any]:
        """As `senior.program` takes them."""
        return {name: None if value == "auto" else value for name, value in asdict(self).items()}


@dataclass(frozen=True)
class PageOptions:
    """Where the labelling page is served (--teacher human)."""

    host: str = "127.0.0.1"
    """Address to listen on. 0.0.0.0 lets other machines in; who opens the page needs the token in its address."""
    port: int | Literal["auto"] = "auto"
    """auto: where the run was served before, else the first free one from 8642 on."""
    allowed_host: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """A further name that browsers may know this machine by; may be given several times."""
    token: str | None = None
    """Token of the page's address; left out: the run's own. Empty: everybody on this machine may."""

    def address(self) -> Address:
        """As `senior.label` takes it."""
        port = 0 if self.port == "auto" else self.port
        if not 0 <= port < 2**16:
            raise BadInput(f"--port {port} must be between 1 and 65535.")
        return Address(self.host, port, self.allowed_host, self.token)


@dataclass(frozen=True)
class NoOptions:
    """No options."""


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
    if found := re.search(r"Missing from (senior \w+): (\S+)", text):
        return f"{found[1]} needs a {found[2]}; see {found[1]} --help."
    if found := re.search(r"Error parsing (\S+):.*(literal for int|to float).*?: ('.*?')", text):
        kind = "a whole number" if found[2] == "literal for int" else "a number"
        return f"{found[1]} needs {kind}, not {found[3]}."
    return text.split("Argument helptext")[0].split("For full helptext")[0].strip()
