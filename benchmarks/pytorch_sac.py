"""Soft actor-critic at the paper's sizes in PyTorch, to hold `senior bench` against in the same minutes.

The established implementations of this family are written in PyTorch. First the update alone, most of a step of theirs:
separate networks, three Adams, targets moved at every second step. Then the step of such a loop, without logging and
sessions: act, score with the three members of a reward ensemble, step door-lock, store in NumPy, draw a batch, update.
It needs torch beside this package (``pip install torch``) and prints milliseconds, the median of several blocks:

    python benchmarks/pytorch_sac.py [--threads 2] [--updates 50] [--blocks 9]
"""

from __future__ import annotations

import argparse
import copy
import itertools
import math
import statistics
import time

import numpy as np
import torch
from torch import nn

from senior.envs import metaworld

OBSERVATION, ACTION, WIDTH, LAYERS, BATCH = 39, 4, 256, 3, 512
RATE, ALPHA_RATE, DISCOUNT, TAU, TARGET_EVERY = 3e-4, 1e-4, 0.99, 0.005, 2
LOW, HIGH = -5.0, 2.0


def perceptron(size_in: int, size_out: int) -> nn.Sequential:
    sizes = [size_in, *[WIDTH] * LAYERS]
    layers: list[nn.Module] = []
    for i, o in itertools.pairwise(sizes):
        layers += [nn.Linear(i, o), nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(WIDTH, size_out))


class Agent:
    """Actor, two critics, their targets, the temperature, and an optimiser for each."""

    def __init__(self) -> None:
        self.actor = perceptron(OBSERVATION, 2 * ACTION)
        self.critics = nn.ModuleList([perceptron(OBSERVATION + ACTION, 1) for _ in range(2)])
        self.targets = copy.deepcopy(self.critics).requires_grad_(False)
        self.log_alpha = torch.tensor(math.log(0.1), requires_grad=True)
        self.of_actor = torch.optim.Adam(self.actor.parameters(), RATE)
        self.of_critics = torch.optim.Adam(self.critics.parameters(), RATE)
        self.of_alpha = torch.optim.Adam([self.log_alpha], ALPHA_RATE)

    def sample(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """A squashed Gaussian action and its log probability."""
        mean, raw = self.actor(observation).chunk(2, dim=-1)
        log_std = LOW + 0.5 * (HIGH - LOW) * (torch.tanh(raw) + 1)
        noise = torch.randn_like(mean)
        u = mean + log_std.exp() * noise
        squash = 2 * (math.log(2) - u - nn.functional.softplus(-2 * u))
        log_prob = -0.5 * noise**2 - log_std - 0.5 * math.log(2 * math.pi) - squash
        return torch.tanh(u), log_prob.sum(dim=-1)

    def values(self, critics: nn.ModuleList, observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        x = torch.cat([observation, action], dim=-1)
        return torch.stack([critic(x).squeeze(-1) for critic in critics])

    def update(self, step: int, s: torch.Tensor, a: torch.Tensor, r: torch.Tensor, following: torch.Tensor) -> None:
        with torch.no_grad():
            action, log_prob = self.sample(following)
            value = self.values(self.targets, following, action).amin(0) - self.log_alpha.exp() * log_prob
            target = r + DISCOUNT * value
        loss = (self.values(self.critics, s, a) - target).square().mean(dim=1).sum()
        self.of_critics.zero_grad()
        loss.backward()
        self.of_critics.step()

        action, log_prob = self.sample(s)
        loss = (self.log_alpha.exp().detach() * log_prob - self.values(self.critics, s, action).amin(0)).mean()
        self.of_actor.zero_grad()
        loss.backward()
        self.of_actor.step()

        self.of_alpha.zero_grad()
        (self.log_alpha.exp() * (-log_prob.detach() + ACTION).mean()).backward()
        self.of_alpha.step()

        if step % TARGET_EVERY == 0:
            with torch.no_grad():
                for slow, fast in zip(self.targets.parameters(), self.critics.parameters(), strict=True):
                    slow.lerp_(fast, TAU)


class Loop:
    """A training loop around an agent, with what is rare left out."""

    def __init__(self, agent: Agent, rows: int) -> None:
        self.agent = agent
        self.members = [nn.Sequential(perceptron(OBSERVATION + ACTION, 1), nn.Tanh()) for _ in range(3)]
        self.env, _ = metaworld.make("door-lock")
        self.observation = self.env.reset(seed=0)[0].astype(np.float32)
        rng = np.random.default_rng(0)
        sizes = (OBSERVATION, ACTION, OBSERVATION)
        self.vectors = [rng.normal(size=(rows, size)).astype(np.float32) for size in sizes]
        self.rewards = rng.normal(size=rows).astype(np.float32)
        self.rng, self.count = rng, 0

    def step(self, number: int) -> None:
        s = self.observation
        with torch.no_grad():
            action = self.agent.sample(torch.from_numpy(s)[None])[0][0].numpy()
            x = torch.from_numpy(np.concatenate([s, action]))[None]
            learned = np.mean([member(x).item() for member in self.members])
        drawn = self.rng.integers(len(self.rewards), size=BATCH)
        before, acted, after = (torch.as_tensor(column[drawn]) for column in self.vectors)
        self.agent.update(number, before, acted, torch.as_tensor(self.rewards[drawn]), after)
        following, _, _, truncated, _ = self.env.step(action)
        row = self.count % len(self.rewards)
        for column, value in zip(self.vectors, (s, action, following), strict=True):
            column[row] = value
        self.rewards[row] = learned
        self.count += 1
        self.observation = (self.env.reset()[0] if truncated else following).astype(np.float32)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--updates", type=int, default=50)
    parser.add_argument("--blocks", type=int, default=9)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    agent = Agent()
    rows = 100_000
    columns = (
        torch.randn(rows, OBSERVATION),
        torch.rand(rows, ACTION) * 2 - 1,
        torch.randn(rows),
        torch.randn(rows, OBSERVATION),
    )

    def update(step: int) -> None:
        drawn = torch.randint(rows, (BATCH,))
        agent.update(step, *(column[drawn] for column in columns))

    print(f"PyTorch {torch.__version__}, {options.threads} threads, blocks of {options.updates}")
    for name, function in (("update", update), ("step of the loop", Loop(agent, 1_000_000).step)):
        spent = []
        for block in range(options.blocks + 1):  # the first warms up
            began = time.perf_counter()
            for step in range(options.updates):
                function(step)
            if block:
                spent.append(1e3 * (time.perf_counter() - began) / options.updates)
        print(f"{name}: {statistics.median(spent):.2f} ms ({min(spent):.2f} to {max(spent):.2f})")


if __name__ == "__main__":
    main()
