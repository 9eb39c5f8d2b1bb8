"""Choose what a run integrates: the state or, if the inertia is a function of time, the momentum.

The momentum p = I(t) Ω obeys `dp/dt = p × Ω + τ`, however the inertia I changes; Ω is the body rate
and τ the torque. Where I jumps, p stays as it is and Ω jumps, and no derivative of I is needed. A
state of the run has Ω̃ = I₀⁻¹ p in the place of Ω, where I₀ is the inertia of the body that
`simulate` was given. Ω̃ has the unit and size of a body rate, so that the tolerances for Ω also
suit Ω̃.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from rigidjax._types import ScalarLike
from rigidjax.body.inertia import MassProperties, tensor_of, with_tensor
from rigidjax.frames import Point
from rigidjax.frames.frame_dynamics import scene_of_force
from rigidjax.motion import Attitude
from rigidjax.motion.coupled import Coupled, CoupledEquations, motion_of
from rigidjax.motion.equations import AttitudeEquations, EulerEquations, NewtonEuler
from rigidjax.motion.suspension import AbstractSuspension, TurnEquations
from rigidjax.motion.torques import ChangingInertia, Sum
from rigidjax.motion.torques.base import in_precision
from rigidjax.motion.torques.composite import parts_of, tensor_or_nan
from rigidjax.motion.torques.states import freeze_own_states
from rigidjax.rotation.barrier import warn_of_slow_loops
from rigidjax.rotation.linalg3 import apply, solve


class _ChangingEquations(eqx.Module):
    """Compute dΩ̃/dt, in the place of dΩ/dt, from a state with the body rate Ω."""

    body: Any  # the body with the inertia I₀, an `Inertia` or `MassProperties`
    law: ChangingInertia  # gives the inertia I(t) at any time, and the torque

    def __call__(self, t: ScalarLike, y: Any, args: object = None) -> Any:
        dtype = y.omega.dtype
        body, law = in_precision(self.body, dtype), in_precision(self.law, dtype)
        now = tensor_or_nan(law.tensor(jnp.asarray(t, dtype)).astype(dtype))
        slope = equations_of(with_tensor(body, now), y, law.torque)(t, y)
        change = solve(tensor_of(body), apply(now, slope.omega))
        return eqx.tree_at(lambda s: s.omega, slope, change)


class ByMomentum(eqx.Module):
    """Compute the time derivative of a state with the rate Ω̃ = I₀⁻¹ p in the place of Ω.

    Where the inertia I(t) jumps, Ω jumps, but Ω̃ does not.
    """

    field: Any  # an `_ChangingEquations`, or a `CoupledEquations` that contains it

    def __call__(self, t: ScalarLike, y: Any, args: object = None) -> Any:
        return self.field(t, self.replace_rate(t, y, _to_rate))

    def replace_rate(
        self, t: Any, y: PyTree, new_rate: Callable[[Array, Array, Array], Array]
    ) -> PyTree:
        """Return the state with the rate `new_rate(I(t), I₀, rate)`, rad/s, in the place of its
        rate Ω or Ω̃; I and I₀ are inertia tensors.
        """
        motion, own = motion_of(y), y.own if isinstance(y, Coupled) else ()
        dtype = motion.omega.dtype
        inner: Any = self.field.field if isinstance(self.field, CoupledEquations) else self.field
        law, t = (
            (freeze_own_states(inner.law, own), jnp.asarray(t, dtype)) if own else (inner.law, t)
        )
        fixed = tensor_of(inner.body).astype(dtype)
        omega = new_rate(law.tensor(t).astype(dtype), fixed, motion.omega)
        return eqx.tree_at(lambda s: motion_of(s).omega, y, omega)


def _to_rate(now: Array, fixed: Array, omega: Array) -> Array:
    """Return Ω = I(t)⁻¹ I₀ Ω̃."""
    return solve(now, apply(fixed, omega))


class Integrated(NamedTuple):
    """Hold what a run integrates, y, and convert states of the body to y and back."""

    field: Any  # f(t, y, args): dy/dt; a `ByMomentum` if the inertia is a function of time alone

    def from_state(self, t: Any, state: PyTree) -> PyTree:
        if not isinstance(self.field, ByMomentum):
            return state
        # Ω̃ = I₀⁻¹ I(t) Ω
        return self.field.replace_rate(t, state, lambda now, fixed, w: solve(fixed, apply(now, w)))

    def to_state(self, t: Any, y: PyTree) -> PyTree:
        return self.field.replace_rate(t, y, _to_rate) if isinstance(self.field, ByMomentum) else y


def integrated_form(body: Any, state0: Any, torque: Any) -> Integrated:
    """Return what a run integrates, for arguments that fit together."""
    law = changing_inertia(torque)
    if law is None or hasattr(law.inertia, "feels"):
        return Integrated(equations_of(body, state0, torque))
    field: Any = _ChangingEquations(body, law)
    return Integrated(
        ByMomentum(CoupledEquations(field, body) if isinstance(state0, Coupled) else field)
    )


def equations_of(body: Any, state0: Any, torque: Any) -> Callable[..., Any]:
    """Return the vector field of a body or particle, for arguments that fit together."""
    if isinstance(state0, Coupled):
        return CoupledEquations(equations_of(body, state0.motion, torque), body)
    if torque is not None:
        warn_of_slow_loops()
    if isinstance(state0, Point):
        return scene_of_force(torque).field
    if isinstance(torque, AbstractSuspension):
        return TurnEquations(body, torque)
    kind: Any = AttitudeEquations if isinstance(state0, Attitude) else EulerEquations
    return (NewtonEuler if isinstance(body, MassProperties) else kind)(body, torque)


def changing_inertia(torque: Any) -> ChangingInertia | None:
    """Return the torque, or the only part of a `Sum`, if it is a `ChangingInertia`, else `None`."""
    # The argument `torque` may also be a scene of particles, another torque or `None`, which are
    # not searched for parts.
    parts = parts_of(torque) if isinstance(torque, ChangingInertia | Sum) else ()
    return parts[0] if len(parts) == 1 and isinstance(parts[0], ChangingInertia) else None
