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
from pathlib import Path
from typing import Any

from senior.sweep.cells import Done, Job, Outcome, job_of, order, outcomes_of, report
from senior.sweep.cores import take_cores
from senior.sweep.worker import Watch, train
from senior.types import BadInput

LEAVE_SECONDS = 120.0
"""How long actors that were told to stop may take to save what they do."""


CONNECT_SECONDS = 10.0


class Hand:
    """The actor: trains one job at a time, and hears meanwhile that it is to stop."""

    def __init__(self, threads: int, marker: str) -> None:
        """``marker``: a file in the sweep's directory, by which it is known."""
        self._watch = Watch()
        self._marker = Path(marker)
        take_cores(threads)

    def device(self, wanted: str) -> str:
        """cpu or gpu, or a sentence that says why there is none."""
        from senior.runs import prepare_device  # starts JAX

        try:
            return prepare_device(wanted)
        except BadInput as error:
            return str(error)

    def work(self, job: str) -> str:
        """An `order` done; its `report`."""
        cells = job_of(job)
        if not self._marker.exists():
            reason = f"the machine {platform.node()} does not see {self._marker.parent}, which all machines must share"
            return report([Outcome(str(cell.path), 0, False, reason) for cell in cells])
        return report(train(cells, self._watch))

    def stop(self) -> None:
        """Save what is done and leave."""
        self._watch.stop = True


class RayCrew:
    """So many actors at a time. One that is lost is replaced when there is work for it."""

    def __init__(self, address: str, device: str, jobs: int | None, out: Path) -> None:
        """Raises `BadInput` if Ray is not installed, the cluster cannot be used, or does not see ``out``."""
        self._ray = _connect(address)
        self._marker = out.resolve() / f"sweep-{uuid.uuid4().hex}"
        self._marker.touch()
        gpus = int(self._ray.cluster_resources().get("GPU", 0)) if device != "cpu" else 0
        cpus = int(self._ray.cluster_resources().get("CPU", 0))
        self.size = jobs or gpus or cpus
        if self.size < 1:
            raise BadInput(f"The Ray cluster at {address} has no processors to give.")
        self._options = {"num_cpus": max(1, cpus // gpus), "num_gpus": 1} if gpus else {"num_cpus": 1, "num_gpus": 0}
        self._hands: list[Any] = []
        self._jobs: dict[Any, tuple[Any, Job]] = {}
        first = self._hire()
        self.device = self._ray.get(first.device.remote(device))
        if self.device not in ("cpu", "gpu"):
            raise BadInput(self.device)

    @property
    def idle(self) -> int:
        """How many more jobs can be given."""
        return self.size - len(self._jobs)

    def give(self, job: Job) -> None:
        """Have a job done."""
        busy = [hand for hand, _ in self._jobs.values()]
        hand = next((hand for hand in self._hands if hand not in busy), None) or self._hire()
        self._jobs[hand.work.remote(order(job))] = hand, job

    def wait(self, seconds: float) -> list[Done]:
        """The jobs that are done, after at most so long."""
        if not self._jobs:
            time.sleep(seconds)
            return []
        ready, _ = self._ray.wait(list(self._jobs), timeout=seconds)
        return [self._take(reference) for reference in ready]

    def stop(self) -> None:
        """Tell all actors to save what they do and leave."""
        for hand in self._hands:
            hand.stop.remote()

    def close(self) -> None:
        """End all actors, everything saved, and leave the cluster."""
        self.stop()
        if self._jobs:
            self._ray.wait(list(self._jobs), num_returns=len(self._jobs), timeout=LEAVE_SECONDS)
        for hand in self._hands:
            self._ray.kill(hand)
        self._ray.shutdown()
        self._marker.unlink(missing_ok=True)

    def _hire(self) -> Any:
        actor = self._ray.remote(Hand).options(max_concurrency=2, **self._options)
        hand = actor.remote(self._options["num_cpus"], str(self._marker))
        self._hands.append(hand)
        return hand

    def _take(self, reference: Any) -> Done:
        hand, job = self._jobs.pop(reference)
        try:
            return Done(job, outcomes_of(self._ray.get(reference)))
        except self._ray.exceptions.RayError as error:
            self._hands.remove(hand)
            first = str(error).strip().splitlines()[0]
            return Done(job, (), f"its worker was lost ({type(error).__name__}: {first})")


def _connect(address: str) -> Any:
    """The module ``ray``, connected to a cluster that asks for a token."""
    if os.environ.get("RAY_AUTH_MODE", "token") != "token":
        raise BadInput("A sweep uses a Ray cluster only with a token: leave RAY_AUTH_MODE out, or set it to token.")
    os.environ["RAY_AUTH_MODE"] = "token"
    os.environ.setdefault("RAY_BACKEND_LOG_LEVEL", "error")  # else its retries fill the terminal
    try:
        import ray
    except ImportError:
        raise BadInput("Sweeps on a cluster need ray, which is not installed: pip install 'senior-rl[ray]'") from None
    kept = Path(os.environ.get("RAY_AUTH_TOKEN_PATH", Path.home() / ".ray" / "auth_token"))
    if not os.environ.get("RAY_AUTH_TOKEN") and not kept.is_file():
        raise BadInput(f"The Ray cluster's token is neither in RAY_AUTH_TOKEN nor in {kept}.")
    _reach(address)
    try:
        name = f"senior-{uuid.uuid4().hex}"
        ray.init(address=address, namespace=name, log_to_driver=False, logging_level=logging.ERROR)
    except Exception as error:  # whatever Ray raises: unreachable, wrong token, another version
        reason = str(error).strip().splitlines()[0]
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
