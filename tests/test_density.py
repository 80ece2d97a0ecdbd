"""Kernel density estimates held to their formula."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from senior.density import log_density, own_log_density

density = jax.jit(log_density)


def by_hand(points: np.ndarray, samples: np.ndarray, h: float) -> np.ndarray:
    """f_S(p) = 1/n sum_i N(p; p_i, h^2 I), one kernel at a time."""
    d = points.shape[1]
    f = []
    for p in points.astype(np.float64):
        kernels = [np.exp(-0.5 * np.sum(((p - s) / h) ** 2)) for s in samples.astype(np.float64)]
        f.append(np.mean(kernels) / (h * np.sqrt(2 * np.pi)) ** d)
    return np.array(f)


@pytest.mark.parametrize("d", [1, 2, 3])
@pytest.mark.parametrize("h", [0.05, 0.7])
def test_the_density_is_the_mean_of_gaussian_kernels(d: int, h: float):
    rng = np.random.default_rng(d)
    points, samples = (0.2 * rng.normal(size=(n, d)).astype(np.float32) for n in (9, 14))
    expected = by_hand(points, samples, h)
    clear = expected > 1e-30
    assert clear.sum() > 5
    np.testing.assert_allclose(np.exp(density(points, samples, h))[clear], expected[clear], rtol=1e-3)


def test_a_segments_own_density_takes_its_own_positions_as_samples():
    segments = 0.1 * np.random.default_rng(0).normal(size=(4, 6, 3)).astype(np.float32)
    expected = np.stack([by_hand(segment, segment, 0.05) for segment in segments])
    np.testing.assert_allclose(np.exp(own_log_density(segments, 0.05)), expected, rtol=1e-4)


@pytest.mark.parametrize("h", [0.1, 1.0])
def test_the_density_integrates_to_one(h: float):
    samples = np.array([[-1.0], [0.3], [0.5]], np.float32)
    grid = np.linspace(-9, 9, 20_001, dtype=np.float32)[:, None]
    mass = np.sum(np.exp(np.asarray(density(grid, samples, h), np.float64))) * 18 / 20_000
    np.testing.assert_allclose(mass, 1, rtol=1e-4)


@pytest.mark.parametrize("apart", [1.0, 10.0, 1000.0, 1e6])
def test_the_logarithm_is_finite_and_right_for_clouds_far_apart(apart: float):
    """At h = .01 and ten metres apart the density itself is exp(-1,500,000): no float holds it."""
    rng = np.random.default_rng(0)
    points, samples = rng.normal(0, 0.02, (40, 3)), apart + rng.normal(0, 0.02, (40, 3))
    points, samples = points.astype(np.float32), samples.astype(np.float32)
    exponent = -0.5 * np.sum((points[:, None].astype(np.float64) - samples) ** 2, axis=-1) / 0.01**2
    largest = exponent.max(axis=1)
    total = np.exp(exponent - largest[:, None]).sum(axis=1)
    expected = largest + np.log(total / 40) - 3 * np.log(0.01 * np.sqrt(2 * np.pi))
    for found in (density(points, samples, 0.01), log_density(points, samples, 0.01)):
        np.testing.assert_allclose(found, expected, rtol=1e-5)
