"""Several torques at once, and a torque from any potential."""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import HasAttitude, Scalar, ScalarLike, Vec3
from rigidjax.motion.torques.base import (
    LADDER,
    AbstractTorque,
    Torque,
    Wrench,
    act,
    jumps_of,
    require_law,
    sees_rate,
)
from rigidjax.motion.torques.changing_inertia import ChangingInertia


class Sum(eqx.Module):
    """Several torques and forces at once; it needs the highest state that a part needs.

    **Arguments:** `*parts` torques, forces, your own callables.

    **Raises:** `TypeError` for a part that cannot be called; `ValueError` for none at all.

    >>> from rigidjax import torques
    >>> Sum(torques.Damping([1.0, 1, 1]), torques.HeavyTop(1.0, [0.0, 0, 1], [0.0, 0, -9.81])).feels
    <class 'rigidjax._types.HasAttitude'>
    """

    parts: tuple[Any, ...]

    def __init__(self, *parts: Torque):
        if not parts:
            raise ValueError("Sum: wanted at least one torque; for a free body give torque=None")
        for part in parts:
            require_law(part, "Sum")
            if isinstance(part, ChangingInertia) and len(parts) > 1:
                raise TypeError(
                    "Sum: ChangingInertia divides all torques by the inertia at their time: put "
                    "the others inside it, ChangingInertia(inertia, Sum(a, b))"
                )
        self.parts = parts

    @property
    def feels(self) -> type:
        """The highest state that a part needs."""
        rungs = [getattr(part, "feels", LADDER[0]) for part in self.parts]
        return max(rungs, key=lambda r: LADDER.index(r) if r in LADDER else len(LADDER))

    @property
    def rate_free(self) -> bool:
        """Whether no part looks at the body rate."""
        return all(not sees_rate(part) for part in self.parts)

    @property
    def jump_times(self) -> Float[Array, " n"]:
        """The times of all parts, s, in order."""
        times = [jumps_of(part) for part in self.parts]
        times = [found for found in times if found.shape[0]]
        if not times:
            return jnp.zeros(0)
        dtype = jnp.result_type(*times)
        return jnp.sort(jnp.concatenate([found.astype(dtype) for found in times]))

    def __call__(self, t: ScalarLike, state: Any, body: Any) -> Vec3 | Wrench:
        forces, torque = [], None
        for part in self.parts:
            force, more = act(part, t, state, body)
            torque = more if torque is None else torque + more
            forces += [] if force is None else [force]
        if not forces:
            return torque  # pyright: ignore[reportReturnType]
        return Wrench(sum(forces[1:], forces[0]), torque)


class FromPotential(AbstractTorque):
    """The torque of any potential `U(q)` on the attitude, by differentiation.

    **Arguments:** `potential` a callable Module `q → U`, J, with `q` (4,) unit, body → world.

    `τ_i = −∂U/∂q · ½ q ⊗ e_i`, the derivative along a turn about body axis i. Source: Landau and
    Lifshitz, Mechanics, §34.

    **Raises:** `TypeError` for what cannot be called, `ValueError` for a U that is not a number.

    >>> class Spring(eqx.Module):
    ...     k: Array
    ...     def __call__(self, q):
    ...         return 2.0 * self.k * (q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    >>> from rigidjax import Attitude, quaternion
    >>> at = Attitude(quaternion.exp(jnp.array([0.0, 0.0, 1e-3])), [0.0, 0, 0])
    >>> FromPotential(Spring(jnp.array(2.0)))(0.0, at, None).round(5).tolist()
    [-0.0, -0.0, -0.002]
    """

    feels: ClassVar[type] = HasAttitude
    rate_free: ClassVar[bool] = True
    potential: Callable[[Any], Any]

    def __init__(self, potential: Callable[[Any], Any]):
        self.potential = _checks.function(potential, "potential", "q → U, J")

    @property
    def steady(self) -> bool:
        """It does not depend on time."""
        return True

    def energy(self, t: ScalarLike, state: HasAttitude, body: object) -> Scalar:
        """Potential energy, J."""
        return self._value(state.q)

    def __call__(self, t: ScalarLike, state: HasAttitude, body: object) -> Vec3:
        w, x, y, z = state.q
        dw, dx, dy, dz = jax.grad(self._value)(state.q)
        return -0.5 * jnp.stack(
            [
                -x * dw + w * dx + z * dy - y * dz,
                -y * dw - z * dx + w * dy + x * dz,
                -z * dw + y * dx - x * dy + w * dz,
            ]
        )

    def _value(self, q):
        return _checks.floating(self.potential(q), (), "potential", hint="one number, J")
