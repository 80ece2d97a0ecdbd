"""The device that runs are computed on, made ready, and how much memory it has."""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import sys
from functools import lru_cache
from pathlib import Path

import jax

from senior.types import BadInput


def prepare_device(wanted: str) -> str:
    """Choose where to compute, switch the compilation cache on, and have a GPU multiply in float32; returns ``cpu`` or
    ``gpu``.

    Raises `BadInput` if a GPU is asked for and there is none.
    """
    _avoid_hang()
    _keep_memory()
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "senior" / "xla"
    if jax.config.jax_compilation_cache_dir is None:  # pyright: ignore[reportAttributeAccessIssue]
        jax.config.update("jax_compilation_cache_dir", str(cache))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    if wanted == "cpu":
        jax.config.update("jax_platforms", "cpu")
        return "cpu"
    found = jax.default_backend()
    if wanted == "gpu" and found != "gpu":
        raise BadInput("--device gpu: JAX finds no GPU here; install the extra senior-rl[gpu] or use --device cpu.")
    if found != "gpu":
        return "cpu"
    # products of float32 are rounded to TensorFloat-32 otherwise, of ten bits, and results/precision has what eight do
    jax.config.update("jax_default_matmul_precision", "float32")
    return "gpu"


def _avoid_hang() -> None:
    """Split no single operation over XLA's CPU threads; independent operations still run side by side.

    The thread pool that does the splitting can wait for itself for ever (seen here in a fit of the reward
    ensemble with jaxlib 0.10.2, all threads asleep; CONTRIBUTING.md). XLA reads this when it starts.
    """
    flag = "--xla_cpu_multi_thread_eigen"
    flags = os.environ.get("XLA_FLAGS", "")
    if flag not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {flag}=false".strip()


@lru_cache(maxsize=1)  # mallopt is not meant to be called beside other threads again and again
def _keep_memory() -> None:
    """Let glibc keep the memory that every update takes and frees, instead of fetching it from the system anew.

    An update of the paper's sizes takes 18 MB for its results and in between, which was a thousand page faults and
    1 ms of 15 (benchmarks/README.md). The numbers are mallopt's: take up to 32 MB, its largest, from the heap; give
    back what exceeds 1 GB; grow by 64 MB. Where the C library has no mallopt (macOS) nothing happens.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        for parameter, value in ((-3, 2**25), (-1, 2**30), (-2, 2**26)):  # MMAP_THRESHOLD, TRIM_THRESHOLD, TOP_PAD
            mallopt(parameter, value)


def device_memory(device: str) -> float:
    """Bytes of memory there are: what XLA may take of the GPU's, or what of the machine's is free and allowed."""
    if device == "gpu":
        return float(jax.devices()[0].memory_stats()["bytes_limit"])
    found = [float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))]
    with contextlib.suppress(OSError):  # Linux
        found += [1024.0 * int(n) for n in re.findall(r"MemAvailable:\s*(\d+) kB", Path("/proc/meminfo").read_text())]
    with contextlib.suppress(OSError):  # a container's limit
        found += [float(n) for n in re.findall(r"\d+", Path("/sys/fs/cgroup/memory.max").read_text())]
    return min(found)
