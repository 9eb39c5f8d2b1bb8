"""Stochastic descent by optax, for more recordings than one step of least squares can use."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from rigidjax import _checks
from rigidjax.identify.data import stacking
from rigidjax.identify.model.model import Model
from rigidjax.identify.model.terms import (
    Noise,
    all_errors,
    half_sum,
    prior_residuals,
    reading_residuals,
)
from rigidjax.identify.search.checkpoint import report_progress

if TYPE_CHECKING:
    import optax

# Steps between two checks of the keyboard and of the misfit, which may become NaN.
STRIDE = 50


class Descent(eqx.Module):
    """The first descent of a fit, on a few recordings at a time.

    Each step draws `batch` recordings without replacement, differentiates their misfit and hands
    its gradient by all free numbers to `optimiser`. The free numbers are unconstrained and of order
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
    start: Float[Array, " n"],
    model: Model,
    noise: Noise,
    how: Descent,
    key: PRNGKeyArray,
    progress: Callable[[str], Any] | None = None,
) -> tuple[Float[Array, " n"], bool]:
    """Return the end of the steps, or the last point before a NaN, and whether all steps were made.

    An interrupt (Ctrl-C) ends the steps early.
    """
    if how.batch > model.count:
        raise ValueError(
            f"Descent: wanted a batch of at most {model.count} recordings, got {how.batch}"
        )
    init: Any = how.optimiser.init
    x, memory = start, init(start)
    try:
        for first in range(0, how.steps, STRIDE):
            key, own = jax.random.split(key)
            keys = jax.random.split(own, min(STRIDE, how.steps - first))
            after, memory, costs = _stride(x, memory, model, noise, how, keys)
            if not np.isfinite(np.asarray(costs)).all():
                break
            x = after
            done = first + keys.shape[0]
            line = f"descent {done}/{how.steps}: misfit {float(costs.mean()):.6g}"
            report_progress(progress, line)
    except KeyboardInterrupt:
        return x, False
    return x, True


@eqx.filter_jit
def _stride(
    x: Float[Array, " n"], memory: Any, model: Model, noise: Noise, how: Descent, keys: Array
) -> tuple[Float[Array, " n"], Any, Float[Array, " steps"]]:
    def step(carry: Any, key: Array) -> Any:
        x, memory = carry
        update: Any = how.optimiser.update
        rows = jax.random.choice(key, model.count, (how.batch,), replace=False)
        cost, slope = jax.value_and_grad(misfit_of)(x, model, noise, rows)
        # optax counts its steps in integers, which strict promotion forbids to meet floats.
        with jax.numpy_dtype_promotion("standard"):
            move, memory = update(slope, memory, x)
        return (x + move, memory), cost

    (x, memory), costs = jax.lax.scan(step, (x, memory), keys)
    return x, memory, costs


def misfit_of(x: Float[Array, " n"], model: Model, noise: Noise, rows: Array) -> Float[Array, ""]:
    """Return the misfit of the recordings `rows` times the number of batches; priors count once."""
    few, sizes = chosen_recordings(model, rows), stacking.one(noise, rows)
    weights = jnp.ones_like(few.records.t)
    residuals = reading_residuals(few, all_errors(few, x), sizes, weights)
    scale = model.count / rows.shape[0]
    return half_sum(residuals) * scale + half_sum(prior_residuals(model, x))


def chosen_recordings(model: Model, rows: Array) -> Model:
    """Return the model of the recordings `rows` (traced indices), with the same free numbers.

    The recordings keep their padding.
    """
    parts = lambda m: (m.records, m.reference, m.which, m.index.places, m.index.start)  # noqa: E731
    return eqx.tree_at(
        parts, model, stacking.one(parts(model), rows), is_leaf=lambda node: node is None
    )
