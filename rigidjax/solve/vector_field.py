"""The vector field of a scene, by the kind of its state; and in s = −t for runs back in time."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from rigidjax import _checks
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.frames import AbstractScene, MovingFrame, Point
from rigidjax.frames.frame_dynamics import scene_of
from rigidjax.motion import Attitude, Rigid, Spin
from rigidjax.motion.coupled import Coupled, CoupledEquations
from rigidjax.motion.equations import AttitudeEquations, EulerEquations, NewtonEuler
from rigidjax.motion.torques.base import Torque
from rigidjax.solve import validation


def equations_of_motion(
    body: Inertia | MassProperties | None,
    state0: Spin | Attitude | Rigid | Point | Coupled,
    torque: Torque | AbstractScene | MovingFrame | None = None,
) -> Callable[..., Any]:
    """The vector field of this body for states like `state0`, for plain `diffrax.ODETerm`.

    **Arguments** `body`, `state0`, `torque` as for `simulate`; under a torque with states of its
    own `state0` is a `rigidjax.motion.coupled.Coupled`. **Raises** `TypeError` where they do not
    fit.

    >>> import rigidjax as rj
    >>> type(equations_of_motion(rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Spin([1.0, 0, 0])))
    <class 'rigidjax.motion.equations.EulerEquations'>
    """
    if isinstance(state0, Coupled):
        return CoupledEquations(equations_of_motion(body, state0.motion, torque), body)
    validation.require_fit(body, state0, torque)
    if isinstance(state0, Point):
        return scene_of(torque).field
    kind: Any = EulerEquations
    if isinstance(body, MassProperties):
        kind = NewtonEuler
    elif isinstance(state0, Attitude):
        kind = AttitudeEquations
    return kind(body, torque)


def direction(times: Array) -> Int[Array, ""] | None:
    """`None` for times known to increase; else the sign of t's change, known or traced."""
    ends = _checks.namespace(times).asarray(times)
    change = ends[-1] - ends[0]
    if _checks.known(times) and change > 0:
        return None
    # A whole number: derivatives do not carry it along.
    return jnp.asarray(jnp.sign(change), jnp.int32)


def ahead(
    sign: Array | None, field: Callable[..., Any], condition: Any, ts: Array, jumps: Array
) -> tuple[Callable[..., Any], Any, Array, Array]:
    """A vector field f(t, y, args), a condition `(t, y)`, times and jump times, in s = σt.

    **Arguments:** `sign` σ of the direction of time, 1 or −1, `None` for s = t.
    """
    if sign is None:
        return field, condition, ts, jumps
    time = lambda s: sign.astype(s.dtype) * s  # noqa: E731

    def directed(s: Array, y: Any, args: Any = None) -> Any:
        t = time(s)
        if jumps.size:
            # A law has its new value from the jump on. A step back that begins there wants the old
            # one, and one that ends there, at the last moment before it in s, the new one.
            # The oldest JAX has no derivative of `nextafter`, not even one to be stopped.
            still = lax.stop_gradient(t)
            before = jnp.nextafter(still, jnp.full_like(still, -jnp.inf))
            t = t + jnp.where(sign < 0, before - still, jnp.zeros_like(still))
        return jax.tree.map(lambda leaf: sign.astype(leaf.dtype) * leaf, field(t, y, args))

    asked = None if condition is None else lambda s, y: condition(time(s), y)
    return directed, asked, time(ts), time(jumps)
