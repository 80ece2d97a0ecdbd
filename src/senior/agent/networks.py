"""Multilayer perceptrons as plain pytrees of arrays, with the two initialisations that the field's results rest on."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

Tree = TypeVar("Tree")
Initialiser = Callable[[PRNGKeyArray, int, int], tuple[Array, Array]]
Activation = Callable[[Array], Array]
Product = Callable[[Array, Array], Array]


def normalised_relu(x: Float[Array, "*b n"]) -> Float[Array, "*b n"]:
    """ReLU of a layer brought to mean 0 and variance 1: layer normalisation (Ba et al. 2016) that learns nothing."""
    x = x - x.mean(axis=-1, keepdims=True)
    return jax.nn.relu(x * jax.lax.rsqrt(jnp.mean(x**2, axis=-1, keepdims=True) + 1e-5))


def _with_float32_sums(x: Float[Array, "b i"], w: Float[Array, "i o"]) -> Float[Array, "b o"]:
    return jax.lax.dot(x, w, preferred_element_type=jnp.float32)


@jax.custom_vjp
def bfloat16_product(x: Float[Array, "b i"], w: Float[Array, "i o"]) -> Float[Array, "b o"]:
    """``x @ w`` of float32, multiplied in bfloat16 and summed in float32; so are both products of its gradient.

    XLA's fast kernels for a CPU take a plain product only, so that the gradient's transposes are made before.
    """
    return _with_float32_sums(x.astype(jnp.bfloat16), w.astype(jnp.bfloat16))


def _forward(x: Array, w: Array) -> tuple[Array, tuple[Array, Array]]:
    x, w = x.astype(jnp.bfloat16), w.astype(jnp.bfloat16)
    return _with_float32_sums(x, w), (x, w)


def _backward(kept: tuple[Array, Array], gradient: Array) -> tuple[Array, Array]:
    x_transposed, w_transposed = (jax.lax.optimization_barrier(one.T) for one in kept)
    gradient = gradient.astype(jnp.bfloat16)
    return _with_float32_sums(gradient, w_transposed), _with_float32_sums(x_transposed, gradient)


bfloat16_product.defvjp(_forward, _backward)


class Arithmetic(NamedTuple):
    """How the networks of an update compute."""

    activation: Activation = jax.nn.relu  # of the critics' hidden layers; the actor's are ReLU
    product: Product = jnp.matmul  # of activations [b, i] and weights [i, o]


adam = optax.scale_by_adam(b1=0.9, b2=0.999, eps=1e-8)
"""Adam without its learning rate, which is a traced number of the run (see `descend`)."""


class MLP(NamedTuple):
    """Weights ``[in, out]`` and biases ``[out]`` per layer; an ensemble has one more axis in front of both."""

    weights: tuple[Array, ...]
    biases: tuple[Array, ...]


def orthogonal(key: PRNGKeyArray, size_in: int, size_out: int) -> tuple[Array, Array]:
    """Orthogonal weights with gain 1, zero biases: every layer of SAC in PEBBLE's line of work.

    Gram and Schmidt, each column twice for float32's sake, gives what a QR decomposition gives. JAX's QR is not used:
    on a CPU two at a time can wait for each other for ever (jaxlib 0.10.2; CONTRIBUTING.md).
    """
    drawn = jax.random.normal(key, (max(size_in, size_out), min(size_in, size_out)))

    def add_column(i: Array, done: Array) -> Array:
        column = drawn[:, i]
        for _ in range(2):
            column = column - done @ (done.T @ column)
        return done.at[:, i].set(column / jnp.linalg.norm(column))

    made = jax.lax.fori_loop(0, drawn.shape[1], add_column, jnp.zeros_like(drawn))
    return made.T if size_in < size_out else made, jnp.zeros(size_out)


def fan_in_uniform(key: PRNGKeyArray, size_in: int, size_out: int) -> tuple[Array, Array]:
    """Weights and biases uniform in +-1/sqrt(fan in): PyTorch's default linear layer, used by the reward models."""
    bound = size_in**-0.5
    draw = jax.random.uniform(key, (size_in + 1, size_out), minval=-bound, maxval=bound)
    return draw[:-1], draw[-1]


def init_mlp(key: PRNGKeyArray, size_in: int, layers: int, width: int, size_out: int, initialiser: Initialiser) -> MLP:
    """A perceptron with ``layers`` hidden layers of ``width`` units."""
    sizes = [size_in, *[width] * layers, size_out]
    keys = jax.random.split(key, len(sizes) - 1)
    made = [initialiser(k, i, o) for k, i, o in zip(keys, sizes[:-1], sizes[1:], strict=True)]
    return MLP(tuple(weight for weight, _ in made), tuple(bias for _, bias in made))


def apply_mlp(
    mlp: MLP, x: Float[Array, "*batch n"], activation: Activation, product: Product = jnp.matmul
) -> Float[Array, "*batch m"]:
    """Hidden layers with the activation, the last layer linear."""
    for weight, bias in zip(mlp.weights[:-1], mlp.biases[:-1], strict=True):
        x = activation(product(x, weight) + bias)
    return product(x, mlp.weights[-1]) + mlp.biases[-1]


def descend(
    parameters: Tree, gradient: Tree, state: optax.OptState, rate: Float[Array, ""] | float
) -> tuple[Tree, optax.OptState]:
    """One Adam step of that learning rate."""
    direction, state = adam.update(gradient, state)  # pyright: ignore[reportArgumentType]
    moved = jax.tree.map(lambda parameter, step: parameter - rate * step, parameters, direction)
    return moved, state
