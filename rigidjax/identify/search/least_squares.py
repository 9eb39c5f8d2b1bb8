"""Levenberg and Marquardt's search on any normal equations."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rigidjax.identify.model.normal import Normal

# Damping is in units of the diagonal of the normal equations (Marquardt's): one is a step half as
# long as Gauss and Newton's.
CAREFUL, BOLD = 1.0, 1e-3
# Numbers scaled to order one go no further than this in a step.
LONGEST = 2.0
# A step with damping below this counts as one of Gauss and Newton.
FREE = 1e-2
# The least ratio of actual to predicted gain of a step that supports its model.
FAIR = 0.25
# A problem counts as linear if the ratio of actual to predicted gain is so near to one.
LINEAR = 0.05
# Steps that a search may still be away from where another one ended; its pace is by how much the
# logarithm of the misfit falls in a step, of the last ones half as much each as the one after it.
PATIENCE, FIRST_PACE = 25.0, 4.0
# Damping beyond which nothing moves.
STUCK = 1e12
# The cost has noise, as that of adaptive steps has, if the second of two refused steps rises by
# more of its predicted gain than the first did, by ten times of it at least, and that gain is
# a small part of the cost. Shorter steps of a smooth cost rise by less and less of it.
NOISY, LITTLE = 10.0, 1e-4
# Errors of unknown size count as no smaller than this part of their unit: the rest is round-off.
EXACT = 1e-6


def _float(value: Any) -> np.ndarray:
    # NumPy's: outside of a trace each conversion of JAX costs as much as a run of 100 steps.
    return np.asarray(value, jnp.result_type(float))


class Settings(eqx.Module):
    """The settings of a search, as arrays: another value does not compile again.

    Steps of `tolerance` standard deviations (of each number alone) end it, and more than `steps`;
    if it would need more than `PATIENCE` steps at its pace to an `aim` of another search; at a cost
    of `near`; if a step of about the predicted gain gains less than `level` of what a fit gains
    from noise. Zero for none. If the size of the errors is unknown, `count` is their number, and a
    standard deviation is that by their mean square; zero if it is one.
    """

    tolerance: Any = eqx.field(converter=_float)
    damping: Any = eqx.field(converter=_float)
    steps: Any = eqx.field(converter=lambda steps: np.asarray(steps, np.int32))
    aim: Any = eqx.field(converter=_float, default=0.0)
    near: Any = eqx.field(converter=_float, default=0.0)
    count: Any = eqx.field(converter=_float, default=0.0)
    level: Any = eqx.field(converter=_float, default=0.0)


class LMState(eqx.Module):
    """The state of a search by Levenberg and Marquardt.

    `first` is the cost at the start; `point` the best so far, with `cost`, `normal` and `slope`
    there; `trial` the next point, `hoped` its predicted gain; `pace` by how much the logarithm of
    the cost falls in a step; `taken` the number of evaluations; `kept` the values kept from the
    last one, and `kept_at_best` whether that was at the best point; `rise` the rise of the cost at
    the last trial over its predicted gain, zero if the trial was better.
    """

    first: Float[Array, ""]
    point: Float[Array, " n"]
    cost: Float[Array, ""]
    normal: Normal
    slope: Float[Array, " n"]
    trial: Float[Array, " n"]
    hoped: Float[Array, ""]
    damping: Float[Array, ""]
    pace: Float[Array, ""]
    taken: Int[Array, ""]
    done: Bool[Array, ""]
    converged: Bool[Array, ""]
    kept: Any
    kept_at_best: Bool[Array, ""]
    rise: Float[Array, ""]


def minimise(
    evaluated: Callable[[Array], tuple[Any, Array, Normal, Array]],
    start: Float[Array, " n"],
    order_one: Float[Array, " n"],
    settings: Settings,
    nothing: Any,
    empty: Normal | None = None,
    gain_of_noise: Callable[[Any, Normal], Array] | None = None,
) -> LMState:
    """Return the end of at most `settings.steps` steps down from `start`.

    With no steps, `start` alone is evaluated.

    **Arguments:** `evaluated` point → values to keep, cost, normal matrix, gradient: of half a sum
    of squares, or minus a log-density with Fisher's information (scoring); `order_one` (n,) one for
    numbers of order one, which no step moves far, else zero; `nothing` zeros like the kept values,
    `empty` like the normal matrix, if that has more than a core; `gain_of_noise` gives the gain of
    a fit from noise (see `Settings.level`), from the kept values and the normal matrix.
    Source: Marquardt 1963, doi:10.1137/0111030; damping by the ratio of actual to predicted gain:
    Madsen, Nielsen and Tingleff 2004, Methods for non-linear least squares problems, section 3.2.
    """
    number, kind = start.size, start.dtype
    begun = LMState(
        jnp.asarray(jnp.inf, kind),
        start,
        jnp.asarray(jnp.inf, kind),
        Normal(jnp.zeros((number, number), kind)) if empty is None else empty,
        jnp.zeros(number, kind),
        start,
        jnp.zeros((), kind),
        jnp.asarray(settings.damping, kind),
        jnp.asarray(FIRST_PACE, kind),
        jnp.zeros((), jnp.int32),
        jnp.asarray(False),
        jnp.asarray(False),
        nothing,
        jnp.asarray(False),
        jnp.zeros((), kind),
    )

    def step(now: LMState) -> LMState:
        return _after(now, evaluated(now.trial), order_one, settings, gain_of_noise)

    return lax.while_loop(lambda now: ~now.done & (now.taken <= settings.steps), step, begun)


def _after(
    now: LMState,
    trial: tuple[Any, Array, Normal, Array],
    order_one: Array,
    settings: Settings,
    gain_of_noise: Callable[[Any, Normal], Array] | None,
) -> LMState:
    """Return the state after an evaluation of the trial point, with the next trial."""
    kept, cost, normal, slope = trial
    parts = jax.tree.leaves((cost, normal, slope))
    finite = jnp.stack([jnp.isfinite(part).all() for part in parts]).all()
    first = now.taken == 0
    better = finite & ((cost < now.cost) | first)
    ratio = (now.cost - cost) / jnp.where(now.hoped > 0, now.hoped, 1.0)
    grown = jnp.where(ratio > 0.75, 0.1, jnp.where(ratio > FAIR, 0.5, 2.0))
    # Damping only makes steps short if the misfit falls as that of the linear problem.
    linear = (jnp.abs(ratio - 1.0) < LINEAR) & (now.damping > FREE)
    grown = jnp.where(linear, 0.01, grown)
    damping = now.damping * jnp.where(first, 1.0, jnp.where(better, grown, 8.0))
    damping = jnp.maximum(damping, 1e-12)
    fell = jnp.where(better & ~first, jnp.log(jnp.abs(now.cost / cost)), 0.0)
    pace = jnp.where(first, now.pace, 0.5 * (now.pace + fell))
    flat = better & ~first & (ratio > FAIR) & (now.damping <= FREE)
    if gain_of_noise is not None:
        flat = flat & (now.cost - cost < settings.level * gain_of_noise(kept, normal))
    rise = jnp.where(better | ~finite, 0.0, -ratio)
    noisy = (now.rise > 0) & (rise > jnp.maximum(now.rise, NOISY)) & (now.hoped < LITTLE * now.cost)
    point, cost, normal, slope = jax.tree.map(
        lambda new, old: jnp.where(better, new, old),
        (now.trial, cost, normal, slope),
        (now.point, now.cost, now.normal, now.slope),
    )
    move, root = _damped(normal, slope, order_one, damping)
    sound = jnp.isfinite(move).all()
    move = jnp.where(sound, move, 0.0)
    hoped = -(slope @ move) - 0.5 * move @ (normal @ move)
    size = jnp.sqrt(2.0 * jnp.maximum(cost, 0.0) / jnp.maximum(settings.count, 1.0))
    unit = jnp.where(settings.count > 0, jnp.maximum(size, EXACT), 1.0)
    small = (jnp.max(jnp.abs(move) * root) < settings.tolerance * unit) & (damping <= FREE)
    # Round-off refuses every step at the minimum itself.
    bottom = hoped <= 1e-14 * jnp.abs(cost)
    ended = small if gain_of_noise is None else small | flat
    converged = sound & (ended | noisy | (bottom & ~better & ~first))
    lost = ~finite & first
    done = converged | lost | (damping > STUCK) | (~sound & (damping > 1.0))
    done = done | ((settings.aim > 0) & (cost > settings.aim * jnp.exp(PATIENCE * pace)))
    done = done | ((settings.near > 0) & (cost <= settings.near))
    damping = jnp.where(sound, damping, 8.0 * damping)
    return LMState(
        jnp.where(first & finite, cost, now.first),
        point,
        cost,
        normal,
        slope,
        point + move,
        hoped,
        damping,
        pace,
        now.taken + 1,
        done,
        converged,
        kept,
        better,
        rise,
    )


def _damped(normal: Normal, slope: Array, order_one: Array, damping: Array) -> tuple[Array, Array]:
    """The step (n,), and the root of the diagonal of the normal matrix (n,)."""
    felt = normal.diagonal
    felt = jnp.maximum(felt, jnp.maximum(1e-12 * jnp.max(felt), 1e-300))
    # Columns of length one: the factor of Cholesky loses no digits to units.
    root = jnp.sqrt(felt)
    damped = damping * jnp.maximum(felt, order_one) / root**2
    move = -normal.scaled(1.0 / root).plus(damped).solve(slope / root) / root
    far = jnp.max(jnp.abs(move) * order_one)
    return move * jnp.minimum(1.0, LONGEST / jnp.maximum(far, 1e-300)), root
