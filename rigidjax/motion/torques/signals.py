"""What lies between a command and what it does: a lag of first order."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import ScalarLike
from rigidjax.body import validation
from rigidjax.motion.torques.base import given, jumps_of


class Lagged(eqx.Module):
    """A lag of first order, such as a motor's: `T dy/dt = u(t) − y`, whose value is y.

    A state of its own, integrated with the body's (see `AbstractTorque`); it stands where a
    function of time may: `Rotors(…, speeds=Lagged(Input("speeds"), 0.05))`.

    **Arguments:** `source` u, a function of time such as `Held(times, values)`, or `Input("u")`;
    `time` T, s, > 0: one number, or one a channel; it may be free in a fit; `start` y at the start;
    `None` for u there.

    For a u that jumps from 0 to 1 it is `1 − exp(−t/T)`. Source: any text on control, such as
    Åström and Murray, Feedback Systems.

    **Raises:** `TypeError` for a source that cannot be called; `ValueError` for a time that is
    known and not positive, or wrong shapes.

    >>> import rigidjax as rj
    >>> push = rj.torques.InSpace(Lagged(lambda t: jnp.array([0.0, 0.0, 1.0]), 0.5, jnp.zeros(3)))
    >>> body, start = rj.Inertia(jnp.eye(3)), rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 0])
    >>> rj.simulate(body, start, [0.0, 0.5], push).own[0][-1, 2]  # 1 − 1/e
    Array(0.63212056, dtype=float64)
    """

    source: Any
    time: Float[Array, "*k"]
    start: Array | None

    def __init__(self, source: Any, time: Any, start: Any = None):
        self.source = _checks.function(source, "source", "of time")
        kind = jnp.result_type(float)
        array = _checks.numbers(time, "time")
        if not array.size:
            raise ValueError("time: wanted one number, s, or one a channel, got none")
        self.time = given(time, array.shape, "time").astype(kind)
        if validation.known(array) and not (np.asarray(array) > 0).all():
            raise ValueError(f"time: wanted a positive time, s, got {np.asarray(array)}")
        if start is not None:
            start = given(start, _checks.numbers(start, "start").shape, "start").astype(kind)
            if not start.size:
                raise ValueError("start: wanted one number, or one a channel, got none")
        self.start = start

    @property
    def jump_times(self) -> Float[Array, " n"]:
        """Times, s, where the source jumps: the value has a kink there."""
        return jumps_of(self.source)

    def state0(self, t: ScalarLike, state: Any, body: Any) -> Array:
        """The value at the start."""
        return self.source(t) if self.start is None else self.start

    def rate(self, t: ScalarLike, own: Array, state: Any, body: Any) -> Array:
        """dy/dt, in the source's unit per second."""
        wanted = _checks.numbers(self.source(t), "source(t)").astype(own.dtype)
        if jnp.shape(wanted) != jnp.shape(own):
            raise ValueError(
                f"Lagged: start has the shape {jnp.shape(own)}, the source {jnp.shape(wanted)}"
            )
        return (wanted - own) / self.time

    def __call__(self, t: ScalarLike, own: Array) -> Array:
        return own
