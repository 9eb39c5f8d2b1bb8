"""A random draw of a motion under random torques."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, PRNGKeyArray

from rigidjax import _checks
from rigidjax._types import HasSpin
from rigidjax.estimate.filter import steps_of
from rigidjax.estimate.scene import Dynamics, Extended, Model
from rigidjax.motion.equations import on_the_group


class Sampled(eqx.Module):
    """The result of `sample`.

    **Fields:** `t` (T,) s; `states` with a leading time axis; `torques` the value (T, 3) of each
    `CorrelatedTorque`, N m, body frame.
    """

    t: Float[Array, " times"]
    states: Any
    torques: tuple[Float[Array, "times 3"], ...]


def sample(key: Any, model: Model, state0: Any, ts: Any, *, substeps: int | None = None) -> Sampled:
    """One motion that the model's random torques could have made.

    Each step draws the integral and the first moment of the white noise, and follows the equations
    of motion under the polynomial with these moments by the classical method of order 4: of order
    1.5, and exact for a body at rest (Foster, Lyons and Oberhauser 2020, doi:10.1137/19M1261912). A
    `CorrelatedTorque` starts from its stationary distribution.

    **Arguments:** `key` of `jax.random`; `model`; `state0` a `Spin`, `Attitude` or `Rigid`; `ts`
    (T,) increasing times, s, the first is of `state0`; `substeps` fixed steps between two times,
    `None` chooses them by the rate if it is known, else one. **Returns** `t`, `states` and
    `torques` at these times (`Sampled`). **Raises** `ValueError` for times that do not increase.

    >>> import jax
    >>> body = rj.Inertia.from_principal(1.0, 2.0, 2.5)
    >>> model = rj.estimate.Model(body, rj.torques.RandomTorque(0.01))
    >>> drawn = sample(jax.random.key(0), model, rj.Spin([0.0, 0.0, 1.0]), [0.0, 0.5, 1.0])
    >>> drawn.states.omega.shape, drawn.torques  # white noise has no value at a time
    ((3, 3), ())
    """
    _checks.key(key)
    _checks.instance(model, Model, "model")
    _checks.single(state0, HasSpin, "state0", wanted="a Spin, an Attitude or a Rigid")
    times = _checks.rows(ts, (), "ts")
    if times.shape[0] < 2:
        raise ValueError(f"ts: wanted at least two times, got {times.shape[0]}")
    if _checks.known(times):
        words = "ts: wanted increasing times"
        _checks.refuse(times, not (np.diff(np.asarray(times)) > 0).all(), words)
    pieces = int(steps_of(model, times, state0, substeps).max())
    return _sample(key, model, on_the_group(state0), times, pieces)


@eqx.filter_jit
def _sample(key: PRNGKeyArray, model: Model, state0: Any, ts: Array, pieces: int) -> Sampled:
    dtype = state0.omega.dtype
    first, later = jax.random.split(key)
    keys = jax.random.split(first, len(model.coloured))
    torques = tuple(
        law.deviation.astype(dtype) * jax.random.normal(one, (3,), dtype)
        for law, one in zip(model.coloured, keys, strict=True)
    )
    x0 = Extended(state0, torques, ())
    dynamics = Dynamics(model, x0)

    def span(x: Extended, given: tuple[Array, Array, Array]) -> tuple[Extended, Extended]:
        left, right, one = given
        # Times may have more digits than the state.
        h = ((right - left) / pieces).astype(dtype)
        left = left.astype(dtype)
        kicks = jax.random.normal(one, (pieces, dynamics.kicks), dtype)

        def move(x: Extended, now: tuple[Array, Array]) -> tuple[Extended, None]:
            return dynamics.advance(left + now[0] * h, h, x, now[1]), None

        x, _ = lax.scan(move, x, (jnp.arange(pieces, dtype=dtype), kicks))
        return x, x

    keys = jax.random.split(later, ts.shape[0] - 1)
    _, rest = lax.scan(span, x0, (ts[:-1], ts[1:], keys))
    xs = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), x0, rest)
    return Sampled(ts, xs.motion, xs.torques)
