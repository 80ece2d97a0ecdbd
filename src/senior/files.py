"""Files that are whole or absent, and arrays in them. Imports no JAX.

Written to a temporary name, synced and renamed. ``.npz`` members carry checksums, which reading verifies. Nothing is
pickled.
"""

from __future__ import annotations

import io
import json
import os
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None


class Damaged(Exception):
    """A file that cannot be used; the text names it and says why."""


def hold(path: Path) -> int | None:
    """Lock a directory until the descriptor that is returned is closed, at the latest with this process.

    None where there are no such locks (Windows); a file system without them holds nothing. Raises `BlockingIOError` if
    another process holds it, and `OSError` if there is no such directory.
    """
    if fcntl is None:
        return None
    lock = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(lock)
        raise
    except OSError:
        pass
    return lock


def write_atomically(path: Path, data: bytes) -> None:
    """The whole file or none of it, on the disk when this returns."""
    temporary = path.with_name(path.name + ".tmp")
    with open(temporary, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    _rename(temporary, path)


def put(unfinished: Path, path: Path) -> None:
    """Give a file that is written its name: all of it is there or nothing, whatever happens to the machine."""
    _sync(unfinished)
    _rename(unfinished, path)


def _rename(unfinished: Path, path: Path) -> None:
    os.replace(unfinished, path)
    _sync(path.parent)


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def pack(arrays: dict[str, np.ndarray], compress: bool = False) -> bytes:
    """Arrays as the bytes of an ``.npz`` file."""
    buffer = io.BytesIO()
    (np.savez_compressed if compress else np.savez)(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def unpack(path: Path) -> dict[str, np.ndarray]:
    """Read an ``.npz`` file whole, checksums included; `Damaged` if its bytes are not one.

    A member's checksum is verified before its bytes are parsed. Damage makes the decompressor and the parser fail
    in more ways than can be listed, so any failure counts. A file that the system does not give (`OSError`) is not
    damaged: another time it may.
    """
    content = path.read_bytes()
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as file:
            members = {name.removesuffix(".npy"): file.read(name) for name in file.namelist()}
        return {
            name: np.lib.format.read_array(io.BytesIO(member), allow_pickle=False) for name, member in members.items()
        }
    except Exception as error:
        raise Damaged(f"{path.name} is damaged ({error})") from error


def slug(text: str) -> str:
    """Text as a part of a file's or a directory's name."""
    return re.sub(r"[^a-z0-9.]+", "-", text.lower()).strip("-.") or "unnamed"


def json_object(path: Path) -> dict[str, Any]:
    """The JSON object in a file that another process may be writing; empty if there is none that can be read."""
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
