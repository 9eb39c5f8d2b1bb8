"""Several torques at once, and torques on a body whose inertia changes in time."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import HasSpin, Mat3, ScalarLike, Vec3
from rigidjax.body.inertia import Inertia, tensor_of, with_tensor
from rigidjax.body.symmetric3 import apply, inverse
from rigidjax.motion.torques import base
from rigidjax.rotation.linalg3 import cross


class Sum(eqx.Module):
    """Several torques and forces at once; it needs the largest state of its parts.

    **Arguments:** `*parts` torques, forces, your own callables. **Raises:** `TypeError` for a part
    that cannot be called; `ValueError` for none at all.

    >>> damping = rj.torques.Damping([1.0, 1, 1])
    >>> Sum(damping, rj.torques.HeavyTop(1.0, [0.0, 0, 1], [0.0, 0, -9.81])).feels
    <class 'rigidjax._types.HasAttitude'>
    """

    parts: tuple[Any, ...]

    def __init__(self, *parts: base.Torque):
        if not parts:
            raise ValueError("Sum: wanted at least one torque; for a free body give torque=None")
        for part in parts:
            base.require_law(part, "Sum")
            if isinstance(part, ChangingInertia) and len(parts) > 1:
                raise TypeError(
                    "Sum: ChangingInertia divides all torques by the inertia at time t: put "
                    "the others inside it, ChangingInertia(inertia, Sum(a, b))"
                )
        self.parts = parts

    @property
    def feels(self) -> type:
        """The largest state that a part needs."""
        rungs = [getattr(part, "feels", base.LADDER[0]) for part in self.parts]
        order = lambda r: base.LADDER.index(r) if r in base.LADDER else len(base.LADDER)  # noqa: E731
        return max(rungs, key=order)

    @property
    def rate_free(self) -> bool:
        """Whether no part depends on the body rate."""
        return all(not base.sees_rate(part) for part in self.parts)

    @property
    def jump_times(self) -> Float[Array, " n"]:
        """The times of all parts, s, in order."""
        return base.jumps_in(*self.parts)

    def __call__(self, t: ScalarLike, state: Any, body: Any) -> Vec3 | base.Wrench:
        forces, torque = [], None
        for part in self.parts:
            force, more = base.act(part, t, state, body)
            torque = more if torque is None else torque + more
            forces += [] if force is None else [force]
        if not forces:
            return torque  # pyright: ignore[reportReturnType]
        return base.Wrench(sum(forces[1:], forces[0]), torque)


class ChangingInertia(eqx.Module):
    """The effect of a changing inertia on a body: `I(t) dΩ/dt = I(t)Ω × Ω − İΩ + τ`.

    **Arguments:** `inertia` a differentiable function of time, t → (3, 3), kg m², body frame, about
    the point that the body turns about (the centre of mass of a `Rigid`), such as
    `Linear(times, tensors)`; `torque` all other torques, or `None`. They act on I(t) and get the
    body at time t: give them here, not beside it in a `Sum`.

    The inertia of the body given to `simulate` is replaced. Parts that move inside must have no
    momentum in the body frame (Σ m r × ṙ = 0), such as booms that extend in a straight line from
    the centre; else add their momentum to `torque` as a `Flywheel`. Ejected fuel carries its share
    of İΩ away: then add İΩ to `torque`. Source: Hughes 1986, Spacecraft Attitude Dynamics, ch. 3;
    without τ the momentum `R I(t) Ω` is conserved.

    **Raises:** `TypeError` for anything but a function; `ValueError` for a value that is not (3,
    3).

    >>> grows = ChangingInertia(lambda t: (1.0 + t) * jnp.eye(3))
    >>> body = rj.Inertia(jnp.eye(3))
    >>> rj.simulate(body, rj.Spin([0.0, 0, 1.0]), [0.0, 1.0], grows).ys.omega[-1, 2]
    Array(0.5, dtype=float64)
    """

    inertia: Callable[[Any], Any]
    torque: Any

    def __init__(self, inertia: Callable[[Any], Any], torque: base.Torque | None = None):
        self.inertia = _checks.function(inertia, "inertia", "of time to (3, 3), kg m²")
        if torque is not None:
            base.require_law(torque)
        self.torque = torque

    @property
    def feels(self) -> type:
        """The smallest state that the torque inside acts on."""
        return getattr(self.torque, "feels", HasSpin)

    jump_times = property(base.jumps_of_parts)

    def tensor(self, t: ScalarLike) -> Mat3:
        """I(t), (3, 3), kg m²."""
        found = self.inertia(t)
        found = found.tensor if isinstance(found, Inertia) else found
        return _checks.floating(found, (3, 3), "inertia(t)")

    def __call__(self, t: ScalarLike, state: HasSpin, body: Any) -> Vec3 | base.Wrench:
        omega = state.omega
        t = jnp.asarray(t, omega.dtype)
        now, rate = jax.jvp(self.tensor, (t,), (jnp.ones_like(t),))
        now, rate = now.astype(omega.dtype), rate.astype(omega.dtype)
        turning = cross(apply(now, omega), omega) - apply(rate, omega)
        force = None
        if self.torque is not None:
            force, torque = base.act(self.torque, t, state, with_tensor(body, now))
            turning = turning + torque
        # The body's own equations have its own inertia: the torque that brings them to this.
        fixed = tensor_of(body)
        slope = apply(inverse(now), turning)
        torque = apply(fixed, slope) - cross(apply(fixed, omega), omega)
        return torque if force is None else base.Wrench(force, torque)
