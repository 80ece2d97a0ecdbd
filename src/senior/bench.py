"""How fast the main phase of a method runs, and where its time goes, measured on the real loop.

Beside the update stands its floor: the operations of its matrix products over the best rate of such a product,
measured in the same minute. A machine's noise is in every figure; compare ratios of one run.
"""

from __future__ import annotations

import json
import resource
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from senior import program, protocol, rundir, session
from senior.checks import check
from senior.config import Config, Pretraining
from senior.device import prepare_device
from senior.fit import spec_of
from senior.learner import Learner
from senior.loop import Training
from senior.methods import METHODS
from senior.presets import preset
from senior.runs import Runs, lift_for
from senior.together import Pools
from senior.trainee import Trainee
from senior.types import BadInput, EnvSpec

PARTS = ("act", "environment", "update", "store")
WARM_UP = 100
PRETRAINING = 300  # its last steps, which are the slowest


@dataclass
class Window:
    """A watcher that notes the time at the beginning and the end of three windows: of pre-training, and two of the
    main phase, the second with waiting."""

    training: Training | None
    pretraining: tuple[int, int]
    warm: int
    length: int
    stop: bool = False

    def __post_init__(self) -> None:
        self.marks: dict[int, float] = {}

    def advance(self, step: int, trainees: Sequence[Trainee]) -> None:
        assert self.training is not None
        start = self.warm
        if step in self.pretraining:
            self.training.wait()
            self.marks[step] = time.perf_counter()
        if step in (start, start + self.length, start + 2 * self.length):
            self.training.wait()
            self.marks[step] = time.perf_counter()
            self.training.waits = step == start + self.length
            if self.training.waits:
                self.training.clock.spent.clear()

    def say(self, sentence: str) -> None:
        print(sentence, file=sys.stderr)


def multiply_adds(config: Config, learner: Learner) -> float:
    """Floating-point operations of the matrix products of one SAC update.

    Forward counts 1, the backward pass of parameters and of inputs 1 each: the actor once forward on s' and once
    forward and back on s; both targets forward; both critics forward and back on (s, a), and forward and back to
    the action only.
    """

    def weights(size_in: int, size_out: int) -> int:
        sizes = [size_in, *[config.networks.width] * config.networks.layers, size_out]
        return sum(i * o for i, o in pairwise(sizes))

    o, a = learner.spec.observation_size, learner.spec.action_size
    actor, critic = weights(o, 2 * a), weights(o + a, 1)
    return 2 * config.sac.batch * (actor * (1 + 3) + 2 * critic * (1 + 3 + 2)) * config.sac.updates


def product_rate(size: int) -> float:
    """Operations per second of ``[4096, size] @ [size, size]``: the best of twenty by XLA and of twenty by NumPy."""
    x, w = np.ones((4096, size), np.float32), np.ones((size, size), np.float32)
    compiled = jax.jit(jnp.matmul)
    on_device = jax.device_put((x, w))
    best = float("inf")
    for product in (lambda: compiled(*on_device).block_until_ready(), lambda: x @ w):
        product()
        for _ in range(20):
            began = time.perf_counter()
            product()
            best = min(best, time.perf_counter() - began)
    return 2 * 4096 * size * size / best


def hastened(config: Config) -> Config:
    """A million steps with a short pre-training, and nothing written on the way."""
    pretraining = Pretraining(random_steps=1000, until=2000) if config.method.learns_reward else config.pretraining
    return check(
        replace(
            config,
            pretraining=pretraining,
            steps=1_000_000,
            evaluation=replace(config.evaluation, every=10**9),
            checkpoint_every=10**9,
            snapshot_every=10**9,
        )
    )


def measure(config: Config, runs: int, device: str, length: int, out: Path, pools: Pools) -> dict[str, Any]:
    """Figures of one method; ``length`` main-phase steps are timed twice, with and without waiting per part."""
    config = hastened(config)
    learns = config.method.learns_reward
    start = max(config.pretraining.until, config.pretraining.random_steps) + WARM_UP
    began = time.perf_counter()
    spec = spec_of(config)
    learner = program.make_learner(config, spec)
    trainees = [
        Trainee(replace(config, seed=i), out / f"seed-{i}", learner, spec, pools.worker(learner)) for i in range(runs)
    ]
    for trainee in trainees:
        trainee.reset(0)
        trainee.directory.create(trainee.config, {})
    late = config.pretraining.until
    window = Window(None, (late - PRETRAINING, late - 1), start, length)
    states = Runs([trainee.begin() for trainee in trainees], lift_for(device))
    window.training = training = Training(trainees, states, window)
    training.last = start + 2 * length
    training.train()
    training.wait()

    first, middle = window.marks[start], window.marks[start + length]
    steps = length * runs
    figures: dict[str, Any] = {
        "method": config.method.name,
        "preset": config.preset,
        "runs": runs,
        "steps_per_second": steps / (middle - first),
        "milliseconds": {part: 1e3 * training.clock.spent[part] / steps for part in PARTS},
        "to_main_phase_seconds": first - began,
    }
    rate = product_rate(config.networks.width)
    figures["update_floor_ms"] = 1e3 * multiply_adds(config, learner) / rate
    figures["product_gflops"] = rate / 1e9
    if learns:
        began, ended = (window.marks[at] for at in window.pretraining)
        figures["pretraining_steps_per_second"] = (PRETRAINING - 1) * runs / (ended - began)
        n, step = config.queries.per_session, training.last
        spent = []
        for i in range(2):
            began = time.perf_counter()
            session.ask(trainees[0], states, 0, step + i, n, _silent)
            session.listen(trainees[0])
            session.learn(trainees[0], states, 0, step + i, _silent)
            training.wait()
            spent.append(time.perf_counter() - began)
        figures["session_seconds"] = spent[-1]
        figures["relabel_seconds"] = _relabel_all(training, learner)
    figures["resident_gigabytes"] = _peak_gigabytes()
    for trainee in trainees:
        trainee.close()
    return figures


