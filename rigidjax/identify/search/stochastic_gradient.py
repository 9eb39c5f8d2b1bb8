"""Fit by stochastic gradient descent with optax, for more recordings than `fit` can use."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from rigidjax import _checks
from rigidjax.identify.data import stacking
from rigidjax.identify.model.model import Model, all_errors, checked_x, require_one_kind
from rigidjax.identify.model.terms import (
    Noise,
    half_squares,
    prior_residuals,
    reading_residuals,
)
from rigidjax.identify.search.checkpoint import report_progress
from rigidjax.identify.search.noise import initial_noise

if TYPE_CHECKING:
    import optax

# One run of the compiled program takes this many steps. An interrupt (Ctrl-C), or a cost that is
# not finite, is noticed between two runs.
STRIDE = 50


class Descent(eqx.Module):
    """Hold the options of a stochastic gradient descent, which uses a few recordings in each step.

    Each step draws `batch` recordings without replacement. The optimiser gets the gradient of the
    cost of these recordings with respect to all parameters (Robbins and Monro 1951,
    doi:10.1214/aoms/1177729586). The parameters are unconstrained and of order one, so that a
    learning rate of 0.01 moves each number by about a hundredth of its size in a step.

    **Arguments:**

    - `optimiser`: any `optax.GradientTransformation`.
    - `steps`: the number of steps.
    - `batch`: the number of recordings in a step.

    **Raises:** `TypeError` for anything but an optimiser, `ValueError` for counts below one.

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
        _checks.require_instance(
            optimiser, optax.GradientTransformation, "Descent", requirement=wanted
        )
        self.optimiser = optimiser
        self.steps = _checks.integer(steps, "steps", 1)
        self.batch = _checks.integer(batch, "batch", 1)


def descend(
    model: Model,
    descent: Descent,
    *,
    initial: Float[Array, " n"] | None = None,
    key: PRNGKeyArray | None = None,
    progress: Callable[[str], Any] | None = None,
) -> Float[Array, " n"]:
    """Fit the parameters of a model by stochastic gradient descent alone.

    It is for models with many parameters, such as the weights of a network in the torque, for
    which the dense matrices of `fit` are too large. It gives no intervals.

    **Arguments:**

    - `model`: the readings and the parameters. The noise of a sensor whose noise is `None` is
      taken as a tenth of its signal.
    - `descent`: the optimiser, the number of steps and the size of a batch.
    - `initial`: (n,) the parameters to begin with, `model.start()` unless given.
    - `key`: random key of the batches; without a key the batches are the same at each call.
    - `progress`: a function such as `print`, called with a line of text after every 50 steps.

    **Returns** the parameters x (n,) after the last step. If a cost becomes infinite or NaN,
    the result is x before the 50 steps in which this happens. After an interrupt (Ctrl-C) it is the
    last x that was reached. `model.unpack(x)` returns the body and the values, `model.scenes(x)`
    the scenes. **Raises:** `ValueError` for a batch of more recordings than there are.

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
    _checks.require_instance(model, Model, "descend", requirement="a Model")
    require_one_kind(model, "descend")
    _checks.require_instance(
        descent, Descent, "descend", requirement="a Descent(optimiser, steps=…, batch=…)"
    )
    x = model.start() if initial is None else checked_x(model, initial)
    random: Any = jax.random.key(0) if key is None else _checks.random_key(key)
    if progress is not None:
        _checks.require_function(progress, "progress", "of a line of text, such as print")
    if descent.batch > model.count:
        raise ValueError(
            f"Descent: wanted a batch of at most {model.count} recordings, got {descent.batch}"
        )
    init: Any = descent.optimiser.init
    noise, memory = initial_noise(model), init(x)
    try:
        for first in range(0, descent.steps, STRIDE):
            random, own = jax.random.split(random)
            keys = jax.random.split(own, min(STRIDE, descent.steps - first))
            after, memory, costs = _descent_steps(x, memory, model, noise, descent, keys)
            if not np.isfinite(np.asarray(costs)).all():
                break
            x = after
            done = first + keys.shape[0]
            line = f"descent {done}/{descent.steps}: cost {float(costs.mean()):.6g}"
            report_progress(progress, line)
    except KeyboardInterrupt:
        pass
    return x


class _Descended(NamedTuple):
    """Hold the parameters x and the optimiser's state after some steps."""

    x: Float[Array, " n"]
    optimiser_state: Any
    costs: Float[Array, " steps"]  # before each step


@eqx.filter_jit
def _descent_steps(
    x: Float[Array, " n"],
    optimiser_state: PyTree,
    model: Model,
    noise: Noise,
    descent: Descent,
    keys: Array,
) -> _Descended:
    """Take a step of the optimiser for each of the `keys`, which draw batches of recordings."""

    def descent_step(carry: tuple, key: Array) -> tuple[tuple, Array]:
        x, optimiser_state = carry
        update: Any = descent.optimiser.update
        rows = jax.random.choice(key, model.count, (descent.batch,), replace=False)
        cost, slope = jax.value_and_grad(cost_of_recordings)(x, model, noise, rows)
        # optax multiplies its integer count of steps by floats, which strict promotion would
        # refuse.
        with jax.numpy_dtype_promotion("standard"):
            move, optimiser_state = update(slope, optimiser_state, x)
        return (x + move, optimiser_state), cost

    (x, optimiser_state), costs = jax.lax.scan(descent_step, (x, optimiser_state), keys)
    return _Descended(x, optimiser_state, costs)


def cost_of_recordings(
    x: Float[Array, " n"], model: Model, noise: Noise, recording_indices: Array
) -> Float[Array, ""]:
    """Return the cost of some recordings, scaled up to all, plus the cost of the priors.

    The mean over random batches is the cost of the whole model.
    """
    few, sizes = with_recordings(model, recording_indices), stacking.pick(noise, recording_indices)
    residuals = reading_residuals(few, all_errors(few, x), sizes, jnp.ones_like(few.records.t))
    scale = model.count / recording_indices.shape[0]
    return half_squares(residuals) * scale + half_squares(prior_residuals(model, x))


def with_recordings(model: Model, recording_indices: Array) -> Model:
    """Return the model with all parameters and some recordings, at indices that may be traced."""
    parts = lambda m: (m.records, m.reference, m.body_indices, m.index.places, m.index.start)  # noqa: E731
    return eqx.tree_at(
        parts,
        model,
        stacking.pick(parts(model), recording_indices),
        is_leaf=lambda node: node is None,
    )
