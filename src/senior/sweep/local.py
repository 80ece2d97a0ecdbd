"""Workers on this machine: processes of their own, each with its share of the processors."""

from __future__ import annotations

import contextlib
import os
import selectors
import signal
import subprocess
from dataclasses import dataclass
from itertools import count
from pathlib import Path

from senior.processes import PYTHON, importing_alike
from senior.protocol import threads
from senior.rundir import told
from senior.sweep.cells import Done, Job, order, outcomes_of
from senior.sweep.scheduler import LEAVE_SECONDS
from senior.types import BadInput


@dataclass
class _Worker:
    process: subprocess.Popen[bytes]
    orders: int
    answers: int
    log: Path
    job: Job | None = None
    heard: bytes = b""
    leaving: bool = False
    """It was told to stop, and ends."""


class LocalCrew:
    """So many workers at a time. One that dies is replaced when there is work for it."""

    def __init__(self, device: str, jobs: int | None, logs: Path) -> None:
        """device: auto, cpu or gpu. jobs: workers; None: one per processor on a CPU, one on a GPU.

        Raises `BadInput` if there is no such device.
        """
        with told(logs):
            logs.mkdir(parents=True, exist_ok=True)
        self.device = find_device(device)
        if self.device == "gpu" and (jobs or 1) > 1:
            raise BadInput(f"--jobs {jobs}: a GPU has one worker, which trains as many runs at a time as it holds.")
        self.size = jobs or (1 if self.device == "gpu" else threads())
        self._threads = max(1, threads() // self.size)
        self._logs = logs
        self._workers: list[_Worker] = []

    @property
    def idle(self) -> int:
        """How many more jobs can be given."""
        return self.size - sum(worker.job is not None for worker in self._workers)

    def give(self, job: Job) -> None:
        """Have a job done."""
        idle = [worker for worker in self._workers if worker.job is None]
        for worker in [worker for worker in idle if worker.process.poll() is not None]:
            idle.remove(worker)
            self._workers.remove(worker)
            self._bury(worker)
        worker = next((worker for worker in idle if not worker.leaving), None) or self._start()
        worker.job = job
        with contextlib.suppress(BrokenPipeError):  # it died idle; `wait` finds out
            os.write(worker.orders, f"{order(job)}\n".encode())

    def wait(self, seconds: float) -> list[Done]:
        """The jobs that are done, after at most so long."""
        busy = [worker for worker in self._workers if worker.job is not None]
        with selectors.DefaultSelector() as selector:
            for worker in busy:
                selector.register(worker.answers, selectors.EVENT_READ)
            selector.select(seconds)
        return [done for worker in busy for done in self._hear(worker)]

    def stop(self) -> None:
        """Tell all workers to save what they do and leave."""
        for worker in self._workers:
            if worker.process.poll() is None:
                worker.process.send_signal(signal.SIGTERM)

    def close(self) -> None:
        """End all workers, everything saved."""
        self.stop()
        for worker in self._workers:
            self._bury(worker, LEAVE_SECONDS)
        self._workers = []

    def _start(self) -> _Worker:
        taken = {worker.log for worker in self._workers}
        names = (self._logs / f"worker-{i}.log" for i in count())
        log = next(name for name in names if name not in taken)
        orders, give = os.pipe()
        hear, answers = os.pipe()
        os.set_blocking(hear, False)
        command = [*PYTHON, "-m", "senior.sweep.worker", str(orders), str(answers), str(self._threads)]
        with open(log, "a") as file:
            process = subprocess.Popen(
                command,
                env=importing_alike(),
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=file,
                pass_fds=(orders, answers),
                start_new_session=True,  # an interrupt at the keyboard is the sweep's, which then stops its workers
            )
        os.close(orders)
        os.close(answers)
        worker = _Worker(process, give, hear, log)
        self._workers.append(worker)
        return worker

    def _hear(self, worker: _Worker) -> list[Done]:
        """What a busy worker has to say, or that it is dead: its pipe may be kept open by what it had started."""
        dead, job = worker.process.poll() is not None, worker.job
        assert job is not None
        try:
            told = os.read(worker.answers, 1 << 16)
        except BlockingIOError:
            if not dead:
                return []
            told = b""
        worker.heard += told
        if worker.heard.endswith(b"\n"):
            outcomes, worker.heard, worker.job = outcomes_of(worker.heard.decode()), b"", None
            worker.leaving = any(not (outcome.finished or outcome.failure) for outcome in outcomes)
            return [Done(job, outcomes)]
        if told:
            return []
        self._workers.remove(worker)
        self._bury(worker, 1)  # it dies, or has closed its pipe
        return [Done(job, (), _why(worker.process.returncode, worker.log))]

    def _bury(self, worker: _Worker, patience: float = 0.0) -> None:
        """Let go of one that ends; it is killed if it has not after so many seconds."""
        try:
            worker.process.wait(patience)
        except subprocess.TimeoutExpired:
            worker.process.kill()
            worker.process.wait()
        os.close(worker.orders)
        os.close(worker.answers)


def _why(code: int, log: Path) -> str:
    if code < 0:
        return f"its process was killed (signal {-code})"
    said = log.read_text(errors="replace").strip().splitlines()
    return f"its process ended with code {code}: {said[-1] if said else 'it said nothing'} ({log})"


def find_device(device: str) -> str:
    """cpu or gpu; asked in a process of its own, so that this one never holds a GPU's memory."""
    if device == "cpu":
        return device
    program = "import sys\nfrom senior.device import prepare_device\nfrom senior.types import BadInput\n"
    program += f"try:\n    print(prepare_device({device!r}))\nexcept BadInput as error:\n    sys.exit(str(error))\n"
    asked = subprocess.run(
        [*PYTHON, "-c", program],
        env=importing_alike(),
        capture_output=True,
        text=True,
        start_new_session=True,
    )
    if asked.returncode:
        raise BadInput((asked.stderr.strip().splitlines() or ["The device cannot be found out."])[-1])
    return asked.stdout.strip()
