"""A torque-free body at any time, in closed form."""

from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import HasAttitude, HasSpin, Mat3, Quat, Scalar, ScalarLike, Vec3
from rigidjax.body.inertia import Inertia
from rigidjax.exact.fence import fence, opaque_one
from rigidjax.exact.flow import flow
from rigidjax.exact.frame import into, out_of, principal_frame
from rigidjax.exact.triples import Six, Triple, times

State = TypeVar("State", bound=HasSpin)


class FreeBody(eqx.Module):
    """The whole motion of a free body; call it with a time.

    What does not depend on time is worked out once. `jax.vmap(FreeBody(inertia, state0))(ts)` is
    the motion at many times.

    **Arguments:** as for `free_body`.

    >>> import rigidjax as rj
    >>> motion = FreeBody(rj.Inertia.from_principal(1.0, 2.0, 2.5), rj.Spin([0.0, 0.0, 1.0]))
    >>> motion(10.0).omega
    Array([0., 0., 1.], dtype=float64)
    """

    state0: HasSpin
    axes: Mat3
    moments: Six
    momentum: Triple
    exponent: Array

    def __init__(self, inertia: Inertia, state0: HasSpin):
        omega = state0.omega
        # Powers of two, so that scaling costs no digit and no body is too large or small.
        _, size = jnp.frexp(jax.lax.stop_gradient(jnp.max(jnp.abs(inertia.tensor))))
        _, self.exponent = jnp.frexp(jax.lax.stop_gradient(jnp.max(jnp.abs(omega))))
        tensor = jnp.ldexp(inertia.tensor, -size)
        one = opaque_one(tensor[0, 0])
        self.moments, self.axes = fence(principal_frame(tensor), one)
        rate = into(self.axes, jnp.ldexp(omega, -self.exponent))
        self.momentum = fence(times(self.moments, rate), one)
        self.state0 = state0

    def __call__(self, t: ScalarLike) -> HasSpin:
        t = _checks.floating(t, (), "t").astype(self.axes.dtype)
        momentum, (w, *axis) = flow(self.moments, self.momentum, jnp.ldexp(t, self.exponent))
        one = opaque_one(t)
        momentum, w, axis = fence((momentum, w, axis), one)
        omega = out_of(self.axes, fence(_solve(self.moments, momentum), one))
        state = eqx.tree_at(
            lambda s: s.omega, self.state0, jnp.ldexp(jnp.stack(omega), self.exponent)
        )
        if not isinstance(state, HasAttitude):
            return state
        x, y, z = fence(out_of(self.axes, tuple(axis)), one)
        return eqx.tree_at(lambda s: s.q, state, _unit_product(state.q, (w, x, y, z)))


def free_body(inertia: Inertia, state0: State, t: ScalarLike) -> State:
    """State of a free body at time t.

    PLACEHOLDER
    """
    return FreeBody(inertia, state0)(t)


@jax.custom_jvp
def _solve(moments: Six, momentum: Triple) -> Triple:
    """I⁻¹ Π for an inertia that is diagonal in value; its derivative is right to any order."""
    return tuple(p / i for p, i in zip(momentum, moments[:3], strict=True))


@_solve.defjvp
def _solve_jvp(primals, tangents):
    rate = _solve(*primals)
    turned = times(tangents[0], rate)
    return rate, _solve(
        primals[0], tuple(a - b for a, b in zip(tangents[1], turned, strict=True))
    )


def _unit_product(q: Quat, other) -> Quat:
    a, b, c, d = q[0], q[1], q[2], q[3]
    w, x, y, z = other
    out = jnp.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ]
    )
    return out / jnp.sqrt(jnp.sum(out * out))
