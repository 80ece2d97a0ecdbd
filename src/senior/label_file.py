"""The two files that labels travel in (docs/labels.md): written whole, checked to the last number when they are read.

``NAME.jsonl`` holds what was asked and said, one pair a line after a first line that says what it is; ``NAME.npz``
beside it the segments. Whatever is wrong with them is a `BadInput` that names the file and the line. Imports no JAX.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from senior.files import Damaged, pack, unpack, write_atomically
from senior.rundir import make_room, told
from senior.teachers.recorded import SUFFIX
from senior.types import BadInput, Preferred

FORMAT = "senior-labels"
VERSION = 1
SEGMENTS = ("observation", "action", "reward")
"""Arrays of the ``.npz``: [P, 2, H, o], [P, 2, H, a] and [P, 2, H], float32; a row for every line after the first."""


class Labels(NamedTuple):
    """What the two files hold, checked."""

    header: dict[str, Any]
    pairs: list[dict[str, Any]]
    """Of every pair the names of `PAIR`, and ``answers``: a list, each with the names of `ANSWER`."""
    segments: tuple[np.ndarray, ...]
    """`SEGMENTS`."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Steps of a segment, sizes of an observation and of an action."""
        return self.header["steps"], self.header["observation"], self.header["action"]

    def complete(self, overlap: int) -> list[int]:
        """Rows of the pairs that all who were asked had answered, and ``overlap`` people or more."""
        wanted = max(overlap, 1)
        return [
            row
            for row, pair in enumerate(self.pairs)
            if (standing := sum(answer["withdrawn"] is None for answer in pair["answers"])) >= wanted
            and (standing >= self.header["overlap"] or pair["collected_step"] is not None)
        ]


def write(file: Path, labels: Labels) -> None:
    """Write labels, whose header need not tell what follows from them: format, version, pairs and sha256.

    Each file is whole or absent. `BadInput` if the file is not named as one of labels, or one of the two exists.
    """
    segments_file = segments_beside(file)
    make_room(file)
    for one in (file, segments_file):
        if one.exists():
            raise BadInput(f"{one} exists; choose another --out.")
    header = {
        "format": FORMAT,
        "version": VERSION,
        "pairs": len(labels.pairs),
        **labels.header,
        "sha256": _digest(labels.segments),
    }
    lines = [json.dumps(line, allow_nan=False) for line in (header, *labels.pairs)]
    with told(file):
        write_atomically(segments_file, pack(dict(zip(SEGMENTS, labels.segments, strict=True))))
        write_atomically(file, ("\n".join(lines) + "\n").encode())


def segments_beside(file: Path) -> Path:
    """Where the segments of a file of labels are; `BadInput` if that is not named as one."""
    if file.suffix != SUFFIX:
        raise BadInput(f"{file} must be named with {SUFFIX} at its end; the segments lie beside it, with .npz.")
    return file.with_suffix(".npz")


def shapes(pairs: int, steps: int, observation: int, action: int) -> dict[str, tuple[int, ...]]:
    """Of the `SEGMENTS`, by their names."""
    return {
        "observation": (pairs, 2, steps, observation),
        "action": (pairs, 2, steps, action),
        "reward": (pairs, 2, steps),
    }


def _digest(segments: Iterable[np.ndarray]) -> str:
    """SHA-256 of the numbers, by which the two files know each other."""
    found = hashlib.sha256()
    for array in segments:
        found.update(np.ascontiguousarray(array, "<f4").tobytes())
    return found.hexdigest()


def read(file: Path) -> Labels:
    """The labels in a file and in the ``.npz`` beside it. `BadInput`, naming the file and the line, if damaged."""
    segments_file = segments_beside(file)
    with told(file):
        lines = file.read_bytes().split(b"\n")
    if lines[-1] == b"":
        lines.pop()
    header = _header(file, lines)
    pairs = [_pair(_Place(file, number), line) for number, line in enumerate(lines[1:], start=2)]
    if len(pairs) != header["pairs"]:
        raise BadInput(f"{file} holds {len(pairs)} pairs, and its first line says {header['pairs']}.")
    _check_numbers(file, pairs)
    return Labels(header, pairs, _segments(file, segments_file, header))


