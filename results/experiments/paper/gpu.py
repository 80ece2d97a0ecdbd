"""What the runs on a GPU were trained with: ``python gpu.py ARM OUT``, a process for each of the four arms.

All of them at once, under CUDA's MPS, with XLA_PYTHON_CLIENT_MEM_FRACTION=.2 and
XLA_FLAGS="--xla_gpu_autotune_level=0 --xla_gpu_enable_triton_gemm=false"; broken off when the time was over. For 65
seconds a busy loop ran on each idle processor beside them.
"""

import sys
from pathlib import Path

from senior import program
from senior.sweep import grid

OWN = {"task": ["handle-press"], "preset": ["paper"], "steps": ["500000"], "device": ["gpu"], "seed": list("01234")}

if __name__ == "__main__":
    arm, out = sys.argv[1:]
    cells = grid.cells_of({**OWN, "arm": [arm], "checkpoint-every": ["500000"]}, Path(out))
    program.train_all([(cell.config, cell.path) for cell in cells], workers=3)
