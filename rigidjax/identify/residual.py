"""From errors to residuals of least squares: noise, saturation, losses, priors, joints."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rigidjax.identify.jacobian import all_errors
from rigidjax.identify.parameters import Parameters, by_slot
from rigidjax.identify.problem import Problem
from rigidjax.identify.reference_states import ReferenceStates
from rigidjax.identify.several_bodies import Bodies
from rigidjax.motion.manifold import minus

# One (R, k) for each sensor: R recordings, k components.
Noise = tuple[Float[Array, "records _"], ...]


def whitened(problem: Problem, errors: tuple, noise: Noise) -> tuple[Float[Array, "..."], ...]:
    """Errors in standard deviations, (R, T, k) for each sensor: see `standardised`."""
    out = []
    for reading, error, sigma in zip(problem.records.readings, errors, noise, strict=True):
        limit = getattr(reading.sensor, "limit", None)
        scaled, _ = jax.vmap(standardised)(reading.values, reading.mask, error, sigma, limit)
        out.append(scaled)
    return tuple(out)


def standardised(
    values: Float[Array, "times *components"],
    mask: Bool[Array, " times"],
    error: Float[Array, "times k"],
    sigma: Float[Array, " k"],
    limit: Float[Array, " k"] | None,
) -> tuple[Float[Array, "times k"], Bool[Array, "times k"]]:
    """Errors in standard deviations, saturated channels by their probability; and a mask of these.

    A channel at its limit says "at least that much": it counts as `√(−2 log Φ(z))`, with z the
    excess of the prediction over the limit in standard deviations (Tobin 1958,
    doi:10.2307/1907382).
    """
    scaled = error / sigma[None]
    if limit is None:
        return scaled, jnp.zeros(scaled.shape, bool)
    full = (jnp.abs(values) >= limit[None] * (1 - 1e-6)) & mask[:, None]
    side = jnp.sign(values)
    beyond = jnp.where(full, -side * scaled, 0.0)
    return jnp.where(full, -side * _censored(beyond), scaled), full


def _censored(z: Float[Array, "..."]) -> Float[Array, "..."]:
    # The term vanishes beyond five standard deviations, and the root has no derivative there.
    inside = jnp.minimum(z, 5.0)
    return jnp.where(z < 5.0, jnp.sqrt(-2.0 * jax.scipy.special.log_ndtr(inside)), 0.0)


def residuals(parameters: Parameters, args: Any) -> Any:
    """All residuals of a fit, as a tree: readings, priors, joints between pieces.

    **Arguments:** `parameters`; `args` the problem, the noise of each sensor, and weights (R, T)
    of the times.
    """
    problem, noise, weights = args
    errors, ends = all_errors(parameters, problem)
    return seen(problem, errors, noise, weights), beside(parameters, problem, ends)


def seen(problem: Problem, errors: tuple, noise: Noise, weights: Array) -> tuple[Array, ...]:
    """The readings' residuals (R, T, k) for least squares."""
    read = []
    for scaled in whitened(problem, errors, noise):
        if problem.loss is not None:
            scaled = jax.vmap(jax.vmap(problem.loss.shrink))(scaled)
        read.append(scaled * weights[..., None])
    return tuple(read)


def seen_rows(
    problem: Problem, errors: tuple, blocks: tuple, noise: Noise, weights: Array
) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """`seen`, and its derivatives (R, T, k, n) for each sensor, of those of the errors."""

    def of(errors: tuple) -> tuple[Array, ...]:
        return seen(problem, errors, noise, weights)

    return with_rows(of, errors, blocks)


def with_rows(of: Callable[[tuple], tuple], errors: tuple, blocks: tuple) -> tuple[tuple, tuple]:
    """`of(errors)`, and its derivatives (R, T, k, n) of those of the errors, `blocks`."""
    # Each residual depends on its own error alone: a product of small matrices.
    read, push = jax.linearize(of, errors)
    return read, jax.vmap(push, in_axes=-1, out_axes=-1)(blocks)


def beside(parameters: Parameters, problem: Problem, ends: Any) -> tuple[Array, ...]:
    """Residuals that are no readings: priors, and joints between pieces of one recording."""
    out = []
    for slot, shared, each in by_slot(problem, parameters):
        if slot.prior is not None:
            out.append((each if shared is None else shared) / slot.prior)
        if slot.spread is not None:
            out.append(each / slot.spread)
    if problem.prior is not None:
        assert not isinstance(problem.body, Bodies)
        body = problem.body.body(parameters.body)
        out.append(problem.prior.residuals(body, scaled=problem.body.unit != ""))
    if problem.links is not None:
        out.append(gaps(parameters, problem, ends) / problem.links.width)
    return tuple(out)


def gaps(parameters: Parameters, problem: Problem, ends: Any) -> Float[Array, "records n"]:
    """The gap between a piece's end and the next one's start, typical units; zero at the last."""
    assert problem.links is not None
    ref = problem.reference
    starts = jax.vmap(ReferenceStates.moved)(ref, parameters.own)
    following = jax.tree.map(lambda leaf: jnp.roll(leaf, -1, axis=0), starts)
    return jax.vmap(minus)(ends, following) / ref.units * problem.links.on[:, None]


def weights_of(problem: Problem, errors: tuple, noise: Noise) -> tuple[Float[Array, "..."], ...]:
    """The weight (R, T) of each reading in the normal equations: the loss's, zero if masked."""
    masks = [reading.mask for reading in problem.records.readings]
    if problem.loss is None:
        return tuple(mask.astype(e.dtype) for mask, e in zip(masks, errors, strict=True))
    weight = jax.vmap(jax.vmap(problem.loss.weight))
    scaled = whitened(problem, errors, noise)
    return tuple(jnp.where(mask, weight(e), 0.0) for mask, e in zip(masks, scaled, strict=True))
