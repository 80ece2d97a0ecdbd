"""Gaussian kernel density estimates (Eq. 4). Both halves of SENIOR stand on this file.

The kernel is the proper ``d``-dimensional one, so densities have the unit length^-d. A common factor changes
neither the ranking by motion score nor the min-max of the bonus.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def log_density(
    points: Float[Array, "n d"], samples: Float[Array, "m d"], bandwidth: Float[Array, ""] | float
) -> Float[Array, " n"]:
    """log f_S(p) of every point, with S the samples. Finite however far the points lie from the samples."""
    d = points.shape[-1]
    distance = jnp.sum((points[:, None, :] - samples[None, :, :]) ** 2, axis=-1)
    exponent = -0.5 * distance / bandwidth**2
    norm = jnp.log(samples.shape[0]) + d * (jnp.log(bandwidth) + 0.5 * jnp.log(2 * jnp.pi))
    # At least one term is 1. XLA may compute the exponent twice and round it differently, which far from all samples
    # leaves 0 or infinity instead; hence no ready-made logsumexp.
    largest = exponent.max(axis=-1, keepdims=True)
    total = jnp.exp(jnp.minimum(exponent - largest, 0)).sum(axis=-1)
    return largest[..., 0] + jnp.log(jnp.maximum(total, 1)) - norm


def own_log_density(segments: Float[Array, "s H d"], bandwidth: Float[Array, ""] | float) -> Float[Array, "s H"]:
    """log f_sigma(p_t) of every step of every segment, with the segment's own positions as samples."""
    return jax.vmap(lambda positions: log_density(positions, positions, bandwidth))(segments)
