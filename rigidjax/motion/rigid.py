"""The state `Rigid`: a body that turns and moves. Newton–Euler about the centre of mass."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import HasPose, ScalarLike
from rigidjax.body.inertia import MassProperties
from rigidjax.motion.spin import EulerEquations
from rigidjax.motion.torques import Torque
from rigidjax.motion.torques.base import act
from rigidjax.rotation import quaternion


class Rigid(eqx.Module):
    """Position and velocity of the centre of mass, attitude, body rate: a body that moves.

    **Arguments:** `x` (3,) position of the centre of mass, m, world frame (the `X` of the notes,
    eq 1); `v` (3,) its velocity, m/s, world frame; `q` (4,) unit quaternion (w, x, y, z), scalar
    first, body → world; `omega` (3,) Ω in the body frame, rad/s. Leading axes are allowed in a
    container of many states; functions take one.

    **Raises:** `ValueError`, `TypeError` for a wrong shape or dtype, or leading axes that differ.

    >>> Rigid([0.0, 0, 0], [1.0, 0, 0], [1.0, 0, 0, 0], [0.0, 0, 1]).v.shape
    (3,)
    """

    x: Float[Array, "*batch 3"]
    v: Float[Array, "*batch 3"]
    q: Float[Array, "*batch 4"]
    omega: Float[Array, "*batch 3"]

    def __init__(
        self,
        x: Float[Array, "*batch 3"] | object,
        v: Float[Array, "*batch 3"] | object,
        q: Float[Array, "*batch 4"] | object,
        omega: Float[Array, "*batch 3"] | object,
    ):
        self.x = _checks.floating(x, (3,), "x", batched=True)
        self.v = _checks.floating(v, (3,), "v", batched=True)
        self.q = _checks.floating(q, (4,), "q", batched=True, hint="a quaternion is (w, x, y, z)")
        self.omega = _checks.floating(omega, (3,), "omega", batched=True)
        _checks.same_batch(x=(self.x, 1), v=(self.v, 1), q=(self.q, 1), omega=(self.omega, 1))


class NewtonEuler(eqx.Module):
    """Newton–Euler equations about the centre of mass as a vector field `f(t, y, args)`.

    `m dv/dt = F`, `I dΩ/dt = IΩ × Ω + τ`, `dq/dt = ½ q ⊗ (0, Ω)`.

    **Arguments:** `body` mass properties; the inertia used is the one about its centre of mass;
    `torque` a torque τ about the centre of mass, N m, body frame, or a force law that returns a
    `Wrench` (F in N, world frame, and τ), or `None`. A field for `diffrax.ODETerm`; `args` is not
    used.

    Source: notes, eqs 1, 50, 56, 84.

    **Raises:** as `EulerEquations`.

    >>> import rigidjax as rj
    >>> field = rj.motion.NewtonEuler(rj.shapes.box(2.0, [0.1, 0.2, 0.3]))
    >>> field(0.0, Rigid([0.0, 0, 0], [1.0, 0, 0], [1.0, 0, 0, 0], [0.0, 0, 1]), None).x
    Array([1., 0., 0.], dtype=float64)
    """

    euler: EulerEquations
    body: MassProperties

    def __init__(self, body: MassProperties, torque: Torque | None = None):
        _checks.single(body, MassProperties, "body", hint="an Inertia has no mass")
        self.euler = EulerEquations(body.inertia, torque)
        self.body = body

    def __call__(self, t: ScalarLike, y: HasPose, args: object = None) -> Rigid:
        force, torque = None, None
        if self.euler.torque is not None:
            force, torque = act(self.euler.torque, t, y, self.body)
        if force is None:
            acceleration = jnp.zeros_like(y.v)
        else:
            acceleration = force / self.body.mass.astype(y.v.dtype)
        spin = self.euler.turned_by(torque, y)
        return Rigid(y.v, acceleration, quaternion.rate(y.q, y.omega), spin)
