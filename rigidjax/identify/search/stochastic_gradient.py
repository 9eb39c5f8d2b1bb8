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
from rigidjax.identify.model.model import Model, require_numbers
from rigidjax.identify.model.terms import (
    Noise,
    all_errors,
    half_sum,
    prior_residuals,
    reading_residuals,
)
from rigidjax.identify.search.checkpoint import report_progress
from rigidjax.identify.search.noise import first_noise

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
    model: Model,
    descent: Descent,
    *,
    initial: Float[Array, " n"] | None = None,
    key: PRNGKeyArray | None = None,
    progress: Callable[[str], Any] | None = None,
) -> Float[Array, " n"]:
    """Fit the free numbers of a model by stochastic gradient descent alone.

    It is for many numbers, such as the weights of a network in the torque, where the dense matrices
    of `fit` are too large; it gives no intervals. **Arguments:**

    - `model`: the readings and the free numbers; a sensor without noise counts by a tenth of its
      signal.
    - `descent`: optimiser, steps and batch.
    - `initial`: (n,) the free numbers to begin with, `model.start()` unless given.
    - `key`: random key of the batches, always the same unless given.
    - `progress`: called with a line of text after every 50 steps, such as `print`.

    **Returns** the free numbers (n,) after the last step, or before the first one whose misfit is
    not finite: `model.unpack(x)`, `model.scenes(x)` say what they are. An interrupt (Ctrl-C)
    returns the numbers reached. **Raises:** `ValueError` for a batch of more recordings than there
    are.

    >>> import optax
    >>> ts = jnp.linspace(0.0, 3.0, 31)
    >>> body, law = rj.Inertia.from_principal(1.0, 2.0, 2.5), rj.torques.Damping([0.3, 0.3, 0.3])
    >>> rates = rj.simulate(body, rj.Spin([1.0, 0.5, 0.8]), ts, law).ys.omega
    >>> record = rj.identify.Recording(ts, (rj.identify.Gyro(0.01), rates))
    >>> drag = rj.identify.Free(lambda s: s.torque.coefficient, "drag")
    >>> model = rj.identify.Model(
    ...     record, rj.identify.Known(body), torque=rj.torques.Damping([0.1, 0.1, 0.1]), free=[drag]
    ... )
    >>> x = descend(model, Descent(optax.adam(2e-2), steps=200, batch=1))
    >>> bool(jnp.abs(model.values(x)["drag"] - 0.3).max() < 0.02)
    True
    """
    _checks.instance(model, Model, "descend", wanted="a Model")
    _checks.instance(descent, Descent, "descend", wanted="a Descent(optimiser, steps=…, batch=…)")
    x = model.start() if initial is None else require_numbers(model, initial)
    random: Any = jax.random.key(0) if key is None else _checks.key(key)
    if progress is not None:
        _checks.function(progress, "progress", "of a line of text, such as print")
    return descend_from(x, model, first_noise(model), descent, random, progress)[0]


def descend_from(
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
