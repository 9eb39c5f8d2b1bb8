"""The state `Attitude`: a body that turns, with its attitude."""

from typing import TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import HasAttitude, Quat, ScalarLike
from rigidjax.body.inertia import Inertia
from rigidjax.motion.coupled import Coupled
from rigidjax.motion.spin import EulerEquations
from rigidjax.motion.torques import Torque
from rigidjax.rotation import quaternion
from rigidjax.rotation.kernels import square4
from rigidjax.rotation.linalg3 import components


class Attitude(eqx.Module):
    """Attitude and body rate: a body that turns.

    **Arguments:** `q` (4,) unit quaternion (w, x, y, z), **scalar first**, body → world (the `M` of
    the notes, eq 8); `omega` (3,) Ω in the body frame, rad/s. Leading axes are allowed in a
    container of many states; functions take one.

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype, or leading axes that differ.
    Whether `q` is a unit quaternion is checked where it is used (`simulate`,
    `rigidjax.exact.free_body`).

    >>> Attitude([1.0, 0, 0, 0], [0.0, 0, 1]).q.shape
    (4,)
    """

    q: Float[Array, "*batch 4"]
    omega: Float[Array, "*batch 3"]

    def __init__(
        self, q: Float[Array, "*batch 4"] | object, omega: Float[Array, "*batch 3"] | object
    ):
        self.q = _checks.floating(q, (4,), "q", batched=True, hint="a quaternion is (w, x, y, z)")
        self.omega = _checks.floating(omega, (3,), "omega", batched=True)
        _checks.same_batch(q=(self.q, 1), omega=(self.omega, 1))


class AttitudeEquations(eqx.Module):
    """Euler's equations and the kinematics `dq/dt = ½ q ⊗ (0, Ω)` as a vector field.

    **Arguments:** as for `EulerEquations`. A field for `diffrax.ODETerm`; `args` is not used.

    The state holds Ω, not Π = IΩ: two heavy tops at tolerances 1e-6, 1e-9, 1e-12 took the same
    number of steps with either to 3 % (diffrax.Dopri8), and ended equally far off to a third.

    Source: `dM/dt = M J'` (notes, eq 50), written for the quaternion of M.

    >>> import rigidjax as rj
    >>> field = rj.motion.AttitudeEquations(rj.Inertia.from_principal(1.0, 2.0, 3.0))
    >>> field(0.0, Attitude([1.0, 0, 0, 0], [0.0, 0, 1]), None).q
    Array([-0. ,  0. ,  0. ,  0.5], dtype=float64)
    """

    euler: EulerEquations

    def __init__(self, inertia: Inertia, torque: Torque | None = None):
        self.euler = EulerEquations(inertia, torque)

    def __call__(self, t: ScalarLike, y: HasAttitude, args: object = None) -> Attitude:
        return Attitude(quaternion.rate(y.q, y.omega), self.euler.rate_of(t, y))


State = TypeVar("State")


def on_the_group(state: State) -> State:
    """The same state with its quaternion, if it has one, scaled to length 1.

    **Raises:** `ValueError` for a quaternion known to be zero, or too short to have a direction.

    >>> import rigidjax as rj
    >>> on_the_group(rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 1])).q.tolist()
    [1.0, 0.0, 0.0, 0.0]
    """
    if isinstance(state, Coupled):
        return eqx.tree_at(lambda s: s.motion, state, on_the_group(state.motion))
    if isinstance(state, HasAttitude):
        q = _checks.floating(state.q, (4,), "state.q")
        if _checks.known(q):
            length = float(np.linalg.norm(np.asarray(q)))
            _checks.refuse(q, length**2 == 0, f"state.q: wanted a length near 1, got {length:.3g}")
        return eqx.tree_at(lambda s: s.q, state, _unit(state.q))
    return state


def _unit(q: Quat) -> Quat:
    """q/|q|, rounded alike wherever it is compiled.

    Where it can, XLA makes q/√n a product with 1/√n, and whether it can depends on the program.
    Reverse mode runs steps again in another program than the first: a last digit that differs there
    moves the error estimate, at tight tolerances the lengths of steps with it, and the gradient
    belongs to another discretisation (7e-6 off at a tolerance of 1e-11). Root and quotient by
    themselves are exact to the last digit in every program, and for every body of a batch.
    """
    return q / lax.optimization_barrier(jnp.sqrt(square4(components(q))))