class _Place(NamedTuple):
    """Where something is wrong."""

    file: Path
    line: int

    def error(self, sentence: str) -> BadInput:
        return BadInput(f"{self.file}, line {self.line}: {sentence}")


class _Rule(NamedTuple):
    """What a value must be, in words."""

    holds: Callable[[Any], bool]
    words: str


def _whole(least: int, most: int) -> _Rule:
    return _Rule(lambda value: type(value) is int and least <= value <= most, f"a whole number from {least} to {most}")


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) < 1e300  # a comparison that no NaN and no infinity passes


def _is_time(value: Any) -> bool:
    return _is_number(value) and 0 <= value < 1e11  # in seconds; milliseconds since 1970 are more


def _maybe(rule: _Rule) -> _Rule:
    return _Rule(lambda value: value is None or rule.holds(value), f"{rule.words} or null")


def _text(pattern: str, words: str) -> _Rule:
    known = re.compile(pattern)
    return _Rule(lambda value: isinstance(value, str) and known.fullmatch(value) is not None, words)


_COUNT = _whole(0, 2**53)
_BIT = _whole(0, 1)
_SHARE = _maybe(_Rule(lambda value: _is_number(value) and 0 <= value <= 1, "a number from 0 to 1"))
_SIZE = _whole(1, 2**20)
_HEADER = {
    "format": _Rule(lambda value: value == FORMAT, f'"{FORMAT}"'),
    "version": _Rule(lambda value: value == VERSION, f"{VERSION}, the version that this program reads"),
    "pairs": _whole(1, 2**53),
    "steps": _SIZE,
    "observation": _SIZE,
    "action": _SIZE,
    "environment": _text(r".+", "a name"),
    "overlap": _SIZE,
    "sha256": _text(r"[0-9a-f]{64}", "a SHA-256"),
}
_OF_PAIR = {
    "id": _whole(1, 2**53),
    "session": _COUNT,
    "reserve": _BIT,
    "step": _COUNT,
    "run_seed": _COUNT,
    "episode_0": _COUNT,
    "start_0": _COUNT,
    "episode_1": _COUNT,
    "start_1": _COUNT,
    "scores": _Rule(
        lambda value: isinstance(value, dict) and all(score is None or _is_number(score) for score in value.values()),
        "an object of finite numbers or nulls",
    ),
    "prediction": _SHARE,
    "shown_left": _BIT,
    "collected_step": _maybe(_COUNT),
    "second": _SHARE,
    "answers": _Rule(lambda value: isinstance(value, list), "a list"),
}
_OF_ANSWER = {
    "id": _whole(1, 2**53),
    "annotator": _text(r"[^\x00-\x1f\x7f\ud800-\udfff]{1,1000}", "a name, without control characters"),
    "answer": _maybe(
        _Rule(lambda value: type(value) is int and value in list(Preferred), "0 (first), 1 (second), -1 (equal)")
    ),
    "strength": _maybe(_text("slightly|clearly", '"slightly", "clearly"')),
    "answered_at": _Rule(_is_time, "a time in seconds since 1970"),
    "seconds": _maybe(_Rule(_is_time, "a number of seconds, 0 or more,")),
    "replays": _maybe(_COUNT),
    "shown_left": _BIT,
    "clip_0": _maybe(_text(r"[0-9a-f]{64}", "a SHA-256")),
    "clip_1": _maybe(_text(r"[0-9a-f]{64}", "a SHA-256")),
    "withdrawn": _maybe(_COUNT),
}


