"""The update of soft actor-critic at the paper's sizes in PyTorch, to hold `senior bench` against in the same minutes.

The established implementations of this family are written in PyTorch; most of a step of theirs is this update. Here it
is alone, without replay, logging or environment: separate networks, three Adams, targets moved at every second step.
It needs only torch (``pip install torch``) and prints milliseconds per update, the median of several blocks:

    python benchmarks/pytorch_sac.py [--threads 2] [--updates 50] [--blocks 9]
"""

from __future__ import annotations

import argparse
import copy
import itertools
import math
import statistics
import time

import torch
from torch import nn

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
    spent = []
    for block in range(options.blocks + 1):  # the first warms up
        began = time.perf_counter()
        for step in range(options.updates):
            drawn = torch.randint(rows, (BATCH,))
            agent.update(step, *(column[drawn] for column in columns))
        if block:
            spent.append(1e3 * (time.perf_counter() - began) / options.updates)
    print(
        f"PyTorch {torch.__version__}, {options.threads} threads: {statistics.median(spent):.2f} ms per update "
        f"(blocks of {options.updates}: {min(spent):.2f} to {max(spent):.2f})"
    )


if __name__ == "__main__":
    main()
