"""Environments in processes of their own, each process with several, so that they keep up with a fast learner.

A worker (``python -m senior.envs.worker``) is told what to do in lines on one pipe and says that it is done on
another. Numbers pass through memory that both share, so a step pickles nothing. A worker that died, or does not
answer in time, is replaced, and its environments are brought back to where they were by their episodes' numbers
and actions; nothing is lost, and the run is the same bit for bit.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import select
import signal
import subprocess
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from senior.envs.episodes import Failure, Step
from senior.processes import PYTHON, importing_alike
from senior.types import BadInput, EnvSpec

PATIENCE = 120.0
"""Seconds in which a worker must have taken a step, begun an episode or built an environment."""

LIVES = 3
"""Workers that may be lost at one and the same step before the environment is held to be the reason."""


class Shared:
    """What a worker and its user share of one environment: arrays in a file that both have in memory."""

    def __init__(self, path: Path, spec: EnvSpec) -> None:
        o, a = spec.observation_size, spec.action_size
        fields = [
            ("numbers", np.float64, 2),
            ("observations", np.float32, (2, o)),
            ("action", np.float32, a),
            ("ends", np.bool_, 2),
        ]
        shared = np.asarray(np.memmap(path, dtype=fields, mode="r+" if path.exists() else "w+", shape=1))
        self.observation, self.next_observation = shared["observations"][0]
        self.action = shared["action"][0]
        self.numbers = shared["numbers"][0]  # reward, success
        self.ends = shared["ends"][0]  # terminated, truncated


class Lost(Exception):
    """A worker died or does not answer; the text says how."""


class Worker:
    """One process.

    ``life`` counts how often it was started: environments of an earlier life are gone. ``lost``: what the last one
    died of.
    """

    def __init__(self, patience: float) -> None:
        self.patience = patience
        self.fellows: Sequence[Worker] = [self]  # those that set out when this one does
        self.life = 0
        self.lost = ""
        self._places = itertools.count()
        self._start()

    def _start(self) -> None:
        orders, our_orders = os.pipe()
        our_answers, answers = os.pipe()
        self._orders, self._answers = (
            os.fdopen(our_orders, "wb", buffering=0),
            os.fdopen(our_answers, "rb", buffering=0),
        )
        command = [*PYTHON, "-m", "senior.envs.worker", str(orders), str(answers)]
        self.process = subprocess.Popen(
            command,
            pass_fds=(orders, answers),
            env=importing_alike(),
            stdin=subprocess.DEVNULL,
            start_new_session=True,  # an interrupt is for the process that gives orders
        )
        os.close(orders)
        os.close(answers)
        self._waiting = select.poll()
        self._waiting.register(self._answers, select.POLLIN)
        self._steps: list[str] = []
        self._arrived: dict[int, str] = {}
        self._rest = b""
        self.life += 1

    def place(self) -> int:
        """The number of a new place for an environment."""
        return next(self._places)

    def step(self, place: int) -> None:
        """Have a step taken at a place, with others at once; what it gave comes by `answer`."""
        self._steps.append(str(place))

    def order(self, what: str, place: int, **details: Any) -> None:
        """Have something rare done at a place; what it gave comes by `answer`."""
        self.set_out()
        self._write(f"{what} {place} {json.dumps(details)}\n")

    def set_out(self) -> None:
        """Begin the steps that are to be taken."""
        if self._steps:
            self._write(f"step {' '.join(self._steps)}\n")
            self._steps.clear()

    def _write(self, line: str) -> None:
        with contextlib.suppress(BrokenPipeError):  # `answer` will tell
            self._orders.write(line.encode())

    def answer(self, place: int) -> str:
        """The answer to a place's last order: empty, or why it failed. Raises `Lost`."""
        for fellow in self.fellows:
            fellow.set_out()
        until = time.monotonic() + self.patience
        while place not in self._arrived:
            # looked at every second, because what an environment has started may keep a dead worker's pipe open
            if not self._waiting.poll(1000 * min(1.0, max(0.0, until - time.monotonic()))):
                if self.process.poll() is not None:
                    raise Lost(self._died())
                if time.monotonic() >= until:
                    raise Lost(f"gave no answer for {self.patience:g} seconds")
                continue
            read = self._answers.read(65536)
            if not read:
                raise Lost(self._died())
            *lines, self._rest = (self._rest + read).split(b"\n")
            for line in lines:
                number, _, failure = line.decode().partition(" ")
                self._arrived[int(number)] = failure
            until = time.monotonic() + self.patience
        return self._arrived.pop(place)

    def _died(self) -> str:
        code = self.process.wait()
        return f"died ({signal.Signals(-code).name if code < 0 else f'exit code {code}'})"

    def restart(self, lost: Lost) -> None:
        """Put a new process in the lost one's place."""
        self.lost = str(lost)
        self.close()
        self._start()

    def close(self) -> None:
        """End the process, whatever it is doing."""
        self.process.kill()
        self.process.wait()
        self._orders.close()
        self._answers.close()


