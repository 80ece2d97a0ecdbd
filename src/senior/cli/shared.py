"""What several commands share: exit codes, and groups of options."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

import tyro

from senior.label.address import Address
from senior.types import BadInput

DONE, FAILED, INTERRUPTED = 0, 1, 130
"""Exit codes, beside `BAD_INPUT`."""


@dataclass(frozen=True)
class Machine:
    """How the runs of a command share this machine."""

    workers: int | Literal["auto"] = "auto"
    """Most processes that the environments of runs of one program live in; 0: this one.
    auto: 0 on a CPU; on a GPU one per processor."""
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
