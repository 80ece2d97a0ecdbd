"""A trained policy, for whoever lets it act: NumPy and nothing else."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from senior.files import Damaged, unpack
from senior.types import BadInput


@dataclass(frozen=True)
class Policy:
    """The actor of a run as it was saved at ``step``. What it does is its mean action, as in evaluations."""

    step: int
    weights: tuple[np.ndarray, ...]
    """Per layer [in, out], float32. The last one's first half gives the means."""
    biases: tuple[np.ndarray, ...]
    """Per layer [out], float32."""

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """The action [..., a] in [-1, 1], float32, for an observation [..., o] as the environment gives it.

        -1 and 1 are the bounds of the environment's actions: ``low + (action + 1) / 2 * (high - low)`` are its own.
        """
        x = np.asarray(observation, np.float32)
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = np.maximum(x @ weight + bias, 0)
        mean, _ = np.split(x @ self.weights[-1] + self.biases[-1], 2, axis=-1)
        return np.tanh(mean)


def load_policy(run: Path | str) -> Policy:
    """The policy of a run directory, as last saved; `BadInput` if it holds none, or none that can be read."""
    file = Path(run) / "policy" / "actor.npz"
    if not file.exists():
        raise BadInput(f"{run} holds no policy yet: the run has not reached its first checkpoint.")
    try:
        saved = unpack(file)
        layers = range(sum(name.startswith("weight_") for name in saved))
        weights, biases = (tuple(saved[f"{kind}_{i}"] for i in layers) for kind in ("weight", "bias"))
        return Policy(int(saved["step"]), weights, biases)
    except (Damaged, OSError, KeyError) as error:
        raise BadInput(f"The policy of {run} cannot be read: {error}.") from error
