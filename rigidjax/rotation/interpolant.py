"""A smooth attitude through attitudes and body rates."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from rigidjax import _checks
from rigidjax._types import Quat, Scalar, ScalarLike, Vec3
from rigidjax.rotation import quaternion, so3


class AttitudeInterpolant(eqx.Module):
    """Attitude q(t) and body rate Ω(t), both continuous, through given ones.

    Between two knots q(t) = q_0 exp(v(s)), with v the cubic with the given ends and slopes in the
    Lie algebra (Hermite; cf. Park & Ravani 1997, doi:10.1145/256157.256160). q(t) is a rotation
    everywhere; the error between knots falls as the fourth power of their distance.

    **Arguments:** `ts` (n,) s, increasing, n ≥ 2; `qs` (n, 4) unit, body → world, either sign;
    `omegas` (n, 3) rad/s, body frame. The body must turn by less than half a turn between knots:
    the shorter way is taken. **Raises:** for wrong shapes, times that do not increase, and
    quaternions that `quaternion.check` refuses, under `jit` too.

    >>> still = jnp.eye(4)[:1].repeat(2, 0)
    >>> path = AttitudeInterpolant(jnp.array([0.0, 1.0]), still, jnp.zeros((2, 3)))
    >>> path(0.5).tolist()
    [1.0, 0.0, 0.0, 0.0]
    """

    ts: Float[Array, "n"]
    qs: Float[Array, "n 4"]
    omegas: Float[Array, "n 3"]

    def __init__(
        self,
        ts: Float[ArrayLike, "n"],
        qs: Float[ArrayLike, "n 4"],
        omegas: Float[ArrayLike, "n 3"],
    ) -> None:
        ts = _checks.rows(ts, (), "ts")
        if ts.shape[0] < 2:
            raise ValueError(f"ts: wanted two times or more, got shape {ts.shape}")
        self.ts = _checks.refuse(ts, ~(ts[1:] > ts[:-1]).all(), "ts: wanted increasing times")
        self.qs = quaternion.check(_checks.floating(qs, (ts.shape[0], 4), "qs"), name="qs")
        self.omegas = _checks.floating(omegas, (ts.shape[0], 3), "omegas")

    def __call__(self, t: ScalarLike) -> Quat:
        """The attitude at time t, body → world.

        **Arguments:** `t` s, within the knots (beyond them the end pieces are continued).
        """
        q0, _, v, _ = self._piece(t)
        return quaternion.multiply(q0, quaternion.exp(v))

    def omega(self, t: ScalarLike) -> Vec3:
        """The body rate at time t, rad/s, body frame: Ω = J_r(v) dv/dt.

        **Arguments:** `t` s, within the knots.
        """
        _, _, v, slope = self._piece(t)
        return so3.apply(so3.right_jacobian(v), slope)

    def _piece(self, t: ScalarLike) -> tuple[Quat, Scalar, Vec3, Vec3]:
        t = _checks.floating(t, (), "t").astype(self.ts.dtype)
        i = jnp.clip(jnp.searchsorted(self.ts, t, side="right") - 1, 0, self.ts.shape[0] - 2)
        pick = jax.tree.map(lambda x: (x[i], x[i + 1]), (self.ts, self.qs, self.omegas))
        (t0, t1), (q0, q1), (w0, w1) = pick
        h = t1 - t0
        s = (t - t0) / h
        turn = quaternion.log(quaternion.multiply(quaternion.conjugate(q0), q1))
        a, b = h * w0, h * so3.apply(so3.right_jacobian_inverse(turn), w1)
        v = s * (a + s * ((3 * turn - 2 * a - b) + s * (a + b - 2 * turn)))
        slope = (a + s * (2 * (3 * turn - 2 * a - b) + s * (3 * (a + b - 2 * turn)))) / h
        return q0, s, v, slope
