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
    """Compute the time derivative of the state of a body whose inertia changes with the time.

    It is called with the time t, s, and a state with the body rate Ω. In the returned derivative
    dΩ̃/dt stands in the place of dΩ/dt. The rate Ω̃ = I₀⁻¹ p, rad/s, is computed from the momentum
    p = I(t) Ω. Here I(t) is the inertia at the time t, and I₀ is the inertia of `body`, which is
    constant. When I(t) jumps, Ω jumps, too, but p and Ω̃ do not.
    """

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
    """Compute the time derivative of the state of a body whose inertia changes with the time.

    While such a motion is integrated, its states have the rate Ω̃ = I₀⁻¹ p in the place of the body
    rate Ω. Here p = I(t) Ω is the momentum, I(t) the inertia at the time t, and I₀ the inertia of
    the body that `simulate` was given. When I(t) jumps, Ω jumps, too, but Ω̃ does not. The method
    `to_momentum` replaces Ω by Ω̃, and `to_rate` replaces Ω̃ by Ω.
    """

    field: Any  # an `_ChangingEquations`, or a `CoupledEquations` that contains it

    def __call__(self, t: ScalarLike, y: Any, args: object = None) -> Any:
        return self.field(t, self.to_rate(t, y))

    def to_momentum(self, t: Any, y: PyTree) -> PyTree:
        """Return the state `y`, with its body rate Ω replaced by I₀⁻¹ p, where p is the momentum.

        The momentum is p = I(t) Ω. Here I(t) is the inertia at the time `t`, s, and I₀ is the
        inertia of the body that `simulate` was given.
        """
        return self._replace_rate(y, lambda now, fixed, w: solve(fixed, apply(now, w)), t)

    def to_rate(self, t: Any, y: PyTree) -> PyTree:
        """Return the state `y` of the run, with the body rate Ω in the place of its rate w.

        The body rate is Ω = I(t)⁻¹ I₀ w. Here I(t) is the inertia at the time `t`, s, and I₀ is the
        inertia of the body that `simulate` was given. This is the inverse of
        `to_momentum`.
        """
        return self._replace_rate(y, lambda now, fixed, w: solve(now, apply(fixed, w)), t)

    def _replace_rate(
        self, y: PyTree, new_rate: Callable[[Array, Array, Array], Array], t: Any
    ) -> PyTree:
        """Return the state `y` with its body rate, rad/s, replaced by another one.

        `new_rate(I, I₀, w)` computes the new rate from three arrays: the inertia (3, 3) at the time
        `t`, s; the inertia (3, 3) of the body that `simulate` was given; and the rate w (3,) of
        `y`.
        """
        motion, own = motion_of(y), y.own if isinstance(y, Coupled) else ()
        dtype = motion.omega.dtype
        inner: Any = self.field.field if isinstance(self.field, CoupledEquations) else self.field
        now = (
            freeze_own_states(inner.law, own).tensor(jnp.asarray(t, dtype))
            if own
            else inner.law.tensor(t)
        )
        fixed = tensor_of(inner.body).astype(dtype)
        omega = new_rate(now.astype(dtype), fixed, motion.omega)
        return eqx.tree_at(lambda s: motion_of(s).omega, y, omega)


def equations_by_momentum(body: Any, state0: Any, torque: Any) -> ByMomentum | None:
    """Return the equations of motion by momentum for an inertia that is a function of time.

    In the states of these equations I₀⁻¹ p stands in the place of the body rate, so that the states
    do not jump when the inertia jumps; p is the momentum and I₀ the inertia of `body`. The result
    is `None` for an inertia that is constant or that depends on more than the time.

    - `body`, `torque`: the arguments of `simulate` with these names.
    - `state0`: the state at the start, with the body rate.
    """
    if not isinstance(law := changing_inertia(torque), ChangingInertia) or hasattr(
        law.inertia, "feels"
    ):
        return None
    field: Any = _ChangingEquations(body, law)
    return ByMomentum(CoupledEquations(field, body) if isinstance(state0, Coupled) else field)


def changing_inertia(torque: Any) -> ChangingInertia | None:
    """Return the torque if it is a `ChangingInertia`, or `None` if it is another torque.

    A `ChangingInertia` is the law by which the inertia of a body changes with the time; `simulate`
    takes it in the place of a torque. If the torque is a `Sum` whose only part is a
    `ChangingInertia`, this part is returned.
    """
    # The argument `torque` may also be a scene of particles, another torque or `None`, which are
    # not searched for parts.
    parts = parts_of(torque) if isinstance(torque, ChangingInertia | Sum) else ()
    return parts[0] if len(parts) == 1 and isinstance(parts[0], ChangingInertia) else None


def with_body_rates(form: ByMomentum | None, ts: Array, ys: PyTree) -> PyTree:
    """Return the saved states of a run, with the body rates restored.

    If the inertia is a function of time, the states of the run have a rate that is computed from
    the momentum, in the place of the body rate.

    - `form`: the equations by momentum of the run; if it is `None`, the states already have the
      body rate and are returned as they are.
    - `ts`: (T,) the saved times, s.
    - `ys`: the states at these times, with a leading time axis.
    """
    return ys if form is None else jax.vmap(form.to_rate)(ts, ys)
