"""The policy that a run leaves: without JAX it acts as it did in training."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

import senior
from senior.agent import sac
from senior.rundir import RunDirectory
from senior.trainee import policy_arrays
from senior.types import BadInput


@pytest.mark.parametrize("layers", [1, 3])
def test_it_acts_as_the_learner_does(layers: int, tmp_path: Path):
    agent = sac.init(jax.random.key(0), 39, 4, layers, 64, 0.1)
    run: Any = SimpleNamespace(agent=agent)
    RunDirectory(tmp_path).save_policy({**policy_arrays(run), "step": np.asarray(7)})
    policy = senior.load_policy(tmp_path)
    assert (policy.step, len(policy.weights)) == (7, layers + 1)
    observation = np.random.default_rng(0).normal(size=(5, 39))
    expected = np.asarray(sac.mean_action(agent.actor, observation.astype(np.float32)))
    found = policy(observation)
    assert (found.shape, found.dtype) == ((5, 4), np.float32)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    np.testing.assert_allclose(policy(observation[2]), expected[2], atol=1e-5)
    assert np.abs(expected).max() > 0.01


def test_where_there_is_none_it_is_told(tmp_path: Path):
    with pytest.raises(BadInput, match=f"^{re.escape(str(tmp_path))} holds no policy yet"):
        senior.load_policy(tmp_path)
