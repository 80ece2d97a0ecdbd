"""Sweeps on a Ray cluster: two nodes on this machine, a token, a worker that is killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from senior.cli import main
from senior.cli.shared import DONE
from senior.types import BAD_INPUT
from tests.cluster import Cluster, two_nodes
from tests.equal import OPTIONS, assert_same_run
from tests.test_sweep import worker_of

SWEEP = ["sweep", *OPTIONS, "--seed", "0", "1", "2"]


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    with two_nodes() as found:
        yield found


def begin(cluster: Cluster, out: Path, **more: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "senior.cli", *SWEEP, "--out", str(out), "--ray", cluster.address]
    environment = {**cluster.environment, **more}
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_a_cluster_finishes_all_cells_though_a_worker_is_killed(cluster: Cluster, tmp_path: Path):
    undisturbed = tmp_path / "undisturbed"
    assert main([*SWEEP, "--jobs", "2", "--out", str(undisturbed)]) == DONE
    out = tmp_path / "out"
    killed = out / "point" / "m-senior" / "seed-0"
    with begin(cluster, out) as sweep:
        os.kill(worker_of(killed, 450), signal.SIGKILL)
        told, complained = sweep.communicate(timeout=300)
    assert sweep.returncode == DONE, complained
    assert "its worker was lost" in complained and "3 of 3 cells are finished" in told
    for seed in range(3):
        run = killed.with_name(f"seed-{seed}")
        assert_same_run(run, undisturbed / "point" / "m-senior" / run.name, interrupted=seed == 0)
    assert not list(out.glob("sweep-*")), "what marks the shared folder is gone"


def hands(cluster: Cluster) -> set[int]:
    """The cluster's actors of sweeps."""
    token, found = cluster.environment["RAY_AUTH_TOKEN"].encode(), set()
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if (process / "cmdline").read_bytes().startswith(b"ray::Hand") and token in (
                process / "environ"
            ).read_bytes():
                found.add(int(process.name))
    return found


def test_actors_that_are_lost_idle_or_as_they_begin_cost_no_cell_a_try(cluster: Cluster, tmp_path: Path):
    command = [sys.executable, "-m", "senior.cli", "sweep", *OPTIONS, "--seed", "0", "--out", str(tmp_path)]
    with subprocess.Popen(
        [*command, "--ray", cluster.address],
        env=cluster.environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as sweep:
        busy = worker_of(tmp_path / "point" / "m-senior" / "seed-0", 450)
        first = hands(cluster)
        assert busy in first and len(first) == 2
        for lost in (*(first - {busy}), busy):
            os.kill(lost, signal.SIGKILL)
        while not (new := hands(cluster) - first):
            assert sweep.poll() is None
            time.sleep(0.01)
        os.kill(new.pop(), signal.SIGKILL)
        told, complained = sweep.communicate(timeout=300)
    assert sweep.returncode == DONE, complained
    assert complained.count("its worker was lost") == 1 and "1 of 1 cells are finished" in told


def test_interrupted_it_is_saved_on_all_nodes(cluster: Cluster, tmp_path: Path):
    with begin(cluster, tmp_path) as sweep:
        runs = [tmp_path / "point" / "m-senior" / f"seed-{seed}" for seed in (0, 1)]
        workers = [worker_of(run, 150) for run in runs]
        sweep.send_signal(signal.SIGINT)
        told, complained = sweep.communicate(timeout=300)
    assert "Interrupted, all saved" in told, complained
    assert len(set(workers)) == 2
    for run in runs:
        assert list((run / "checkpoints").glob("step-*.npz")), "saved before its first checkpoint was due, or after it"


def test_without_its_token_a_cluster_is_of_no_use(cluster: Cluster, tmp_path: Path):
    for environment, said in (
        ({"RAY_AUTH_TOKEN": "0" * 64}, "has another token"),
        ({"RAY_AUTH_TOKEN": "", "HOME": str(tmp_path)}, "The Ray cluster's token is neither in RAY_AUTH_TOKEN nor in"),
        ({"RAY_AUTH_MODE": "disabled"}, "only with a token"),
    ):
        with begin(cluster, tmp_path / "out", **environment) as sweep:
            _, complained = sweep.communicate(timeout=120)
        assert sweep.returncode == BAD_INPUT, complained
        assert said in complained.splitlines()[-1]
    assert not list(tmp_path.rglob("config.json"))


def test_an_address_where_nobody_listens_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("RAY_AUTH_TOKEN", "0" * 64)
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    assert main([*SWEEP, "--out", str(tmp_path / "never"), "--ray", "127.0.0.1:9"]) == BAD_INPUT
    assert "No Ray cluster answers at 127.0.0.1:9" in capsys.readouterr().err
