"""Derive equations of motion from any Lagrangian, such as that of a top in Euler angles."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, ArrayLike, Float

from rigidjax import _checks, _show
from rigidjax._types import HasAttitude, Scalar, ScalarLike
from rigidjax.body import validation
from rigidjax.body.inertia import Inertia
from rigidjax.motion import Attitude
from rigidjax.motion.torques.base import Torque, require_torque
from rigidjax.rotation import euler, linalg3


class Coordinates(eqx.Module):
    """Hold the state of a Lagrangian system: the coordinates and their time derivatives.

    **Arguments:**

    - `q`: (n,) generalised coordinates, in the units of the Lagrangian.
    - `rate`: (n,) their time derivatives dq/dt, in these units per second.

    >>> Coordinates([0.1, 0.2], [0.0, 1.0]).rate.shape
    (2,)
    """

    q: Float[Array, "*batch n"]
    rate: Float[Array, "*batch n"]

    __repr__ = _show.fields_as_text

    def __init__(
        self, q: Float[ArrayLike, "*batch n"] | object, rate: Float[ArrayLike, "*batch n"] | object
    ):
        self.q = _checks.numeric_array(q, "q")
        if self.q.ndim == 0 or self.q.size == 0:
            words = f"wanted generalised coordinates (n,), got {self.q.shape}; for one give [q]"
            raise ValueError(f"q: {words}")
        hint = "one rate for each coordinate"
        self.rate = _checks.array_of_shape(rate, self.q.shape, "rate", hint=hint)


class LagrangeEquations(eqx.Module):
    """Evaluate Lagrange's equations of a Lagrangian and of forces as a vector field.

    The vector field is called as `f(t, y, args)`. `lagrangian` is a function `(q, q̇) → L`, J, of
    the coordinates and their time derivatives; `force` is a function `(t, q, q̇) → Q` of the
    generalised forces, or `None`. The state y is a `Coordinates`. `equations_of_motion` makes this
    Module.

    >>> pendulum = equations_of_motion(lambda q, v: 0.5 * v[0] ** 2 + 9.81 * jnp.cos(q[0]))
    >>> round(float(pendulum.energy(Coordinates([0.0], [2.0]))), 6)  # ½ v² − 9.81 cos q
    -7.81
    """

    lagrangian: Callable[[Any, Any], Any]
    force: Callable[[Any, Any, Any], Any] | None

    def __call__(self, t: ScalarLike, y: Coordinates, args: object = None) -> Coordinates:
        q, rate = y.q, y.rate
        momentum = jax.grad(self._value, argnums=1)
        _, carried = jax.jvp(lambda x: momentum(x, rate), (q,), (rate,))
        push = jax.grad(self._value)(q, rate) - carried
        if self.force is not None:
            push = push + _checks.array_of_shape(self.force(t, q, rate), q.shape, "force")
        return Coordinates(rate, _acceleration(jax.jacfwd(lambda v: momentum(q, v))(rate), push))

    def energy(self, y: Coordinates) -> Scalar:
        """Return Jacobi's integral `q̇·∂L/∂q̇ − L` of the Lagrangian L in the state `y`, J, a
        scalar; q̇ are the rates of the coordinates.

        The integral is conserved if there is no `force`.
        """
        momentum = jax.grad(self._value, argnums=1)(y.q, y.rate)
        return jnp.sum(y.rate * momentum) - self._value(y.q, y.rate)

    def _value(self, q: Array, q_rate: Array) -> Scalar:
        """Return the Lagrangian, J; raise an error unless the user's function returns a number."""
        return _checks.array_of_shape(
            self.lagrangian(q, q_rate), (), "lagrangian", hint="one number, J"
        )


def equations_of_motion(
    lagrangian: Callable[[Any, Any], Any], force: Callable[[Any, Any, Any], Any] | None = None
) -> LagrangeEquations:
    """Return the vector field `f(t, y, args)` of any Lagrangian L(q, q̇); `y` is a `Coordinates`.

    Lagrange's equations `d/dt ∂L/∂q̇ = ∂L/∂q + Q`, with generalised forces Q, are solved for q̈:
    `(∂²L/∂q̇∂q̇) q̈ = ∂L/∂q − (∂²L/∂q̇∂q) q̇ + Q`.

    **Arguments:**

    - `lagrangian`: a callable `(q, q̇) → L`, J, with `q`, `q̇` (n,), best a Module: motions can be
      differentiated with respect to the numbers in a Module, and nothing is compiled again when
      these numbers change.
    - `force`: a callable `(t, q, q̇) → Q` (n,), the generalised forces without a potential, or
      `None`.

    **Returns** a Module, for `diffrax.ODETerm`. The linear system for q̈ is solved by cofactors for
    up to three coordinates, by LU (`lineax`) for more. Source: Landau and Lifshitz, Mechanics,
    eq 2.6; the notes mention it after eq 57.

    If the matrix ∂²L/∂q̇∂q̇ is singular (at a singularity of the coordinates, or for a coordinate
    without inertia), the result has infinities or NaN.

    >>> pendulum = equations_of_motion(lambda q, v: 0.5 * v[0] ** 2 + 9.81 * jnp.cos(q[0]))
    >>> pendulum(0.0, Coordinates([jnp.pi / 2], [0.0])).rate
    Array([-9.81], dtype=float64)
    """
    _checks.require_function(lagrangian, "lagrangian", "(q, q̇) → L, J")
    if force is not None:
        _checks.require_function(force, "force", "(t, q, q̇) → Q")
    return LagrangeEquations(lagrangian, force)


