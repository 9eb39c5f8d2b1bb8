"""Derive Lie–Poisson equations from any Hamiltonian of the angular momentum of a body."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
from jaxtyping import Array, ArrayLike, Float

from rigidjax import _checks, _show
from rigidjax._types import HasAttitude, Mat3, Scalar, ScalarLike, Vec3, Vectors
from rigidjax.body import inertia as _inertia, validation
from rigidjax.motion.torques import HeavyTop
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import apply, cross, dot

_WANTED = "of the momentum to H, J"


class Momentum(eqx.Module):
    """Hold the state of a Lie–Poisson motion: the angular momentum, in body axes.

    **Arguments:** `pi` (3,) the angular momentum Π = IΩ, N m s, body frame.

    >>> Momentum([1.0, 0.0, 0.0]).pi.shape
    (3,)
    """

    pi: Float[Array, "*batch 3"]

    __repr__ = _show.fields_as_text

    def __init__(self, pi: Vectors):
        self.pi = _checks.array_of_shape(pi, (3,), "pi", batched=True)


class MomentumAndDirection(eqx.Module):
    """Hold the state of a heavy top: the angular momentum, and a vector fixed in the world (such as
    the acceleration of gravity), both in body axes.

    The attitude itself is not needed, because the equations do not change if the body is turned
    about this vector.

    **Arguments:**

    - `pi`: (3,) the angular momentum Π, N m s, body frame.
    - `gamma`: (3,) the vector γ = Rᵀ d, body frame, where d is a vector fixed in the world and R
      the attitude, body → world. d has any length and unit; for `HeavyTopHamiltonian` it is the
      acceleration of gravity g, m/s².

    >>> MomentumAndDirection([1.0, 0.0, 0.0], [0.0, 0.0, -9.81]).gamma.shape
    (3,)
    """

    pi: Float[Array, "*batch 3"]
    gamma: Float[Array, "*batch 3"]

    def __init__(self, pi: Vectors, gamma: Vectors):
        self.pi = _checks.array_of_shape(pi, (3,), "pi", batched=True)
        self.gamma = _checks.array_of_shape(gamma, (3,), "gamma", batched=True)
        _checks.require_same_batch(pi=(self.pi, 1), gamma=(self.gamma, 1))


class LiePoisson(eqx.Module):
    """Evaluate `dΠ/dt = Π × ∇H(Π)` as a vector field `f(t, y, args)`, whose state is a `Momentum`.

    Π (3,) is the angular momentum in body axes, N m s, and H is the `hamiltonian`, a function
    `Π → H`, J. `lie_poisson` makes this Module.
    """

    hamiltonian: Callable[[Any], Any]

    def __call__(self, t: ScalarLike, y: Momentum, args: object = None) -> Momentum:
        return Momentum(cross(y.pi, jax.grad(lambda p: _one_energy(self.hamiltonian(p)))(y.pi)))


class LiePoissonWithDirection(eqx.Module):
    """Evaluate the Lie–Poisson equations of a Hamiltonian H(Π, γ) as a vector field.

    Π (3,) is the angular momentum, N m s, and γ (3,) a vector fixed in the world, both in body
    axes; `hamiltonian` is the function `(Π, γ) → H`, J. The state is a `MomentumAndDirection`. The
    equations are dΠ/dt = Π × ∂H/∂Π + γ × ∂H/∂γ and dγ/dt = γ × ∂H/∂Π. `lie_poisson_with_direction`
    makes this Module.
    """

    hamiltonian: Callable[[Any, Any], Any]

    def __call__(
        self, t: ScalarLike, y: MomentumAndDirection, args: object = None
    ) -> MomentumAndDirection:
        value = lambda p, g: _one_energy(self.hamiltonian(p, g))  # noqa: E731
        turn, pull = jax.grad(value, argnums=(0, 1))(y.pi, y.gamma)
        return MomentumAndDirection(cross(y.pi, turn) + cross(y.gamma, pull), cross(y.gamma, turn))


def lie_poisson(hamiltonian: Callable[[Any], Any]) -> LiePoisson:
    """Return the vector field `dΠ/dt = Π × ∇H(Π)` of any Hamiltonian H(Π) of the momentum Π.

    **Arguments:**

    - `hamiltonian`: a callable, best a Module, `Π → H`, J, with the angular momentum Π (3,), N m s,
      body frame; ∇H is then the body rate Ω.

    **Returns** a function `f(t, y, args)`, whose state y is a `Momentum`. For H = ½ Π·I⁻¹Π, which
    is `RotationalHamiltonian(inertia)`, the equations are Euler's. H and the Casimir |Π|² are
    conserved. Source: Marsden and Ratiu, Introduction to Mechanics and Symmetry, §§1.2, 1.3.

    >>> H = RotationalHamiltonian(rj.Inertia.from_principal(1.0, 2.0, 2.0))
    >>> lie_poisson(H)(0.0, Momentum([1.0, 1.0, 1.0])).pi
    Array([ 0. ,  0.5, -0.5], dtype=float64)
    """
    return LiePoisson(_checks.require_function(hamiltonian, "hamiltonian", _WANTED))


def lie_poisson_with_direction(hamiltonian: Callable[[Any, Any], Any]) -> LiePoissonWithDirection:
    """Return the heavy-top vector field of any Hamiltonian H(Π, γ).

    The equations are `dΠ/dt = Π × ∂H/∂Π + γ × ∂H/∂γ` and `dγ/dt = γ × ∂H/∂Π`, with the angular
    momentum Π (3,), N m s, and a world-fixed vector γ (3,), both in the body frame; the state is a
    `MomentumAndDirection`.

    **Arguments:** `hamiltonian` a callable, best a Module, `(Π, γ) → H`, J; for a heavy top
    `HeavyTopHamiltonian(inertia, top)`. H and the Casimirs |γ|² and Π·γ are conserved. Source: the
    Lie–Poisson equations of se(3)*; Marsden and Ratiu, Introduction to Mechanics and Symmetry,
    §1.4.

    >>> field = lie_poisson_with_direction(lambda p, g: 0.5 * dot(p, p) - g[2])
    >>> field(0.0, MomentumAndDirection([0.0, 0, 1], [1.0, 0, 0])).pi.tolist()
    [0.0, 1.0, 0.0]
    """
    return LiePoissonWithDirection(_checks.require_function(hamiltonian, "hamiltonian", _WANTED))


def _require_invertible(inertia: _inertia.Inertia) -> _inertia.Inertia:
    """Return the inertia of one body, or raise an error if a moment is zero or no real body has the
    moments; a traced inertia becomes NaN in these cases.
    """
    _checks.require_unbatched_instance(inertia, _inertia.Inertia, "inertia")
    return validation.require_physical_body(inertia, throw=False)


class RotationalHamiltonian(eqx.Module):
    """Compute the energy of rotation H = ½ Π·I⁻¹Π, J, of the angular momentum Π (3,), body frame.

    **Arguments:** `inertia` is the inertia I about the centre of mass or a fixed point, kg m².

    **Raises:** `ValueError` for a principal moment that is zero and not traced by JAX.

    >>> RotationalHamiltonian(rj.Inertia.from_principal(1.0, 1.0, 2.0))([0.0, 0.0, 2.0])
    Array(1., dtype=float64)
    """

    inverse: Mat3

    def __init__(self, inertia: _inertia.Inertia):
        self.inverse = _inertia.inverse(_require_invertible(inertia).tensor)

    def __call__(self, pi: Float[ArrayLike, "3"] | list[float]) -> Scalar:
        pi = _checks.array_of_shape(pi, (3,), "pi")
        return 0.5 * dot(pi, apply(self.inverse, pi))


class HeavyTopHamiltonian(eqx.Module):
    """Compute the energy of a heavy top, H = ½ Π·I⁻¹Π − m c·γ, J.

    **Arguments:**

    - `inertia`: the inertia I about the fixed point, kg m².
    - `top`: a `HeavyTop`, which gives the mass m in kilograms and the centre of mass c in metres,
      body frame.

    The object is a function of the angular momentum Π (3,), in N m s, and of gravity γ = Rᵀ g (3,),
    both in the body frame. Here g is the acceleration of gravity in world axes, in metres per
    second squared, and R is the attitude, body → world. The method `start` makes the initial state
    for `lie_poisson_with_direction` from an attitude and a body rate.

    **Raises:** `ValueError` for a principal moment that is zero and not traced by JAX.

    >>> top = rj.torques.HeavyTop(2.0, [0.0, 0, 0.5], [0.0, 0, -9.81])
    >>> H = HeavyTopHamiltonian(rj.Inertia.from_principal(1.0, 1.0, 2.0), top)
    >>> H([0.0, 0.0, 2.0], [0.0, 0.0, -9.81])
    Array(10.81, dtype=float64)
    """

    inertia: _inertia.Inertia
    inverse: Mat3
    top: HeavyTop

    def __init__(self, inertia: _inertia.Inertia, top: HeavyTop):
        self.inertia = _require_invertible(inertia)
        hint = "this Hamiltonian is for gravity alone"
        self.top = _checks.require_instance(top, HeavyTop, "top", hint=hint)
        self.inverse = _inertia.inverse(self.inertia.tensor)

    def __call__(
        self, pi: Float[ArrayLike, "3"] | list[float], gamma: Float[ArrayLike, "3"] | list[float]
    ) -> Scalar:
        pi = _checks.array_of_shape(pi, (3,), "pi")
        gamma = _checks.array_of_shape(gamma, (3,), "gamma")
        return 0.5 * dot(pi, apply(self.inverse, pi)) - self.top.mass * dot(self.top.com, gamma)

    def start(self, state: HasAttitude) -> MomentumAndDirection:
        """Return the initial state of the heavy top for `lie_poisson_with_direction`, a
        `MomentumAndDirection`: the angular momentum Π = IΩ and the gravity γ = Rᵀ g, both in body
        axes, where g is the acceleration of gravity of the `top` in world axes.

        `state` has the attitude R (a quaternion `q`, body → world) and the body rate Ω, rad/s.
        """
        pi: Vec3 = apply(self.inertia.tensor, state.omega)
        return MomentumAndDirection(pi, quaternion.rotate_inverse(state.q, self.top.gravity))


def _one_energy(value: Any) -> Scalar:
    """Return what the user's Hamiltonian returned, J, or raise an error unless it is one number."""
    return _checks.array_of_shape(value, (), "hamiltonian", hint="one number, J")
