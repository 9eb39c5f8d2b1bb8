"""The state `Spin`: the body rate alone. Euler's equations in the body frame."""

import equinox as eqx
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import HasSpin, Mat3, ScalarLike, Vec3
from rigidjax.body import inertia as _inertia, validation
from rigidjax.motion.torques import Torque
from rigidjax.motion.torques.base import evaluate, require_law
from rigidjax.rotation import linalg3

_HINT = "Inertia.from_tensor makes one of a matrix; of MassProperties pass .inertia"


class Spin(eqx.Module):
    """A body rate and nothing else: a body that turns, its attitude left out.

    **Arguments:** `omega` (3,) angular velocity Ω in the body frame, rad/s (notes, eq 49). Leading
    axes are allowed in a container of many states; functions take one.

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype.

    >>> Spin([1.0, 0.0, 0.0]).omega.shape
    (3,)
    """

    omega: Float[Array, "*batch 3"]

    def __init__(self, omega: Float[Array, "*batch 3"] | object):
        self.omega = _checks.floating(omega, (3,), "omega", batched=True)


class EulerEquations(eqx.Module):
    """Euler's equations `I dΩ/dt = IΩ × Ω + τ` as a vector field `f(t, y, args)`.

    **Arguments:** `inertia` the body, about the point that it turns about; `torque` τ in the body
    frame, N m, or `None` for a free body. A field for `diffrax.ODETerm`; `args` is not used. Its
    values are in the precision of `state.omega`.

    Source: Lie–Poisson form `dΠ/dt = Π × ∇H(Π) + τ` with `Π = IΩ`, `H = ½ Π·I⁻¹Π`; Landau and
    Lifshitz, Mechanics, eq 36.4.

    **Raises:** `ValueError` for a rod or a point, whose zero moment the equations divide by: where
    the numbers are known; under `jit` call `Inertia.invertible` first.

    >>> import rigidjax as rj
    >>> EulerEquations(rj.Inertia.from_principal(1.0, 2.0, 3.0))(0.0, Spin([1.0, 1, 1]), None)
    Spin(omega=f64[3])
    """

    inertia: _inertia.Inertia
    inverse: Mat3
    torque: Torque | None

    def __init__(self, inertia: _inertia.Inertia, torque: Torque | None = None):
        _checks.single(inertia, _inertia.Inertia, "inertia", hint=_HINT)
        if torque is not None:
            require_law(torque)
        # Traced numbers are looked at where a motion is asked for: a fit may pass through such.
        self.inertia = inertia.invertible() if validation.known(inertia.tensor) else inertia
        # Once per solve: a division inside the field costs 25 times the rest of it.
        self.inverse = _inertia.inverse(inertia.tensor)
        self.torque = torque

    def __call__(self, t: ScalarLike, y: HasSpin, args: object = None) -> Spin:
        return Spin(self.rate_of(t, y))

    def rate_of(self, t: ScalarLike, state: HasSpin) -> Vec3:
        """dΩ/dt (3,), rad/s², body frame, of any state that has a spin."""
        torque = None
        if self.torque is not None:
            torque = evaluate(self.torque, t, state, self.inertia)
        return self.turned_by(torque, state)

    def turned_by(self, torque: Vec3 | None, state: HasSpin) -> Vec3:
        """dΩ/dt (3,), rad/s², body frame, under a torque (3,), N m, body frame, that is known."""
        dtype = state.omega.dtype
        momentum = _inertia.apply(self.inertia.tensor.astype(dtype), state.omega)
        turning = linalg3.cross(momentum, state.omega)
        if torque is not None:
            turning = turning + torque
        return _inertia.apply(self.inverse.astype(dtype), turning)
