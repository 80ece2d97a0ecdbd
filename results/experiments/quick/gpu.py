"""What the 38 runs on the GPU were trained with: ``python gpu.py PROGRAM OUT``, a process for each of five programs.

All of them at once, under CUDA's MPS, with XLA_PYTHON_CLIENT_MEM_FRACTION=.14 and
XLA_FLAGS="--xla_gpu_autotune_level=0 --xla_gpu_enable_triton_gemm=false"; broken off after 440 seconds.
"""

import sys
from pathlib import Path

from senior import program
from senior.sweep import grid

WITHOUT_MDS, WITHOUT_PGE = "m-senior --select disagreement", "m-senior --explore none --mix uniform"
PROGRAMS: dict[str, tuple[int, list[tuple[list[str], str]]]] = {  # processes for environments; arms and their seeds
    "a": (4, [(["m-senior", "p-senior"], "34"), ([WITHOUT_MDS], "234")]),
    "b": (5, [(["m-senior", "p-senior", WITHOUT_MDS], "567")]),
    "c": (4, [(["mrn", "pebble"], "34"), ([WITHOUT_PGE], "234")]),
    "d": (5, [(["mrn", "pebble", WITHOUT_PGE], "567")]),
    "e": (3, [(["m-senior --compat release"], "234567")]),
}
SHARED = {"task": ["door-close"], "preset": ["quick"], "steps": ["100000"], "device": ["gpu"]}

if __name__ == "__main__":
    workers, parts = PROGRAMS[sys.argv[1]]
    grids = [{**SHARED, "checkpoint-every": ["100000"], "arm": arms, "seed": list(seeds)} for arms, seeds in parts]
    cells = [cell for own in grids for cell in grid.cells_of(own, Path(sys.argv[2]))]
    program.train_all([(cell.config, cell.path) for cell in cells], workers=workers)
