"""The address at which a page is to be served. Needs nothing that is not installed by default."""

from __future__ import annotations

import ipaddress
import re
import socket
from dataclasses import dataclass

from senior.types import BadInput

PLAIN = re.compile(r"[A-Za-z0-9._~-]*")
"""Tokens that stand in an address and in a cookie as they are."""


@dataclass(frozen=True)
class Address:
    """Where a page is to be served."""

    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 lets other machines in, with the token of the printed address."""
    port: int = 0
    """0: where the run was served before, else the first free one from 8642 on."""
    allowed_hosts: tuple[str, ...] = ()
    """Further names that browsers may know this machine by."""
    token: str | None = None
    """None: the run's own. Empty: everybody on this machine may."""


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches a server there."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def shown_host(host: str) -> str:
    """The host as it stands in an address that others can open."""
    if host in ("0.0.0.0", "::"):
        return socket.gethostname()
    return f"[{host}]" if ":" in host else host


def check_address(address: Address) -> None:
    """`BadInput` if nothing can be served there, on any port."""
    if address.token and not PLAIN.fullmatch(address.token):
        raise BadInput("Only letters from A to Z, digits and . _ ~ - can stand in a token.")
    if address.token == "" and not is_loopback(address.host):
        raise BadInput(f"Without a token the page can only be served to this machine, not on {address.host}.")
    try:
        listening_at(address.host, 0).close()
    except OSError as error:
        raise BadInput(f"Cannot listen on {address.host}: {error.strerror or error}.") from error


def listening_at(host: str, port: int) -> socket.socket:
    """A listening socket. Raises `OSError`."""
    # the protocol is told: else asyncio leaves Nagle's algorithm on, which costs 40 ms for every answer
    opened = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        opened.bind((host, port))
        opened.listen(128)
    except OSError:
        opened.close()
        raise
    return opened
