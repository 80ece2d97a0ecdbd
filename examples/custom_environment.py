"""Train on an environment of your own: a planar arm with two joints that is to touch a target.

    python examples/custom_environment.py

takes half a minute, enough to see that everything fits together and too short to learn the task. At full length, from
the command line in the directory of this file:

    senior train --env custom_environment:Arm --position 0:2 --horizon 50 --segment 25 --preset quick --out runs/arm
"""

from dataclasses import replace

import gymnasium
import numpy as np

from senior import evaluate_run, preset, train


class Arm(gymnasium.Env):
    """Two links of 1 m. Observed: hand [2], way to the target [2], joints [2]. Acted: speeds of both joints."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (6,), np.float32)
    action_space = gymnasium.spaces.Box(-0.2, 0.2, (2,), np.float32)  # rad per step; the library itself acts in [-1, 1]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)  # all that is random comes from self.np_random, so that runs can be resumed
        self.joints = self.np_random.uniform(-1, 1, 2)
        angle, radius = self.np_random.uniform(-np.pi, np.pi), self.np_random.uniform(0.5, 1.8)
        self.target = radius * np.array([np.cos(angle), np.sin(angle)])
        return self.observe(), {}

    def step(self, action):
        self.joints += action
        distance = np.linalg.norm(self.target - self.hand())
        # The reward stands in for the person who answers, and is what evaluations report.
        return self.observe(), float(np.exp(-distance)), False, False, {"success": distance < 0.1}

    def hand(self):
        first, second = self.joints[0], self.joints.sum()
        return np.array([np.cos(first) + np.cos(second), np.sin(first) + np.sin(second)])

    def observe(self):
        return np.concatenate([self.hand(), self.target - self.hand(), self.joints]).astype(np.float32)


if __name__ == "__main__":
    config = preset("quick", "arm", "m-senior")
    config = replace(
        config,
        env="custom_environment:Arm",
        position="0:2",  # where the hand is in the observation: SENIOR asks and explores by it
        horizon=50,  # steps of an episode
        steps=1200,
        pretraining=replace(config.pretraining, random_steps=200, until=500),
        queries=replace(config.queries, budget=40, per_session=20, every=500, segment=25),
        pge=replace(config.pge, every=500),
    )
    (result,) = train(config, out="runs/arm")
    print(f"{result.path}: {result.labels} labels, {evaluate_run(result.path, episodes=10)}")
