"""Derive Lie–Poisson equations from any Hamiltonian of the body's momentum."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
from jaxtyping import Array, ArrayLike, Float

from rigidjax import _checks
from rigidjax._types import HasAttitude, Mat3, Scalar, ScalarLike, Vec3, Vectors
from rigidjax.body import inertia as _inertia, validation
from rigidjax.motion.torques import HeavyTop
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import apply, cross, dot

_WANTED = "of the momentum to H, J"


class Momentum(eqx.Module):
    """Hold the state of Lie–Poisson motion: the angular momentum in the body.

    **Arguments:** `pi` (3,) Π = IΩ, N m s, body frame.

    >>> Momentum([1.0, 0.0, 0.0]).pi.shape
    (3,)
    """

    pi: Float[Array, "*batch 3"]

    def __init__(self, pi: Vectors):
        self.pi = _checks.array_of_shape(pi, (3,), "pi", batched=True)


class MomentumAndDirection(eqx.Module):
    """Hold the state of a heavy top reduced by its symmetry: momentum, and a fixed direction.

    **Arguments:** `pi` (3,) Π, N m s, body frame; `gamma` (3,) γ = Rᵀ d, body frame, of a vector d
    that is fixed in the world. Any length and unit: for `HeavyTopHamiltonian` d = g, m/s².

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
    """Evaluate `dΠ/dt = Π × ∇H(Π)` as a vector field, H the `hamiltonian`; `lie_poisson` makes
    it.
    """

    hamiltonian: Callable[[Any], Any]

    def __call__(self, t: ScalarLike, y: Momentum, args: object = None) -> Momentum:
        return Momentum(cross(y.pi, jax.grad(lambda p: _checked_scalar(self.hamiltonian(p)))(y.pi)))


class LiePoissonWithDirection(eqx.Module):
    """Evaluate the vector field of a `hamiltonian` H(Π, γ); `lie_poisson_with_direction` makes
    it.
    """

    hamiltonian: Callable[[Any, Any], Any]

    def __call__(
        self, t: ScalarLike, y: MomentumAndDirection, args: object = None
    ) -> MomentumAndDirection:
        value = lambda p, g: _checked_scalar(self.hamiltonian(p, g))  # noqa: E731
        turn, pull = jax.grad(value, argnums=(0, 1))(y.pi, y.gamma)
        return MomentumAndDirection(cross(y.pi, turn) + cross(y.gamma, pull), cross(y.gamma, turn))


def lie_poisson(hamiltonian: Callable[[Any], Any]) -> LiePoisson:
    """Return the vector field `dΠ/dt = Π × ∇H(Π)` on `Momentum`, of any Hamiltonian H(Π).

    **Arguments:** `hamiltonian` a callable, best a Module, `Π → H`, J, with Π (3,), N m s, body
    frame; ∇H is then the body rate Ω. For `½ Π·I⁻¹Π`, `RotationalHamiltonian(inertia)`, these are
    Euler's equations. H and the Casimir |Π|² are conserved. Source: Marsden and Ratiu, Introduction
    to Mechanics and Symmetry, §§1.2, 1.3.

    >>> H = RotationalHamiltonian(rj.Inertia.from_principal(1.0, 2.0, 2.0))
    >>> lie_poisson(H)(0.0, Momentum([1.0, 1.0, 1.0])).pi
    Array([ 0. ,  0.5, -0.5], dtype=float64)
    """
    return LiePoisson(_checks.require_function(hamiltonian, "hamiltonian", _WANTED))


def lie_poisson_with_direction(hamiltonian: Callable[[Any, Any], Any]) -> LiePoissonWithDirection:
    """Return the heavy-top vector field of any H(Π, γ): `dΠ/dt = Π × ∂H/∂Π + γ × ∂H/∂γ`, `dγ/dt = γ
    × ∂H/∂Π`.

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
    _checks.require_single(inertia, _inertia.Inertia, "inertia")
    return validation.check_body(inertia, inertia.tensor, None, throw=False)


class RotationalHamiltonian(eqx.Module):
    """Compute H = ½ Π·I⁻¹Π, the energy of rotation, J, a function of Π (3,).

    **Arguments:** `inertia` about the centre of mass or a fixed point. **Raises:** `ValueError` for
    a moment known to be zero.

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
    """Compute H = ½ Π·I⁻¹Π − m c·γ with γ = Rᵀ g, the energy of a heavy top, J.

    **Arguments:** `inertia` about the fixed point; `top` a `HeavyTop`, which gives m and c. The
    object is a function of Π (3,) and γ (3,), m/s², body frame; `start` makes the state.
    **Raises:** `ValueError` for a moment known to be zero.

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
        pi, gamma = (
            _checks.array_of_shape(pi, (3,), "pi"),
            _checks.array_of_shape(gamma, (3,), "gamma"),
        )
        return 0.5 * dot(pi, apply(self.inverse, pi)) - self.top.mass * dot(self.top.com, gamma)

    def start(self, state: HasAttitude) -> MomentumAndDirection:
        """Return Π = IΩ and γ = Rᵀ g of an attitude and a body rate."""
        pi: Vec3 = apply(self.inertia.tensor, state.omega)
        return MomentumAndDirection(pi, quaternion.rotate_inverse(state.q, self.top.gravity))


def _checked_scalar(value):
    return _checks.array_of_shape(value, (), "hamiltonian", hint="one number, J")
