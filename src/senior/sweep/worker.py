"""The process that trains a sweep's cells: takes a job per line, answers with its outcomes, until the pipe ends.

Started by `senior.sweep.local` as ``python -m senior.sweep.worker ORDERS ANSWERS THREADS``; a Ray worker calls `train`
itself. SIGTERM, or the end of its orders while it trains, stops it with everything saved.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Sequence
from queue import SimpleQueue
from typing import Any

from senior.sweep.cells import Job, Outcome, job_of, report
from senior.sweep.cores import take_cores
from senior.types import BadInput


class Watch:
    """Looks on while cells are trained. What is said goes to the worker's log."""

    def __init__(self) -> None:
        self.stop = False

    def advance(self, step: int, trainees: Sequence[Any]) -> None:
        pass

    def say(self, sentence: str) -> None:
        print(sentence, file=sys.stderr, flush=True)


def train(job: Job, watch: Watch) -> tuple[Outcome, ...]:
    """Train the cells of a job, each from its newest checkpoint if it has one."""
    from senior import program  # starts JAX, which counts the processors then

    try:
        results = program.continue_all([(cell.config, cell.path) for cell in job], watch)
    except BadInput as error:
        return (Outcome(False, str(error)),) * len(job)
    return tuple(Outcome(result.finished, result.failure) for result in results)


def main(orders: int, answers: int, threads: int) -> None:
    """Serve until the pipe of orders ends or somebody says stop."""
    take_cores(threads)
    watch = Watch()
    jobs: SimpleQueue[Job | None] = SimpleQueue()

    def stop(*_: object) -> None:
        watch.stop = True
        jobs.put(None)

    def listen() -> None:
        with open(orders) as lines:
            for line in lines:
                jobs.put(job_of(line))
        stop()

    signal.signal(signal.SIGTERM, stop)
    threading.Thread(target=listen, daemon=True).start()
    while (job := jobs.get()) is not None:
        os.write(answers, f"{report(train(job, watch))}\n".encode())


if __name__ == "__main__":
    main(*map(int, sys.argv[1:4]))
