"""Workers on a Ray cluster: an actor per processor, or per GPU, on whichever machine has room.

Every machine needs this program installed, and the sweep's directory under the same path (a network file system): runs,
checkpoints and labels are files there, so a machine that is lost takes nothing with it. The cluster must ask for a
token (RAY_AUTH_MODE=token): whoever reaches a Ray cluster without one can run anything on it.
"""

from __future__ import annotations

import logging
import os
import platform
import socket
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

from senior.extras import require
from senior.rundir import told
from senior.sweep.cells import Done, Job, Outcome, job_of, order, outcomes_of, report
from senior.sweep.cores import take_cores
from senior.sweep.scheduler import LEAVE_SECONDS, RETRIES
from senior.sweep.worker import Watch, train
from senior.types import BadInput

CONNECT_SECONDS = 10.0


class Hand:
    """The actor: trains one job at a time, and hears meanwhile that it is to stop."""

    def __init__(self, threads: int, marker: str) -> None:
        """``marker``: a file in the sweep's directory, by which it is known."""
        self._watch = Watch()
        self._marker = Path(marker)
        take_cores(threads)

    def begin(self, wanted: str) -> str:
        """Start JAX; a sentence if this is no place for a sweep, else nothing."""
        if os.environ.get("RAY_AUTH_MODE") != "token":
            return "The Ray cluster does not ask for a token: start it with RAY_AUTH_MODE=token (docs/experiments.md)."
        from senior.device import prepare_device

        try:
            prepare_device(wanted)
        except BadInput as error:
            return str(error)
        return ""

    def work(self, job: str) -> str:
        """An `order` done; its `report`."""
        cells = job_of(job)
        if not self._marker.exists():
            reason = f"the machine {platform.node()} does not see {self._marker.parent}, which all machines must share"
            return report([Outcome(False, reason)] * len(cells))
        return report(train(cells, self._watch))

    def stop(self) -> None:
        """Save what is done and leave."""
        self._watch.stop = True