def _object(place: _Place, value: Any, rules: Mapping[str, _Rule], what: str) -> dict[str, Any]:
    """``value`` if it is an object with those names and values that obey the rules, in the rules' order."""
    if not isinstance(value, dict):
        raise place.error(f"{what} must be a JSON object.")
    if odd := rules.keys() ^ value.keys():
        name = sorted(odd)[0]
        raise place.error(f"{what} {'lacks' if name in rules else 'has an unknown'} {name[:100]!r}.")
    for name, rule in rules.items():
        if not rule.holds(value[name]):
            raise place.error(f"{name} must be {rule.words}, not {json.dumps(value[name])[:100]}.")
    return {name: value[name] for name in rules}


def _parse(place: _Place, line: bytes) -> Any:
    try:
        return json.loads(line)
    except json.JSONDecodeError as error:
        raise place.error(f"this is not JSON: {error.msg} at character {error.pos + 1}.") from error
    except (ValueError, RecursionError) as error:  # bytes that are no text, numbers or depths beyond measure
        raise place.error("this is not JSON.") from error


def _header(file: Path, lines: Sequence[bytes]) -> dict[str, Any]:
    place = _Place(file, 1)
    if not lines:
        raise BadInput(f"{file} is empty.")
    found = _parse(place, lines[0])
    for name in ("format", "version"):  # before anything else: what follows depends on them
        if isinstance(found, dict) and not _HEADER[name].holds(found.get(name)):
            given = json.dumps(found.get(name))[:100]
            raise place.error(f"{name} must be {_HEADER[name].words}, not {given}.")
    return _object(place, found, _HEADER, "the first line")


def _pair(place: _Place, line: bytes) -> dict[str, Any]:
    pair = _object(place, _parse(place, line), _OF_PAIR, "a pair")
    pair["answers"] = [_object(place, answer, _OF_ANSWER, "an answer") for answer in pair["answers"]]
    names = [answer["annotator"] for answer in pair["answers"] if answer["withdrawn"] is None]
    if len(set(names)) < len(names):
        raise place.error("somebody has two answers that stand.")
    return pair


def _check_numbers(file: Path, pairs: Sequence[Mapping[str, Any]]) -> None:
    """Pairs are numbered in the order of asking; no two answers have one number."""
    last, seen = 0, set()
    for line, pair in enumerate(pairs, start=2):
        place = _Place(file, line)
        if pair["id"] <= last:
            raise place.error(f"pair {pair['id']} comes after pair {last}.")
        last = pair["id"]
        for answer in pair["answers"]:
            if answer["id"] in seen:
                raise place.error(f"there are two answers of number {answer['id']}.")
            seen.add(answer["id"])


def _segments(file: Path, segments_file: Path, header: Mapping[str, Any]) -> tuple[np.ndarray, ...]:
    if not segments_file.exists():
        raise BadInput(f"{file} needs {segments_file.name} beside it, which holds its segments and is not there.")
    try:
        with told(segments_file):
            found = unpack(segments_file)
    except Damaged as error:
        raise BadInput(f"{segments_file.parent}/{error}.") from error
    sizes = shapes(header["pairs"], header["steps"], header["observation"], header["action"])
    if found.keys() != sizes.keys():
        raise BadInput(f"{segments_file} must hold {', '.join(SEGMENTS)}, and holds {', '.join(found) or 'nothing'}.")
    for name, size in sizes.items():
        if found[name].dtype != np.dtype("<f4") or found[name].shape != size:
            raise BadInput(
                f"{segments_file}: {name} must be float32 {list(size)} by the first line of {file.name}, not "
                f"{found[name].dtype} {list(found[name].shape)}."
            )
        finite = np.isfinite(found[name]).reshape(len(found[name]), -1).all(axis=1)
        if not finite.all():
            line = int(np.argmin(finite)) + 2
            raise BadInput(
                f"{segments_file}: {name} of the pair in line {line} of {file.name} holds a number that is none."
            )
    segments = tuple(found[name] for name in SEGMENTS)
    if _digest(segments) != header["sha256"]:
        raise BadInput(
            f"{segments_file} does not belong to {file.name}: it holds other numbers than were written with it."
        )
    return segments
