"""Integrate the momentum of a body whose inertia is a function of time.

The momentum p = I(t) Ω obeys `dp/dt = p × Ω + τ`, however the inertia I changes; Ω is the body rate
and τ the torque. Where I jumps, p stays as it is and Ω jumps, and no derivative of I is needed. A
state of the run has Ω̃ = I₀⁻¹ p in the place of Ω, where I₀ is the inertia of the body that
`simulate` was given. Ω̃ has the unit and size of a body rate, so that the tolerances for Ω also
suit Ω̃.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from rigidjax._types import ScalarLike
from rigidjax.body.inertia import MassProperties, tensor_of, with_tensor
from rigidjax.motion import Attitude
from rigidjax.motion.coupled import Coupled, CoupledEquations, motion_of
from rigidjax.motion.equations import AttitudeEquations, EulerEquations, NewtonEuler
from rigidjax.motion.torques import ChangingInertia, Sum
from rigidjax.motion.torques.base import in_precision
from rigidjax.motion.torques.composite import parts_of, tensor_or_nan
from rigidjax.motion.torques.states import freeze_own_states
from rigidjax.rotation.linalg3 import apply, solve


class _ChangingEquations(eqx.Module):
    """Compute dΩ̃/dt, in the place of dΩ/dt, from a state with the body rate Ω."""

    body: Any  # the body with the inertia I₀, an `Inertia` or `MassProperties`
    law: ChangingInertia  # gives the inertia I(t) at any time, and the torque

    def __call__(self, t: ScalarLike, y: Any, args: object = None) -> Any:
        dtype = y.omega.dtype
        body, law = in_precision(self.body, dtype), in_precision(self.law, dtype)
        now = tensor_or_nan(law.tensor(jnp.asarray(t, dtype)).astype(dtype))
        kind: Any = AttitudeEquations if isinstance(y, Attitude) else EulerEquations
        kind = NewtonEuler if isinstance(body, MassProperties) else kind
        slope = kind(with_tensor(body, now), law.torque)(t, y)
        change = solve(tensor_of(body), apply(now, slope.omega))
        return eqx.tree_at(lambda s: s.omega, slope, change)


class ByMomentum(eqx.Module):
    """Compute the time derivative of a state with the rate Ω̃ = I₀⁻¹ p in the place of Ω.

    Where the inertia I(t) jumps, Ω jumps, but Ω̃ does not.
    """

    field: Any  # an `_ChangingEquations`, or a `CoupledEquations` that contains it

    def __call__(self, t: ScalarLike, y: Any, args: object = None) -> Any:
        return self.field(t, self.to_rate(t, y))

    def to_momentum(self, t: Any, y: PyTree) -> PyTree:
        """Return the state with Ω replaced by Ω̃ = I₀⁻¹ I(t) Ω."""
        return self._replace_rate(y, lambda now, fixed, w: solve(fixed, apply(now, w)), t)

    def to_rate(self, t: Any, y: PyTree) -> PyTree:
        """Return the state with Ω̃ replaced by Ω = I(t)⁻¹ I₀ Ω̃."""
        return self._replace_rate(y, lambda now, fixed, w: solve(now, apply(fixed, w)), t)

    def _replace_rate(
        self, y: PyTree, new_rate: Callable[[Array, Array, Array], Array], t: Any
    ) -> PyTree:
        """Return the state with the rate `new_rate(I, I₀, rate)`, rad/s."""
        motion, own = motion_of(y), y.own if isinstance(y, Coupled) else ()
        dtype = motion.omega.dtype
        inner: Any = self.field.field if isinstance(self.field, CoupledEquations) else self.field
        now = (
            freeze_own_states(inner.law, own).tensor(jnp.asarray(t, dtype))
            if own
            else inner.law.tensor(t)
        )
        omega = new_rate(now.astype(dtype), tensor_of(inner.body).astype(dtype), motion.omega)
        return eqx.tree_at(lambda s: motion_of(s).omega, y, omega)


def equations_by_momentum(body: Any, state0: Any, torque: Any) -> ByMomentum | None:
    """Return the equations by momentum; `None` unless the inertia is a function of time alone."""
    if not isinstance(law := changing_inertia(torque), ChangingInertia) or hasattr(
        law.inertia, "feels"
    ):
        return None
    field: Any = _ChangingEquations(body, law)
    return ByMomentum(CoupledEquations(field, body) if isinstance(state0, Coupled) else field)


def changing_inertia(torque: Any) -> ChangingInertia | None:
    """Return the torque, or the only part of a `Sum`, if it is a `ChangingInertia`, else `None`."""
    # The argument `torque` may also be a scene of particles, another torque or `None`, which are
    # not searched for parts.
    parts = parts_of(torque) if isinstance(torque, ChangingInertia | Sum) else ()
    return parts[0] if len(parts) == 1 and isinstance(parts[0], ChangingInertia) else None


def with_body_rates(form: ByMomentum | None, ts: Array, ys: PyTree) -> PyTree:
    """Return the saved states of a run with their body rates (see `ByMomentum`)."""
    return ys if form is None else jax.vmap(form.to_rate)(ts, ys)
