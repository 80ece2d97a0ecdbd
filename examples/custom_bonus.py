"""Pay for exploring in a way of your own: here, for being near the middle of what people have preferred so far.

    python examples/custom_bonus.py

takes half a minute, enough to see that everything fits together. A bonus is any class like `Nearness`: functions of
JAX arrays that are compiled, so its state keeps shapes and types, and what depends on numbers is computed, not branched
on. It is named as module:Name, on the command line too, in the directory of this file:

    senior train --task door-close --method pebble --explore custom_bonus:Nearness --out runs/nearness
"""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from senior import METHODS, preset, train


class Nearness:
    """0.1 exp(-distance to the mean preferred position), in the environment's own units, on every row of a batch."""

    def __init__(self, spec):
        self.position = spec.position  # where in an observation the position is
        self.size = spec.position_size

    def init(self):
        return jnp.zeros(self.size), jnp.zeros(())  # the middle, and the weight of the bonus: nothing is known yet

    def on_session(self, state, key, preferred, count):
        """Of preferred [n, d] the first count rows are positions of preferred segments; the rest is room."""
        held = (jnp.arange(len(preferred)) < count)[:, None]
        return (preferred * held).sum(axis=0) / jnp.maximum(count, 1), jnp.float32(0.1) * (count > 0)

    def on_refresh(self, state, key, replay, now):
        return state  # called every --refresh-every steps, for what looks at the whole replay

    def value(self, state, batch, now):
        return state[1] * self._nearness(state, batch)

    def report(self, state, batch, now):
        return {"beta": state[1], "intrinsic_mean": self._nearness(state, batch).mean()}

    def _nearness(self, state, batch):
        return jnp.exp(-jnp.linalg.norm(batch.observation[:, self.position] - state[0], axis=-1))


if __name__ == "__main__":
    config = preset("quick", "point", "pebble")
    config = replace(
        config,
        method=replace(METHODS["pebble"], explore="custom_bonus:Nearness"),
        steps=1200,
        pretraining=replace(config.pretraining, random_steps=200, until=500),
        queries=replace(config.queries, budget=40, per_session=20, every=500),
    )
    (result,) = train(config, out="runs/nearness")
    told = np.genfromtxt(result.path / "train.csv", delimiter=",", names=True)
    print(f"{result.path}: the bonus of the last update was {told['bonus_mean'][-1]:.3f} a row")
