"""The search of Levenberg and Marquardt, on any normal equations."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from rigidjax.identify.model.normal import NormalMatrix

# The damping of the first step, in units of the diagonal of the normal equations (Marquardt's): a
# damping of one makes a step half as long as a Gauss–Newton step.
CAREFUL, BOLD = 1.0, 1e-3
# The largest change in a step of a number that is scaled to order one.
LONGEST = 2.0
# A step with less damping counts as a Gauss–Newton step.
FREE = 1e-2
# The least ratio of actual to predicted gain of a step that supports the quadratic model.
FAIR = 0.25
# The problem counts as linear if the ratio of actual to predicted gain is as near to one as this.
LINEAR = 0.05
# A search ends if at its pace it needs more than PATIENCE steps to the cost at which another search
# ended. The pace is the fall of the logarithm of the misfit in a step: an average over the steps in
# which each counts half as much as the next one.
PATIENCE, FIRST_PACE = 25.0, 4.0
# With more damping than this nothing moves.
STUCK = 1e12
# The cost is taken as noisy, like that of adaptive integration, if two steps in succession are
# refused, the second one raises the cost by NOISY times its predicted gain or more, and by a larger
# multiple than the first one, and this gain is less than LITTLE of the cost. Of a smooth cost
# shorter steps raise it by smaller and smaller multiples.
NOISY, LITTLE = 10.0, 1e-4
# The errors of sensors of unknown noise count as at least this part of their unit: below it they
# are round-off.
EXACT = 1e-6


def _setting_as_array(value: ArrayLike) -> np.ndarray:
    """Return a setting as a NumPy array.

    Outside of a trace each conversion by JAX takes as long as a run of 100 steps.
    """
    return np.asarray(value, jnp.result_type(float))


class Settings(eqx.Module):
    """The settings of a search, as arrays, so that another value does not compile again.

    **Arguments**; zero switches each of the last four off:

    - `tolerance`: the search has converged at a step shorter than this, in standard deviations of
      each number with all others fixed.
    - `damping`: of the first step.
    - `steps`: the largest number of steps.
    - `aim`: a cost that another search reached; this search ends if at its pace it would need more
      than `PATIENCE` steps to it.
    - `near`: the search ends at this cost.
    - `count`: for errors of unknown size their number; their mean square then gives the standard
      deviation, which is one otherwise.
    - `level`: the search ends if a step of about the predicted gain gains less than this part of
      what a fit gains from noise alone.
    """

    tolerance: Any = eqx.field(converter=_setting_as_array)
    damping: Any = eqx.field(converter=_setting_as_array)
    steps: Any = eqx.field(converter=lambda steps: np.asarray(steps, np.int32))
    aim: Any = eqx.field(converter=_setting_as_array, default=0.0)
    near: Any = eqx.field(converter=_setting_as_array, default=0.0)
    count: Any = eqx.field(converter=_setting_as_array, default=0.0)
    level: Any = eqx.field(converter=_setting_as_array, default=0.0)


class LMState(eqx.Module):
    """The state of a search by Levenberg and Marquardt.

    **Fields:**

    - `first`: the cost at the start.
    - `point`: the best point so far.
    - `cost`, `normal`, `slope`: cost, normal matrix and gradient at the best point.
    - `trial`, `hoped`: the next point, and its predicted gain.
    - `damping`: of the step to the next point.
    - `pace`: the mean fall of the logarithm of the cost in a step.
    - `taken`: the number of evaluations.
    - `done`, `converged`: whether the search has ended, and whether it converged.
    - `evaluation`, `evaluated_at_best`: the values kept from the last evaluation, and whether it
      was at the best point.
    - `rise`: the rise of the cost at the last trial over its predicted gain; zero if the trial was
      better.
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
    """Minimise a cost from `start`, and return the last state of the search.

    Source: Marquardt 1963, doi:10.1137/0111030; the damping follows the ratio of actual to
    predicted gain as in Madsen, Nielsen and Tingleff 2004, Methods for non-linear least squares
    problems, section 3.2.

    **Arguments:**

    - `evaluate`: a function from a point to values to keep, cost, normal matrix and gradient. The
      cost is half a sum of squares, or minus a log-density with Fisher's information as the normal
      matrix (scoring).
    - `start`: (n,) the first point; with no steps it alone is evaluated.
    - `order_one`: (n,) one for numbers of order one, which no step moves far, else zero.
    - `settings`: the settings.
    - `zeros`: zeros of the shapes of the kept values.
    - `zero_normal`: zeros of the shapes of the normal matrix, if it has more than a core.
    - `gain_of_noise`: a function from the kept values and the normal matrix to the gain of a fit
      from noise alone (see `Settings`), or `None`.
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

    def step(state: LMState) -> LMState:
        return _next_state(state, evaluate(state.trial), order_one, settings, gain_of_noise)

    return lax.while_loop(lambda now: ~now.done & (now.taken <= settings.steps), step, begun)


def _next_state(
    state: LMState,
    evaluation: tuple[Any, Array, NormalMatrix, Array],
    order_one: Array,
    settings: Settings,
    gain_of_noise: Callable[[Any, NormalMatrix], Array] | None,
) -> LMState:
    """Return the state after an evaluation of the trial point, with the next trial."""
    values, cost, normal, slope = evaluation
    parts = jax.tree.leaves((cost, normal, slope))
    finite = jnp.stack([jnp.isfinite(part).all() for part in parts]).all()
    first = state.taken == 0
    better = finite & ((cost < state.cost) | first)
    ratio = (state.cost - cost) / jnp.where(state.hoped > 0, state.hoped, 1.0)
    grown = jnp.where(ratio > 0.75, 0.1, jnp.where(ratio > FAIR, 0.5, 2.0))
    # If the misfit falls like that of a linear problem, damping only makes steps shorter.
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
    move, root = _damped_step(normal, slope, order_one, damping)
    sound = jnp.isfinite(move).all()
    move = jnp.where(sound, move, 0.0)
    hoped = -(slope @ move) - 0.5 * move @ (normal @ move)
    size = jnp.sqrt(2.0 * jnp.maximum(cost, 0.0) / jnp.maximum(settings.count, 1.0))
    unit = jnp.where(settings.count > 0, jnp.maximum(size, EXACT), 1.0)
    small = (jnp.max(jnp.abs(move) * root) < settings.tolerance * unit) & (damping <= FREE)
    # At the minimum itself every step is refused, by round-off: stop if nothing can be gained.
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


def _damped_step(
    normal: NormalMatrix, slope: Array, order_one: Array, damping: Array
) -> tuple[Array, Array]:
    """Return the damped step (n,), and the root (n,) of the diagonal of the normal matrix."""
    diagonal = normal.diagonal
    diagonal = jnp.maximum(diagonal, jnp.maximum(1e-12 * jnp.max(diagonal), 1e-300))
    # Scale columns to length one, so that Cholesky's factor loses no digits to units.
    root = jnp.sqrt(diagonal)
    damped = damping * jnp.maximum(diagonal, order_one) / root**2
    move = -normal.in_units(1.0 / root).add_diagonal(damped).solve(slope / root) / root
    far = jnp.max(jnp.abs(move) * order_one)
    return move * jnp.minimum(1.0, LONGEST / jnp.maximum(far, 1e-300)), root