class EulerAngleTop(eqx.Module):
    """Compute the Lagrangian L = ½ Ω·IΩ − U of a body about a fixed point, in 3-1-3 Euler angles.

    **Arguments:**

    - `inertia`: the inertia I about the fixed point (about the centre of mass for a free body),
      kg m².
    - `torque`: a torque with a potential U that does not depend on time, such as `HeavyTop`, or
      `None`.

    The object is called with the angles (φ, θ, ψ), sequence 3-1-3, rad, and the time derivatives of
    these angles, rad/s, and returns L in joules; Ω is the body rate. Lagrange's equations of L are
    singular at sin θ = 0. Source: notes, eqs 33, 75, 81–83.

    **Raises:** `TypeError` for a torque without a potential.

    >>> free = EulerAngleTop(rj.Inertia.from_principal(1.0, 1.0, 2.0))
    >>> free(jnp.array([0.0, 1.0, 0.0]), jnp.array([0.0, 0.0, 2.0]))
    Array(4., dtype=float64)
    """

    inertia: Inertia
    torque: Torque | None

    def __init__(self, inertia: Inertia, torque: Torque | None = None):
        inertia = validation.require_single_body(inertia, Inertia, "inertia")
        if torque is not None:
            require_torque(torque)
        if torque is not None and not hasattr(torque, "energy"):
            raise TypeError(
                f"{type(torque).__name__} has no potential (no method energy(t, state, body)): "
                "give it as the generalised force of equations_of_motion"
            )
        self.inertia, self.torque = inertia, torque

    def __call__(self, q: Float[ArrayLike, "3"], rate: Float[ArrayLike, "3"]) -> Scalar:
        omega = euler.rates_to_omega(q, rate)
        kinetic = 0.5 * linalg3.dot(omega, linalg3.apply(self.inertia.tensor, omega))
        if self.torque is None:
            return kinetic
        state = Attitude(euler.to_quaternion(q), omega)
        potential: Any = self.torque
        return kinetic - potential.energy(0.0, state, self.inertia)


def to_attitude(y: Coordinates) -> Attitude:
    """Return the attitude and body rate that belong to Euler angles and their time derivatives.

    **Arguments:** `y` with `q` the 3-1-3 Euler angles (φ, θ, ψ), rad, and `rate` their time
    derivatives, rad/s. Source: notes, eqs 33, 81–83.

    >>> to_attitude(Coordinates([0.0, 0.0, 0.0], [0.0, 0.0, 2.0])).omega.tolist()
    [0.0, 0.0, 2.0]
    """
    _checks.require_instance(y, Coordinates, "y")
    _checks.array_of_shape(y.q, (3,), "y.q", hint="three Euler angles")
    return Attitude(euler.to_quaternion(y.q), euler.rates_to_omega(y.q, y.rate))


def from_attitude(state: HasAttitude) -> Coordinates:
    """Return the 3-1-3 Euler angles of an attitude and a body rate, with their time derivatives.

    **Arguments:** `state` with `.q` (4,), body → world, and `.omega` (3,), rad/s. **Raises:**
    `ValueError` (`EquinoxRuntimeError` under `jit`) at sin θ = 0, where the angles are not unique
    and the rates do not exist.

    >>> back = from_attitude(to_attitude(Coordinates([0.1, 0.2, 0.3], [1.0, 2.0, 3.0])))
    >>> back.rate.round(12).tolist()
    [1.0, 2.0, 3.0]
    """
    _checks.require_unbatched_instance(state, HasAttitude, "state", requirement="an Attitude")
    angles = euler.from_quaternion(state.q)
    words = "from_attitude: Euler angles (3-1-3) are singular at sin θ = 0; solve for an Attitude"
    angles = _checks.error_if(angles, euler.is_singular(angles), words)
    return Coordinates(angles, euler.omega_to_rates(angles, state.omega))


def _acceleration(
    mass_matrix: Float[Array, "n n"], generalised_force: Float[Array, " n"]
) -> Float[Array, " n"]:
    """Return q̈, the solution of M q̈ = F with M = ∂²L/∂q̇∂q̇."""
    n = generalised_force.shape[0]
    if n == 1:
        return generalised_force / mass_matrix[0]
    if n == 2:
        (a, b), (c, d) = mass_matrix
        x, y = generalised_force
        return jnp.stack([d * x - b * y, a * y - c * x]) / (a * d - b * c)
    if n == 3:
        return linalg3.solve(mass_matrix, generalised_force)
    return lx.linear_solve(
        lx.MatrixLinearOperator(mass_matrix), generalised_force, lx.LU(), throw=False
    ).value
