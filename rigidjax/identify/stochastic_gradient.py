"""Stochastic descent by optax, for more recordings than one step of least squares can use."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from rigidjax import _checks
from rigidjax.identify import padding
from rigidjax.identify.checkpoint import report_progress
from rigidjax.identify.parameters import Parameters
from rigidjax.identify.problem import Problem
from rigidjax.identify.terms import Noise, half_sum, residuals

if TYPE_CHECKING:
    import optax

# Steps between two checks of the keyboard and of the misfit, which may become NaN.
STRIDE = 50


class Descent(eqx.Module):
    """The first descent of a fit, on a few recordings at a time.

    Each step draws `batch` recordings without replacement, differentiates their misfit and hands
    the gradient of all parameters to `optimiser`. The parameters are unconstrained and of order
    one: a learning rate is a share of order one. **Arguments:** `optimiser` any
    `optax.GradientTransformation`; `steps` their number; `batch`. **Raises:** `TypeError` for
    anything but an optimiser, `ValueError` for counts below one. Source: Robbins and Monro 1951,
    doi:10.1214/aoms/1177729586.

    >>> import optax
    >>> rj.identify.Descent(optax.adam(1e-2), steps=200, batch=4).batch
    4
    """

    optimiser: "optax.GradientTransformation" = eqx.field(static=True)
    steps: int = eqx.field(static=True)
    batch: int = eqx.field(static=True)

    def __init__(self, optimiser: "optax.GradientTransformation", *, steps: int, batch: int):
        import optax

        wanted = "an optimiser of optax such as optax.adam(1e-2)"
        _checks.instance(optimiser, optax.GradientTransformation, "Descent", wanted=wanted)
        self.optimiser = optimiser
        self.steps, self.batch = _checks.whole(steps, "steps", 1), _checks.whole(batch, "batch", 1)


def descend(
    start: Parameters,
    problem: Problem,
    noise: Noise,
    how: Descent,
    key: PRNGKeyArray,
    progress: Callable[[str], Any] | None = None,
) -> tuple[Parameters, bool]:
    """The end of the steps, or the last point before a NaN; and whether it was not interrupted."""
    if how.batch > problem.count:
        raise ValueError(
            f"Descent: wanted a batch of at most {problem.count} recordings, got {how.batch}"
        )
    if problem.rows is not None:
        raise ValueError("Descent: pieces of one recording depend on one another; fit them at once")
    init: Any = how.optimiser.init
    point, memory = start, init(start)
    try:
        for first in range(0, how.steps, STRIDE):
            key, own = jax.random.split(key)
            keys = jax.random.split(own, min(STRIDE, how.steps - first))
            after, memory, costs = _stride(point, memory, problem, noise, how, keys)
            if not np.isfinite(np.asarray(costs)).all():
                break
            point = after
            done = first + keys.shape[0]
            line = f"descent {done}/{how.steps}: misfit {float(costs.mean()):.6g}"
            report_progress(progress, line)
    except KeyboardInterrupt:
        return point, False
    return point, True


@eqx.filter_jit
def _stride(
    point: Parameters, memory: Any, problem: Problem, noise: Noise, how: Descent, keys: Array
) -> tuple[Parameters, Any, Float[Array, " steps"]]:
    def step(carry: Any, key: Array) -> Any:
        point, memory = carry
        update: Any = how.optimiser.update
        rows = jax.random.choice(key, problem.count, (how.batch,), replace=False)
        cost, slope = jax.value_and_grad(_misfit_of)(point, problem, noise, rows)
        # optax counts its steps in integers, which strict promotion forbids to meet floats.
        with jax.numpy_dtype_promotion("standard"):
            move, memory = update(slope, memory, point)
        return (jax.tree.map(jnp.add, point, move), memory), cost

    (point, memory), costs = jax.lax.scan(step, (point, memory), keys)
    return point, memory, costs


def _misfit_of(point: Parameters, problem: Problem, noise: Noise, rows: Array) -> Float[Array, ""]:
    """These recordings' misfit times the number of batches; priors count once."""
    few, (mine, theirs) = only(problem, rows), padding.one((point.own, noise), rows)
    weights = jnp.ones_like(few.records.t)
    read, beside = residuals(Parameters(point.body, point.shared, mine), (few, theirs, weights))
    return half_sum(read) * (problem.count / rows.shape[0]) + half_sum(beside)


def only(problem: Problem, rows: Array) -> Problem:
    """The problem of some recordings (traced indices), for misfits: they keep their padding."""

    def pick(at: Any, whole: Any) -> Any:
        return whole if at(whole) is None else eqx.tree_at(at, whole, padding.one(at(whole), rows))

    for at in (lambda p: p.records, lambda p: p.reference, lambda p: p.which):
        problem = pick(at, problem)
    slots = tuple(pick(lambda slot: slot.groups, slot) for slot in problem.slots)
    return eqx.tree_at(lambda p: p.slots, problem, slots) if slots else problem
