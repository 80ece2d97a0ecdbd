"""Many runs in one program: functions of one run, lifted over all of them.

On a CPU the lift is a loop: each run then equals, bit for bit, the same seed trained alone, and vmap was
measured to gain nothing. On a GPU it is ``vmap``: the runs' arrays are stacked and one program serves them all.
What is rare (sessions, fits, refreshes) is called for one run at a time, by index.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any, Literal, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from senior.config import Config
from senior.learner import Learner, Run

Lift = Literal["loop", "vmap"]
OfOneRun = Callable[..., tuple[Run, Any]]


class PerRun(Protocol):
    """Results of all runs; those of run ``i`` are ``results[i]``."""

    def __getitem__(self, i: int, /) -> Any: ...


class Given(NamedTuple):
    """Arguments of all runs by name, handed over once for all functions that take some of them."""

    columns: Mapping[str, Sequence[Any]]  # one per run
    packed: Any  # under vmap: the same on the device, a row per run
    form: _Form | None


class Proposal(NamedTuple):
    """What a function would change in all runs: the fields' new values, per run or stacked, and its results."""

    changes: Sequence[str]
    fields: Any
    results: Any


class Runs:
    """The traced states of R runs. Functions are compiled once each and own the state they are given."""

    def __init__(self, states: Sequence[Run], lift: Lift) -> None:
        self.size = len(states)
        self.lift = lift
        self._loop = list(states) if lift == "loop" else []
        self._stack: Run | None = _stack(states) if lift == "vmap" else None

    def __getitem__(self, i: int) -> Run:
        """The state of run ``i``. Do not keep it across a call: its arrays are given away."""
        return self._loop[i] if self.lift == "loop" else jax.tree.map(lambda leaf: leaf[i], self._stack)

    def __setitem__(self, i: int, state: Run) -> None:
        if self.lift == "loop":
            self._loop[i] = state
        else:
            self._stack = jax.tree.map(lambda leaf, new: leaf.at[i].set(new), self._stack, state)

    def wait(self, proposal: Proposal | None = None) -> None:
        """Until everything asked of the device is done, ``proposal`` included."""
        jax.block_until_ready((self._loop, self._stack, proposal and proposal.fields))

    def view(self, i: int, pick: Callable[[Run], Any]) -> Any:
        """A part of the state of run ``i``, without copying the rest. Not to be kept either."""
        if self.lift == "loop":
            return pick(self._loop[i])
        return jax.tree.map(lambda leaf: leaf[i], pick(self._stack))  # pyright: ignore[reportArgumentType]

    def give(self, **columns: Sequence[Any]) -> Given:
        """Hand arguments over: each column holds one per run, of the host's numbers, arrays or named tuples of them."""
        if self.lift == "loop":
            return Given(columns, None, None)
        packed, form = _pack(columns)
        return Given(columns, jax.device_put(packed), form)

    def propose(
        self, of_one: OfOneRun, changes: Sequence[str], active: Sequence[bool], given: Given, *names: str
    ) -> Proposal:
        """Compute a function for all active runs, and leave their states as they are until `accept`.

        changes: the fields of `Run` that the function changes. names: of the arguments that it takes.
        The device works on while this returns. Under vmap inactive runs are computed too and their results mean
        nothing.
        """
        return self._propose(of_one, changes, False, active, given, names)

    def accept(self, proposal: Proposal, active: Sequence[bool]) -> PerRun:
        """Put what was proposed into the states of the active runs; returns the function's results."""
        if self.lift == "vmap":
            assert self._stack is not None
            self._stack = self._stack._replace(**dict(zip(proposal.changes, proposal.fields, strict=True)))
            return _Stacked(proposal.results)
        for i, on in enumerate(active):
            if on:
                fields = dict(zip(proposal.changes, proposal.fields[i], strict=True))
                self._loop[i] = self._loop[i]._replace(**fields)
        return proposal.results

    def every(
        self, of_one: OfOneRun, changes: Sequence[str], active: Sequence[bool], given: Given, *names: str
    ) -> PerRun:
        """`propose` and `accept` in one, in the arrays that the states have."""
        return self.accept(self._propose(of_one, changes, True, active, given, names), active)

    def _propose(
        self,
        of_one: OfOneRun,
        changes: Sequence[str],
        donate: bool,
        active: Sequence[bool],
        given: Given,
        names: tuple[str, ...],
    ) -> Proposal:
        if self.lift == "vmap":
            assert self._stack is not None
            function = compiled(of_one, self.lift, tuple(changes), donate, given.form, names)
            return Proposal(changes, *function(*_part(self._stack, changes), given.packed))
        function = compiled(of_one, self.lift, tuple(changes), donate)
        fields, results = [None] * self.size, [None] * self.size
        for i, state in enumerate(self._loop):
            if active[i]:
                arguments = (given.columns[name][i] for name in names)
                fields[i], results[i] = function(*_part(state, changes), *arguments)
        return Proposal(changes, fields, results)

    def look(
        self,
        pick: Callable[[Run], Any],
        of_part: Callable[..., Any],
        active: Sequence[bool],
        given: Given,
        *names: str,
    ) -> PerRun:
        """Call a function of a part of the state, which it leaves as it is, for all active runs."""
        if self.lift == "vmap":
            function = compiled(of_part, self.lift, None, False, given.form, names)
            return _Stacked(function(pick(self._stack), given.packed))  # pyright: ignore[reportArgumentType]
        function = compiled(of_part, self.lift, None, donate=False)
        return [
            function(pick(state), *(given.columns[name][i] for name in names)) if active[i] else None
            for i, state in enumerate(self._loop)
        ]

    def one(self, i: int, of_one: OfOneRun, *arguments: Any) -> Any:
        """Call a function for run ``i`` alone."""
        function = compiled(of_one, self.lift, "all", donate=True)
        if self.lift == "vmap":
            self._stack, result = function(self._stack, jnp.int32(i), *arguments)
        else:
            self._loop[i], result = function(self._loop[i], *arguments)
        return result


