"""What a test process needs before JAX is imported: the CPU, a core of its own, a store of compiled code."""

import gc
import os
import sys
import time
from pathlib import Path

import pytest

# Workers, checkouts and later runs share it; JAX's keys tell versions and machines apart.
COMPILED = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "senior-rl" / "tests"
KEPT_SECONDS = 14 * 24 * 3600
WORKER = os.environ.get("PYTEST_XDIST_WORKER")

os.environ["JAX_PLATFORMS"] = "cpu"
os.environ["JAX_COMPILATION_CACHE_DIR"] = str(COMPILED)
# Operations are not split over threads, as senior.device.prepare_device sets it, and why. In tests only, machine code
# is not optimised: most of a first run of the suite is compiling.
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false --xla_backend_optimization_level=0"
os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.2"

# Two workers with a thread for each core would only wait for each other.
if WORKER and sys.platform == "linux":
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {cores[int(WORKER.removeprefix("gw")) % len(cores)]})


def pytest_configure(config: pytest.Config) -> None:
    # An entry that another worker is still writing, or a killed run left half-written, is compiled again.
    config.addinivalue_line("filterwarnings", "ignore:Error (reading|writing) persistent compilation cache")


@pytest.fixture(scope="module", autouse=True)
def _forget_compiled():
    """Let go of a module's programs: XLA crashed in workers that held hundreds of them (CONTRIBUTING.md)."""
    yield
    import jax

    jax.clear_caches()
    gc.collect()


def pytest_sessionstart() -> None:
    if WORKER is None:
        for entry in COMPILED.glob("*-cache"):
            if time.time() - entry.stat().st_mtime > KEPT_SECONDS:
                entry.unlink(missing_ok=True)