class Remote:
    """`senior.envs.episodes.Episodes` in a worker."""

    def __init__(self, worker: Worker, made_by: dict[str, Any], spec: EnvSpec, seed: int, purpose: int) -> None:
        """``made_by``: arguments of `senior.envs.make`, which gives ``spec``. ``seed``: the run's."""
        self.spec = spec
        self.observation = np.zeros(spec.observation_size, np.float32)
        self.notes: list[str] = []
        self.episode = 0
        self._worker = worker
        self._order = {"made_by": made_by, "seed": seed, "purpose": purpose}
        self._place = worker.place()
        self._life = 0  # of the worker, when the environment was built in it
        self._actions: list[np.ndarray] = []  # taken in the running episode, the sent one last
        self._failure: Failure | None = None
        self._under_way = False  # an action was sent, and nobody has asked what it did

    def begin(self, episode: int, afresh: bool = False) -> Failure | None:
        """See `Episodes.begin`."""
        if self._under_way:
            self.receive()
        self.episode, self._failure = episode, None
        self._actions.clear()
        if afresh:
            self._life = 0
        lives = LIVES
        while True:
            try:
                self._begin_there()
            except Lost as lost:
                self._worker.restart(lost)
                lives -= 1
                if lives:
                    continue
                self._fail(f"{LIVES} workers were lost at its beginning; the last one {lost}.")
            if self._failure is None:
                self.observation = self._shared.observation.copy()
            return self._failure

    def send(self, action: np.ndarray) -> None:
        """See `Episodes.send`."""
        if self._failure is None:
            self._actions.append(np.array(action, np.float32))
            self._under_way = True
            self._send()

    def set_out(self) -> None:
        """See `Episodes.set_out`."""
        self._worker.set_out()

    def receive(self) -> Step | Failure:
        """See `Episodes.receive`."""
        self._under_way = False
        lives = LIVES
        while True:
            try:
                if self._failure is None and self._life != self._worker.life:
                    self._relive()
                return self._failure or self._received()
            except Lost as lost:
                self._worker.restart(lost)
                lives -= 1
                if not lives:
                    return self._fail(f"{LIVES} workers were lost at this step; the last one {lost}.")

    def close(self) -> None:
        """See `Episodes.close`; the worker is closed by whoever made it."""
        if self._life == self._worker.life:
            self._worker.order("close", self._place)

    def _ask(self, what: str, **details: Any) -> None:
        """Have something rare done. Raises `Lost`; a failure becomes this object's."""
        self._worker.order(what, self._place, **details)
        self._heard()

    def _heard(self) -> Failure | None:
        """What failed, if anything did, of what was last asked for."""
        message = self._worker.answer(self._place)
        if message:
            self._failure = Failure(json.loads(message))
        return self._failure

    def _begin_there(self) -> None:
        """Begin the episode in the worker, built there if it is not yet."""
        if self._life != self._worker.life:
            with tempfile.TemporaryDirectory(prefix="senior-") as folder:
                path = Path(folder) / "shared"
                self._shared = Shared(path, self.spec)
                self._ask("open", **self._order, memory=str(path))
            if self._failure is not None:
                self._fail(self._failure.message)
                return
            self._life = self._worker.life
        self._ask("begin", episode=self.episode)

    def _send(self) -> None:
        if self._life == self._worker.life:
            self._shared.action[:] = self._actions[-1]
            self._worker.step(self._place)

    def _received(self) -> Step | Failure:
        failure = self._heard()
        if failure is not None:
            return failure
        shared = self._shared
        (reward, success), (terminated, truncated) = shared.numbers.tolist(), shared.ends.tolist()
        step = Step(
            self.observation,
            self._actions[-1],
            reward,
            shared.next_observation.copy(),
            terminated,
            truncated,
            success if self.spec.tells_success else None,
        )
        self.observation = shared.observation.copy()
        if step.ended:
            self.episode += 1
            self._actions.clear()
        return step

    def _relive(self) -> None:
        """Bring the environment, in a new process, to the step at which the old one was lost, and go on from there."""
        actions = self._actions.copy()
        self.notes.append(
            f"The worker of the environment {self.spec.name} {self._worker.lost}; another took over in episode "
            f"{self.episode} after step {len(actions) - 1}."
        )
        self._begin_there()
        for action in actions[:-1]:
            if self._failure is not None:
                return
            self._shared.action[:] = action
            self._worker.step(self._place)
            self._heard()
        if self._failure is None and not np.array_equal(self.observation, self._shared.observation):
            self._fail("its worker was lost, and it does not repeat an episode from its seed and actions.")
        elif self._failure is None:
            self._send()

    def _fail(self, why: str) -> Failure:
        self._failure = Failure(
            f"The environment {self.spec.name} of seed {self._order['seed']} failed in episode {self.episode} after "
            f"step {max(0, len(self._actions) - 1)}: {why}"
        )
        return self._failure


class Workers:
    """Workers that environments are dealt out to in turn; each is started when it is dealt the first."""

    def __init__(self, count: int, patience: float = PATIENCE) -> None:
        if count < 1:
            raise BadInput(f"There must be at least one worker, not {count}.")
        self.workers: list[Worker] = []
        self._turns = itertools.cycle(range(count))
        self._patience = patience

    def next(self) -> Worker:
        """The worker whose turn it is."""
        turn = next(self._turns)
        if turn == len(self.workers):
            worker = Worker(self._patience)
            worker.fellows = self.workers
            self.workers.append(worker)
        return self.workers[turn]

    def close(self) -> None:
        """End all of them."""
        for worker in self.workers:
            worker.close()