class _Form(NamedTuple):
    """How the arguments of one run lie in a row of words of 32 bits."""

    tree: Any
    leaves: tuple[tuple[tuple[int, ...], np.dtype], ...]  # shape and type

    def take_apart(self, row: jax.Array) -> dict[str, Any]:
        """The arguments that lie in a row, by name; traced."""
        ends = np.cumsum([int(np.prod(shape)) for shape, _ in self.leaves])
        leaves = []
        for words, (shape, kind) in zip(jnp.split(row, ends[:-1]), self.leaves, strict=True):
            words = words.reshape(shape)
            leaves.append(words != 0 if kind.kind == "b" else jax.lax.bitcast_convert_type(words, kind))
        return jax.tree.unflatten(self.tree, leaves)


def _pack(columns: Mapping[str, Sequence[Any]]) -> tuple[np.ndarray, _Form]:
    """Arguments of all runs as one array with a row per run: whatever goes to a GPU by itself costs half a millisecond
    or more, however small it is."""
    leaves: list[np.ndarray] = []
    for name in sorted(columns):  # the order of JAX's leaves
        column = columns[name]
        leaves += map(np.array, zip(*column, strict=True) if isinstance(column[0], tuple) else [column])
    tree = jax.tree.structure({name: column[0] for name, column in columns.items()})
    form = _Form(tree, tuple((leaf.shape[1:], leaf.dtype) for leaf in leaves))
    return np.concatenate([_words(leaf) for leaf in leaves], axis=1), form


def _words(leaf: np.ndarray) -> np.ndarray:
    """The words of 32 bits of each row."""
    words = leaf.astype(np.uint32) if leaf.dtype == bool else leaf
    assert words.dtype.itemsize == 4, f"{leaf.dtype} has no words of 32 bits"
    return words.view(np.uint32).reshape(len(leaf), -1)


@lru_cache(maxsize=256)
def compiled(
    of_one: Callable[..., Any],
    lift: Lift,
    changes: tuple[str, ...] | Literal["all"] | None,
    donate: bool,
    form: _Form | None = None,
    names: tuple[str, ...] = (),
) -> Any:
    """A function of one run, lifted and compiled. The same function is the same program for all that use it.

    changes: fields of every run that it changes; "all": it may change everything of the one run it is called for;
    None: it changes nothing. form: how arguments are packed, if they are; names: of those that it takes.
    """
    if changes == "all":
        function = of_one if lift == "loop" else _at(of_one)
    else:
        function = _of_part(of_one, changes) if changes else of_one
        function = _of_row(function, form, names) if form else function
        function = function if lift == "loop" else jax.vmap(function)
    return jax.jit(function, donate_argnums=0 if donate else ())


def _of_row(function: Callable[..., Any], form: _Form, names: tuple[str, ...]) -> Callable[..., Any]:
    def call(*states_and_row: Any) -> Any:
        *states, row = states_and_row
        given = form.take_apart(row)
        return function(*states, *(given[name] for name in names))

    return call


def _part(state: Run, changes: Sequence[str]) -> tuple[tuple[Any, ...], Run]:
    """The fields that will change, and the state without them."""
    return tuple(getattr(state, name) for name in changes), state._replace(**dict.fromkeys(changes))


def _of_part(of_one: OfOneRun, changes: Sequence[str]) -> Callable[..., tuple[tuple[Any, ...], Any]]:
    """A function of one run as one of `_part`: what it does not change is neither given away nor given back."""

    def call(fields: tuple[Any, ...], rest: Run, *arguments: Any) -> tuple[tuple[Any, ...], Any]:
        before = rest._replace(**dict(zip(changes, fields, strict=True)))
        after, result = of_one(before, *arguments)
        touched = [name for name in Run._fields if getattr(after, name) is not getattr(before, name)]
        assert set(touched) <= set(changes), f"{of_one} changes {touched}, not only {changes}"
        return tuple(getattr(after, name) for name in changes), result

    return call


def _stack(trees: Sequence[Any]) -> Any:
    """One tree with a leading run axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


class _Stacked:
    """Results with a leading run axis, fetched as one when somebody looks."""

    def __init__(self, results: Any) -> None:
        self._results = results
        self._fetched = False

    def __getitem__(self, i: int) -> Any:
        if not self._fetched:
            self._results, self._fetched = jax.device_get(self._results), True
        return jax.tree.map(lambda leaf: leaf[i], self._results)


def _at(of_one: OfOneRun) -> Callable[..., tuple[Any, Any]]:
    def call(stack: Any, i: Any, *arguments: Any) -> tuple[Any, Any]:
        state, result = of_one(jax.tree.map(lambda leaf: leaf[i], stack), *arguments)
        return jax.tree.map(lambda leaf, new: leaf.at[i].set(new), stack, state), result

    return call


def state_bytes(learner: Learner, config: Config) -> int:
    """Memory that the state of one run takes on the device, in bytes: nearly all of it is the replay."""
    leaves = jax.tree.leaves(jax.eval_shape(lambda: learner.init(config)))
    return sum(leaf.size * leaf.dtype.itemsize for leaf in leaves)


def lift_for(device: str) -> Lift:
    """How runs are put into one program on that device."""
    return "vmap" if device == "gpu" else "loop"
