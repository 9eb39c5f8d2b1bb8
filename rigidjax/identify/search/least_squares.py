"""Minimise a cost by the method of Levenberg and Marquardt, for dense or block-structured normal
equations.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from rigidjax.identify.model.normal import NormalMatrix

# CAREFUL and BOLD are the damping of a first step that is cautious, and of one that is close to a
# Gauss–Newton step. The unit of a damping is the diagonal of the normal equations (Marquardt 1963):
# if the normal matrix is diagonal, a damping of one halves a Gauss–Newton step.
CAREFUL, BOLD = 1.0, 1e-3
# One step changes a number of order one by no more than this.
LONGEST = 2.0
# A step of the search with at most this damping counts as a Gauss–Newton step, which has no
# damping.
FREE = 1e-2
# The gain of a step is the fall of the cost. A step supports the quadratic model of the cost if its
# actual gain is more than this fraction of its predicted gain.
FAIR = 0.25
# The problem counts as linear if the ratio of actual to predicted gain differs from one by less
# than this.
LINEAR = 0.05
# The pace of a search is the mean fall of the logarithm of the cost in a step. In this mean the
# weight of each step is half the weight of the next step. FIRST_PACE is the pace before the first
# step. A search ends if, at its present pace, it would need more than PATIENCE steps to reach the
# cost at which another search ended.
PATIENCE, FIRST_PACE = 25.0, 4.0
# A search with more damping than this is stuck: its steps are too short to change the point.
STUCK = 1e12
# A search ends at a noisy cost, such as a cost computed by adaptive integration, since no step can
# be judged by it. A refused step is one that raises the cost; its ratio is this rise divided by the
# predicted gain (fall of the cost). For a smooth cost the ratio becomes smaller as steps get
# shorter. A cost therefore counts as noisy if two steps in succession are refused, if the ratio of
# the second step is larger than NOISY and larger than the ratio of the first step, and if the
# predicted gain of the second step is less than the fraction LITTLE of the cost.
NOISY, LITTLE = 10.0, 1e-4
# If the noise is unknown, the length of the step that ends a search is in proportion to the root
# mean square of the errors. This root mean square is taken to be at least this number, because
# smaller errors are round-off.
EXACT = 1e-6


def _array(value: ArrayLike) -> np.ndarray:
    """Return a setting as a NumPy array: a conversion by JAX is slow outside of `jit`."""
    return np.asarray(value, jnp.result_type(float))


class Settings(eqx.Module):
    """Hold the settings of a search as arrays, so that others need no new compilation.

    The gain of a step is the fall of the cost. Zero switches off each of `aim`, `near`, `count` and
    `level`.
    """

    # The search has converged if the next step changes each parameter by less than this many of its
    # standard deviations with all other parameters fixed.
    tolerance: Any = eqx.field(converter=_array)
    # The damping of the first step.
    damping: Any = eqx.field(converter=_array)
    # The largest number of steps.
    steps: Any = eqx.field(converter=lambda steps: np.asarray(steps, np.int32))
    # A cost that another search reached: this one ends if it would need more than PATIENCE steps to
    # reach it at its present pace.
    aim: Any = eqx.field(converter=_array, default=0.0)
    # The search ends at a cost of this value or less.
    near: Any = eqx.field(converter=_array, default=0.0)
    # The number of errors, if the noise is unknown: the standard deviation of an error is then
    # their root mean square, else one.
    count: Any = eqx.field(converter=_array, default=0.0)
    # The search ends after a step whose gain is about the predicted gain, but less than this
    # fraction of the mean gain of a fit that follows only the noise of the readings.
    level: Any = eqx.field(converter=_array, default=0.0)


class LMState(eqx.Module):
    """Hold the state of a search for the least cost by the method of Levenberg and Marquardt."""

    # The cost at the starting point.
    first: Float[Array, ""]
    # The best point so far, with its cost, normal matrix and gradient.
    point: Float[Array, " n"]
    cost: Float[Array, ""]
    normal: NormalMatrix
    slope: Float[Array, " n"]
    # The next point to evaluate, the predicted gain there, and the damping of the step to it.
    trial: Float[Array, " n"]
    hoped: Float[Array, ""]
    damping: Float[Array, ""]
    # The mean fall of the logarithm of the cost in a step.
    pace: Float[Array, ""]
    # The number of evaluations.
    taken: Int[Array, ""]
    done: Bool[Array, ""]
    converged: Bool[Array, ""]
    # The values kept from the last evaluation, and whether it was at the best point.
    evaluation: Any
    evaluated_at_best: Bool[Array, ""]
    # The rise of the cost at the last trial point divided by the predicted gain; zero if the point
    # was better, or if the cost there was not finite.
    rise: Float[Array, ""]


def minimise(
    evaluate: Callable[[Array], tuple[PyTree, Array, NormalMatrix, Array]],
    start: Float[Array, " n"],
    order_one: Float[Array, " n"],
    settings: Settings,
    zeros: PyTree,
    zero_normal: NormalMatrix | None = None,
    gain_of_noise: Callable[[Any, NormalMatrix], Array] | None = None,
) -> LMState:
    """Minimise a cost by the method of Levenberg and Marquardt, and return the last state.

    `evaluate` returns values to keep, the cost, the normal matrix and the gradient at a point. The
    cost is half a sum of squares, or minus a log-density with Fisher's information as the normal
    matrix (scoring). `order_one` is one for each parameter that no step may change by more than
    `LONGEST`, else zero. `zeros` and `zero_normal` have the shapes of the values to keep and of a
    normal matrix that is not one dense block. `gain_of_noise` is the mean gain of a fit that
    follows only the noise, see `Settings.level`.

    Source: Marquardt 1963, doi:10.1137/0111030; the damping follows the ratio of actual to
    predicted gain as in Madsen, Nielsen and Tingleff 2004, Methods for non-linear least squares
    problems, section 3.2.
    """
    number, kind = start.size, start.dtype
    begun = LMState(
        jnp.asarray(jnp.inf, kind),
        start,
        jnp.asarray(jnp.inf, kind),
        NormalMatrix(jnp.zeros((number, number), kind)) if zero_normal is None else zero_normal,
        jnp.zeros(number, kind),
        start,
        jnp.zeros((), kind),
        jnp.asarray(settings.damping, kind),
        jnp.asarray(FIRST_PACE, kind),
        jnp.zeros((), jnp.int32),
        jnp.asarray(False),
        jnp.asarray(False),
        zeros,
        jnp.asarray(False),
        jnp.zeros((), kind),
    )

    return lax.while_loop(
        lambda now: ~now.done & (now.taken <= settings.steps),
        lambda now: _next_state(now, evaluate(now.trial), order_one, settings, gain_of_noise),
        begun,
    )


def _next_state(
    state: LMState,
    evaluation: tuple[Any, Array, NormalMatrix, Array],
    order_one: Array,
    settings: Settings,
    gain_of_noise: Callable[[Any, NormalMatrix], Array] | None,
) -> LMState:
    """Take or refuse `state.trial` by its `evaluation` (values, cost, normal matrix, gradient),
    and return the state with the next damping and trial; other arguments are as of `minimise`.
    """
    values, cost, normal, slope = evaluation
    parts = jax.tree.leaves((cost, normal, slope))
    finite = jnp.stack([jnp.isfinite(part).all() for part in parts]).all()
    first = state.taken == 0
    better = finite & ((cost < state.cost) | first)
    ratio = (state.cost - cost) / jnp.where(state.hoped > 0, state.hoped, 1.0)
    grown = jnp.where(ratio > 0.75, 0.1, jnp.where(ratio > FAIR, 0.5, 2.0))
    # If the cost falls as the linear model predicts, damping is not needed: it would only make
    # steps shorter.
    linear = (jnp.abs(ratio - 1.0) < LINEAR) & (state.damping > FREE)
    grown = jnp.where(linear, 0.01, grown)
    damping = state.damping * jnp.where(first, 1.0, jnp.where(better, grown, 8.0))
    damping = jnp.maximum(damping, 1e-12)
    fell = jnp.where(better & ~first, jnp.log(jnp.abs(state.cost / cost)), 0.0)
    pace = jnp.where(first, state.pace, 0.5 * (state.pace + fell))
    flat = better & ~first & (ratio > FAIR) & (state.damping <= FREE)
    if gain_of_noise is not None:
        flat = flat & (state.cost - cost < settings.level * gain_of_noise(values, normal))
    rise = jnp.where(better | ~finite, 0.0, -ratio)
    noisy = (
        (state.rise > 0)
        & (rise > jnp.maximum(state.rise, NOISY))
        & (state.hoped < LITTLE * state.cost)
    )
    point, cost, normal, slope = jax.tree.map(
        lambda new, old: jnp.where(better, new, old),
        (state.trial, cost, normal, slope),
        (state.point, state.cost, state.normal, state.slope),
    )
    diagonal = normal.diagonal
    diagonal = jnp.maximum(diagonal, jnp.maximum(1e-12 * jnp.max(diagonal), 1e-300))
    # The normal matrix is scaled to ones on its diagonal, so that the Cholesky factorisation loses
    # no digits if the units of the parameters are very different.
    root = jnp.sqrt(diagonal)
    damped = damping * jnp.maximum(diagonal, order_one) / root**2
    move = -normal.scaled(1.0 / root).add_diagonal(damped).solve(slope / root) / root
    far = jnp.max(jnp.abs(move) * order_one)
    move = move * jnp.minimum(1.0, LONGEST / jnp.maximum(far, 1e-300))
    sound = jnp.isfinite(move).all()
    move = jnp.where(sound, move, 0.0)
    hoped = -(slope @ move) - 0.5 * move @ (normal @ move)
    size = jnp.sqrt(2.0 * jnp.maximum(cost, 0.0) / jnp.maximum(settings.count, 1.0))
    unit = jnp.where(settings.count > 0, jnp.maximum(size, EXACT), 1.0)
    small = (jnp.max(jnp.abs(move) * root) < settings.tolerance * unit) & (damping <= FREE)
    # At the minimum itself round-off makes every step look worse, and each is refused. The search
    # stops if the predicted gain is only round-off.
    bottom = hoped <= 1e-14 * jnp.abs(cost)
    ended = small if gain_of_noise is None else small | flat
    converged = sound & (ended | noisy | (bottom & ~better & ~first))
    lost = ~finite & first
    done = converged | lost | (damping > STUCK) | (~sound & (damping > 1.0))
    done = done | ((settings.aim > 0) & (cost > settings.aim * jnp.exp(PATIENCE * pace)))
    done = done | ((settings.near > 0) & (cost <= settings.near))
    damping = jnp.where(sound, damping, 8.0 * damping)
    return LMState(
        jnp.where(first & finite, cost, state.first),
        point,
        cost,
        normal,
        slope,
        point + move,
        hoped,
        damping,
        pace,
        state.taken + 1,
        done,
        converged,
        values,
        better,
        rise,
    )
