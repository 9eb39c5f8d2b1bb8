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


def _setting_as_array(value: ArrayLike) -> np.ndarray:
    """Return a setting of a search (the number `value`) as a NumPy array of JAX's default float
    type.

    NumPy is used, since a conversion by JAX is slow outside of a compiled program.
    """
    return np.asarray(value, jnp.result_type(float))


class Settings(eqx.Module):
    """Hold the settings of a search for the least cost as arrays, so that other values need no new
    compilation of the search.

    The gain of a step is the fall of the cost. **Arguments**, where zero switches off each of
    `aim`, `near`, `count` and `level`:

    - `tolerance`: the search has converged if the next step changes each number by less than this
      many standard deviations of the number. Here the standard deviation of a number is computed
      with all other numbers fixed.
    - `damping`: the damping of the first step.
    - `steps`: the largest number of steps.
    - `aim`: a cost that another search reached; this search ends if it would need more than
      `PATIENCE` steps to reach this cost at its present pace.
    - `near`: the search ends at a cost of this value or less.
    - `count`: the number of errors, if the noise is unknown; the standard deviation of an error is
      then estimated by the root mean square of all errors. With zero this standard deviation is
      one.
    - `level`: the search ends after a step whose gain is about the predicted gain, but less than
      this fraction of the mean gain of a fit that follows only the noise of the readings.
    """

    tolerance: Any = eqx.field(converter=_setting_as_array)
    damping: Any = eqx.field(converter=_setting_as_array)
    steps: Any = eqx.field(converter=lambda steps: np.asarray(steps, np.int32))
    aim: Any = eqx.field(converter=_setting_as_array, default=0.0)
    near: Any = eqx.field(converter=_setting_as_array, default=0.0)
    count: Any = eqx.field(converter=_setting_as_array, default=0.0)
    level: Any = eqx.field(converter=_setting_as_array, default=0.0)


class LMState(eqx.Module):
    """Hold the state of a search for the least cost of n numbers by the method of Levenberg and
    Marquardt.

    **Fields:**

    - `first`: the cost at the starting point.
    - `point`: (n,) the best point so far.
    - `cost`, `normal`, `slope`: the cost, its normal matrix (n, n) and its gradient (n,) at the
      best point.
    - `trial`, `hoped`: the next point (n,) to evaluate, and the predicted gain (fall of the cost)
      there.
    - `damping`: the damping of the step to the next point.
    - `pace`: the mean fall of the logarithm of the cost in a step.
    - `taken`: the number of evaluations.
    - `done`, `converged`: whether the search has ended, and whether it converged.
    - `evaluation`, `evaluated_at_best`: the values kept from the last evaluation, and whether this
      evaluation was at the best point.
    - `rise`: the rise of the cost at the last trial point divided by the predicted gain; zero if
      the trial point was better, or if the cost there was not finite.
    """

    first: Float[Array, ""]
    point: Float[Array, " n"]
    cost: Float[Array, ""]
    normal: NormalMatrix
    slope: Float[Array, " n"]
    trial: Float[Array, " n"]
    hoped: Float[Array, ""]
    damping: Float[Array, ""]
    pace: Float[Array, ""]
    taken: Int[Array, ""]
    done: Bool[Array, ""]
    converged: Bool[Array, ""]
    evaluation: Any
    evaluated_at_best: Bool[Array, ""]
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

    Source: Marquardt 1963, doi:10.1137/0111030; the damping follows the ratio of actual to
    predicted gain as in Madsen, Nielsen and Tingleff 2004, Methods for non-linear least squares
    problems, section 3.2.

    **Arguments:**

    - `evaluate`: a function that returns, at a point, values to keep, the cost, the normal matrix
      and the gradient. The cost is half a sum of squares, or minus a log-density with Fisher's
      information as the normal matrix (scoring).
    - `start`: (n,) the point at which the search begins; if no steps are allowed, only this point
      is evaluated.
    - `order_one`: (n,) one for each number of order one, which no step may change by more than
      `LONGEST`; zero for each number that may have any size.
    - `settings`: the settings of the search.
    - `zeros`: a tree of zeros with the shapes of the values to keep.
    - `zero_normal`: zeros with the shapes of the normal matrix, if it is not one dense matrix
      (`NormalMatrix.own_blocks`).
    - `gain_of_noise`: given the kept values and the normal matrix, this function returns the mean
      gain (fall of the cost) of a fit that follows only the noise of the readings (see
      `Settings.level`); or `None`.
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

    def evaluate_and_update(state: LMState) -> LMState:
        return _next_state(state, evaluate(state.trial), order_one, settings, gain_of_noise)

    return lax.while_loop(
        lambda now: ~now.done & (now.taken <= settings.steps), evaluate_and_update, begun
    )


def _next_state(
    state: LMState,
    evaluation: tuple[Any, Array, NormalMatrix, Array],
    order_one: Array,
    settings: Settings,
    gain_of_noise: Callable[[Any, NormalMatrix], Array] | None,
) -> LMState:
    """Return the state of a search by the method of Levenberg and Marquardt after one evaluation of
    the cost of n numbers.

    The point of the evaluation is accepted if its cost is lower than the lowest cost so far. The
    damping is adapted to the ratio of actual to predicted gain (fall of the cost), and the next
    point is computed.

    - `state`: the state before the evaluation.
    - `evaluation`: what was found at the point `state.trial`: values to keep, the cost, the normal
      matrix (n, n) and the gradient (n,).
    - `order_one`: (n,) one for each number of order one, which no step may change by more than
      `LONGEST`; zero for each number that may have any size.
    - `settings`: the settings of the search, such as its tolerance.
    - `gain_of_noise`: a function of the kept values and the normal matrix that returns the gain of
      a fit that follows only the noise. The search may end after a step whose gain is less than the
      fraction `settings.level` of this gain. With `None` the search does not end in this way.
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
    move, root = _damped_step_and_scale(normal, slope, order_one, damping)
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


def _damped_step_and_scale(
    normal: NormalMatrix, slope: Array, order_one: Array, damping: Array
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Return two things: the damped step (n,) of Levenberg and Marquardt from a point; and the
    square root (n,) of the diagonal of the normal matrix.

    The step is shortened so that no number of order one changes by more than `LONGEST`.

    - `normal`, `slope`: the normal matrix (n, n) and the gradient (n,) of the cost at the point.
    - `order_one`: (n,) one for numbers of order one, zero for other numbers.
    - `damping`: the damping. The damping times the diagonal of the normal matrix is added to this
      diagonal; for a number of order one whose diagonal element is less than one, the damping
      itself is added.
    """
    diagonal = normal.diagonal
    diagonal = jnp.maximum(diagonal, jnp.maximum(1e-12 * jnp.max(diagonal), 1e-300))
    # The normal matrix is scaled to ones on its diagonal, so that the Cholesky factorisation loses
    # no digits if the units of the numbers are very different.
    root = jnp.sqrt(diagonal)
    damped = damping * jnp.maximum(diagonal, order_one) / root**2
    scaled = normal.scale_rows_and_columns(1.0 / root)
    move = -scaled.add_diagonal(damped).solve(slope / root) / root
    far = jnp.max(jnp.abs(move) * order_one)
    return move * jnp.minimum(1.0, LONGEST / jnp.maximum(far, 1e-300)), root