class RayCrew:
    """So many actors, as far as the cluster has room for them. One that is lost is replaced when there is room."""

    def __init__(self, address: str, device: str, jobs: int | None, out: Path, say: Callable[[str], None]) -> None:
        """jobs: actors; None: one per processor or, where there are GPUs and not only the CPU is asked for, per GPU.

        Raises `BadInput` if Ray is not installed or the cluster cannot be used.
        """
        self._ray = _connect(address)
        self._wanted, self._say = device, say
        self._marker = out.resolve() / f"sweep-{uuid.uuid4().hex}"
        with told(out):
            self._marker.touch()
        nodes = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        with_gpu = [node for node in nodes if node.get("GPU", 0) >= 1 and device != "cpu"]
        gpus = int(sum(node["GPU"] for node in with_gpu))
        self.device = "gpu" if gpus else "cpu"
        self.size = jobs or gpus or max(1, int(sum(node.get("CPU", 0) for node in nodes)))
        self._cpus = max(1, min((int(node.get("CPU", 1) // node["GPU"]) for node in with_gpu), default=1))
        self._ready: list[Any] = []
        self._placing: dict[Any, Any] = {}
        self._jobs: dict[Any, tuple[Any, Job]] = {}
        self._asked, self._told = time.monotonic(), False
        self._fallen = 0  # actors in a row that were lost before they could begin
        for _ in range(self.size):
            self._hire()

    @property
    def idle(self) -> int:
        """How many more jobs can be given now: to actors that have a place."""
        return len(self._ready)

    def give(self, job: Job) -> None:
        """Have a job done."""
        hand = self._ready.pop()
        self._jobs[hand.work.remote(order(job))] = hand, job

    def wait(self, seconds: float) -> list[Done]:
        """The jobs that are done, after at most so long. Raises `BadInput` if the cluster is not fit for a sweep."""
        under_way = [*self._jobs, *self._placing]
        if not under_way:
            time.sleep(seconds)
            return []
        over, _ = self._ray.wait(under_way, num_returns=len(under_way), timeout=seconds)
        for placed in [one for one in over if one in self._placing]:
            self._welcome(placed)
        if not (self._ready or self._jobs or self._told) and time.monotonic() - self._asked > CONNECT_SECONDS:
            self._told = True
            self._say("The Ray cluster has no room yet; the sweep waits for it.")
        return [self._take(one) for one in over if one in self._jobs]

    def stop(self) -> None:
        """Tell all actors to save what they do and leave."""
        for hand, _ in self._jobs.values():
            hand.stop.remote()

    def close(self) -> None:
        """End all actors, everything saved, and leave the cluster."""
        self.stop()
        if self._jobs:
            self._ray.wait(list(self._jobs), num_returns=len(self._jobs), timeout=LEAVE_SECONDS)
        for hand in [*self._ready, *self._placing.values(), *(hand for hand, _ in self._jobs.values())]:
            self._ray.kill(hand)
        self._ray.shutdown()
        self._marker.unlink(missing_ok=True)

    def _hire(self) -> None:
        """A new actor, which may have to wait for its place."""
        resources = {"num_cpus": self._cpus, "num_gpus": int(self.device == "gpu")}
        hand = self._ray.remote(Hand).options(max_concurrency=2, **resources).remote(self._cpus, str(self._marker))
        self._begin(hand)

    def _begin(self, hand: Any) -> None:
        self._placing[hand.begin.remote(self._wanted)] = hand

    def _welcome(self, placed: Any) -> None:
        hand = self._placing.pop(placed)
        try:
            refused = self._ray.get(placed)
        except self._ray.exceptions.RayError as error:
            lost = isinstance(error, self._ray.exceptions.RayActorError)
            if lost and self._fallen < self.size + RETRIES:
                if not self._fallen:
                    self._say("A worker on the Ray cluster was lost as it began; another one is asked for.")
                self._fallen += 1
                self._hire()
                return
            refused = f"A worker on the Ray cluster cannot begin: {_first_line(error)}"
        if refused:
            raise BadInput(refused)
        self._fallen = 0
        self._ready.append(hand)

    def _take(self, reference: Any) -> Done:
        hand, job = self._jobs.pop(reference)
        try:
            done = Done(job, outcomes_of(self._ray.get(reference)))
        except self._ray.exceptions.RayError as error:
            self._hire()
            for idle in self._ready:  # they may be lost with it
                self._begin(idle)
            self._ready.clear()
            return Done(job, (), f"its worker was lost ({type(error).__name__}: {_first_line(error)})")
        self._ready.append(hand)
        return done


def _first_line(error: Exception) -> str:
    return next(iter(str(error).strip().splitlines()), type(error).__name__)


def _connect(address: str) -> Any:
    """The module ``ray``, connected to a cluster that asks for a token."""
    if os.environ.get("RAY_AUTH_MODE", "token") != "token":
        raise BadInput("A sweep uses a Ray cluster only with a token: leave RAY_AUTH_MODE out, or set it to token.")
    os.environ["RAY_AUTH_MODE"] = "token"
    os.environ.setdefault("RAY_BACKEND_LOG_LEVEL", "error")  # else its retries fill the terminal
    require("A sweep on a cluster", "ray", "ray")
    import ray

    kept = Path(os.environ.get("RAY_AUTH_TOKEN_PATH", Path.home() / ".ray" / "auth_token"))
    if not os.environ.get("RAY_AUTH_TOKEN") and not kept.is_file():
        raise BadInput(f"The Ray cluster's token is neither in RAY_AUTH_TOKEN nor in {kept}.")
    _reach(address)
    try:
        name = f"senior-{uuid.uuid4().hex}"
        ray.init(address=address, namespace=name, log_to_driver=False, logging_level=logging.ERROR)
    except Exception as error:  # whatever Ray raises: unreachable, wrong token, another version
        reason = _first_line(error)
        raise BadInput(f"The Ray cluster at {address} cannot be used, or has another token: {reason}") from error
    return ray


def _reach(address: str) -> None:
    """`BadInput` if nothing listens there; Ray itself would try for many minutes."""
    host, _, port = address.rpartition(":")
    if not host:  # a name that Ray resolves: auto, local
        return
    try:
        socket.create_connection((host, int(port)), CONNECT_SECONDS).close()
    except (OSError, ValueError) as error:
        raise BadInput(f"No Ray cluster answers at {address}: {error}.") from error