def _silent(kind: str, sentence: str | None) -> None:
    """Hears the warnings of a measured session."""


def _relabel_all(training: Training, learner: Learner) -> float:
    """Seconds to relabel a full replay: as many rows as the run has steps, whatever they hold."""
    runs = training.runs
    state = runs[0]
    full = state.replay._replace(count=jnp.int32(state.replay.capacity))
    runs[0] = state._replace(replay=full)
    del state, full
    spent = 0.0
    for _ in range(2):
        began = time.perf_counter()
        runs.one(0, learner.relabel)
        training.wait()
        spent = time.perf_counter() - began
    return spent


def _peak_gigabytes() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**30 if sys.platform == "darwin" else 2**20)


def run(
    method: str,
    preset_name: str,
    task: str,
    steps: int,
    runs: Sequence[int],
    device: str,
    precision: Literal["float32", "bfloat16"],
    json_file: Path | None,
) -> None:
    """`senior bench`: print the figures of one method or of all, and keep them as JSON where asked."""
    if steps < 1 or min(runs, default=0) < 1:
        raise BadInput("--steps and --runs must be at least 1.")
    if method != "all" and method not in METHODS:
        raise BadInput.unknown("method", method, METHODS)
    if json_file:
        rundir.make_room(json_file)
    names = list(METHODS) if method == "all" else [method]
    configs = [replace(preset(preset_name, task, name), precision=precision) for name in names]
    device = prepare_device(device)
    machine = _machine(spec_of(configs[0]), device)
    print(
        f"{machine['device']}, {machine['threads']} threads, {machine['machine']}; {task}, {preset_name}, {precision}"
    )
    print(
        f"{'method':10} {'runs':>4} {'steps/s':>8} | {'act':>6} {'env':>6} {'update':>7} {'(floor)':>7} {'store':>6} "
        f"ms | {'pretraining':>11} /s | {'session':>8} {'relabel':>8} s | {'to start':>8} s | {'memory':>7} GB"
    )
    found = []
    for config, count in ((config, count) for config in configs for count in runs):
        with tempfile.TemporaryDirectory() as folder, Pools(None, device) as pools:
            figures = measure(config, count, device, steps, Path(folder), pools)
        found.append(figures)
        missing = float("nan")
        ms = figures["milliseconds"]
        print(
            f"{figures['method']:10} {count:4} {figures['steps_per_second']:8.1f} | {ms['act']:6.2f} "
            f"{ms['environment']:6.2f} {ms['update']:7.2f} {figures['update_floor_ms']:7.2f} {ms['store']:6.2f}    "
            f"| {figures.get('pretraining_steps_per_second', missing):11.1f}    "
            f"| {figures.get('session_seconds', missing):8.2f} {figures.get('relabel_seconds', missing):8.2f}   "
            f"| {figures['to_main_phase_seconds']:8.1f}   | {figures['resident_gigabytes']:7.2f}",
            flush=True,
        )
    print(
        "steps/s: of all runs together; milliseconds: per step of one run; memory: the process's peak so far; relabel: "
        "a full replay of a million rows; floor: see benchmarks/README.md"
    )
    _keep(json_file, {"machine": machine, "task": task, "precision": precision, "figures": found})


def run_environments(task: str, count: int, json_file: Path | None) -> None:
    """`senior bench --environments N`: environments alone."""
    from senior import bench_environments

    if count < 1:
        raise BadInput("--environments must be at least 1.")
    if json_file:
        rundir.make_room(json_file)
    figures = bench_environments.run(task, count)
    _keep(json_file, {"machine": _machine(spec_of(preset("paper", task, "sac")), "cpu"), "figures": figures})


def _machine(spec: EnvSpec, device: str) -> dict[str, Any]:
    return {key: protocol.of(spec, device)[key] for key in ("device", "threads", "machine", "packages")}


def _keep(json_file: Path | None, found: dict[str, Any]) -> None:
    if json_file:
        json_file.write_text(json.dumps(found, indent=2) + "\n")
