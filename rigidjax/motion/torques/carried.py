"""Define the motion of a body that a hand, a robot or a table carries along a logged path."""

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from rigidjax import _checks, _show
from rigidjax._types import HasPose, Quaternions, Scalar, ScalarLike, Vec3, Vectors
from rigidjax.body.inertia import MassProperties, apply
from rigidjax.motion.torques.base import AbstractForce, Wrench
from rigidjax.motion.torques.inputs import Input
from rigidjax.motion.torques.spline import Series
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import cross


class Kinematics(NamedTuple):
    """Hold the motion of a frame that is fixed in a body, at one time.

    **Fields:** `x` (3,) m, `v` (3,) m/s and `a` (3,) m/s² of the frame's origin, world frame; `q`
    (4,) frame → world; `omega` (3,) rad/s and `alpha` (3,) rad/s², body frame.
    """

    x: Vec3
    v: Vec3
    a: Vec3
    q: Float[Array, "4"]
    omega: Vec3
    alpha: Vec3


class LoggedMotion(eqx.Module):
    """Interpolate the logged motion of a frame that is fixed in a body, as a function of time.

    Cubic splines (`Series`) go through all samples; beyond the ends the motion is that at the end.
    What is not given is a derivative of these splines: velocity and acceleration of the position,
    body rate and its derivative of the attitude. Noise of the samples stays in the splines, and a
    second derivative multiplies it by about 6/step²: of noisy poses alone take
    `LoggedMotion.from_poses`.

    **Arguments**, each with one row for each time:

    - `t`: (n,) s, evenly spaced, at least four.
    - `x`: (n, 3) m, the place of the frame's origin, world frame.
    - `q`: (n, 4) unit quaternions (w, x, y, z), frame → world; q and −q mean the same.
    - `omega`: (n, 3) rad/s, the rate of the frame, in its own axes, or `None`.
    - `acceleration`: (n, 3) m/s², d²x/dt² of the origin in the **frame's** axes, without gravity,
      or `None`.
    - `alpha`: (n, 3) rad/s², dΩ/dt in the frame's axes, or `None`.

    **Raises:** `ValueError` for shapes that do not fit, uneven times, NaN, and for quaternions that
    are not of unit length.

    >>> t = jnp.linspace(0.0, 1.0, 11)
    >>> turn = jnp.stack([jnp.cos(t), 0 * t, 0 * t, jnp.sin(t)], axis=1)
    >>> motion = LoggedMotion(t, jnp.stack([t**2, 0 * t, 0 * t], axis=1), turn)
    >>> now = motion(0.55)
    >>> round(float(now.a[0]), 9), round(float(now.omega[2]), 3)
    (2.0, 2.0)
    """

    pose: Series
    end: Scalar
    omega: Series | None
    acceleration: Series | None
    alpha: Series | None

    __repr__ = _show.fields_as_text

    def __init__(
        self,
        t: Float[ArrayLike, " n"],
        x: Vectors,
        q: Quaternions,
        omega: Vectors | None = None,
        acceleration: Vectors | None = None,
        alpha: Vectors | None = None,
    ):
        poses = _poses(x, q)
        self.pose = _spline(t, poses, "x or q")
        length = (poses.shape[0] - 1) * self.pose.step
        self.end = self.pose.start + length * (1.0 - 8.0 * jnp.finfo(length.dtype).eps)
        rows = ("omega", omega), ("acceleration", acceleration), ("alpha", alpha)
        self.omega, self.acceleration, self.alpha = (
            None if one is None else _spline(t, one, name) for name, one in rows
        )

    @staticmethod
    def from_poses(
        t: Float[ArrayLike, " n"] | Sequence[float], x: Vectors, q: Quaternions
    ) -> "LoggedMotion":
        """Return the smooth motion through noisy poses, whose times may be uneven.

        Position and attitude are fitted by splines of degree 5 with even knots. Their number is
        that of the least generalised cross-validation (Craven and Wahba 1979,
        doi:10.1007/BF01404567), so that white noise is averaged over the time in which the motion
        changes. Rates and accelerations are derivatives of the splines. With poses of 0.1 mm and
        0.02° at 100 Hz, of a hand that turns a tool, the accelerations were right to 2 to 7 mm/s²,
        dΩ/dt to 0.01 to 0.02 rad/s²; at the ends of the log to 0.2 m/s² and 0.5 rad/s² only.

        **Arguments:** `t` (n,) s, increasing, at least 12; `x` (n, 3) m and `q` (n, 4) as for
        `LoggedMotion`; the numbers must be known. **Raises** `ValueError` as `LoggedMotion`, and
        for fewer than 12 times.

        >>> t = np.linspace(0.0, 1.0, 101)
        >>> turn = np.stack([np.cos(t), 0 * t, 0 * t, np.sin(t)], axis=1)
        >>> noisy = turn + 1e-5 * np.random.default_rng(0).normal(size=turn.shape)
        >>> motion = LoggedMotion.from_poses(t, np.zeros((101, 3)), noisy)
        >>> bool(abs(motion(0.5).omega[2] - 2.0) < 1e-3)
        True
        """
        times = _checks.require_finite(_checks.host_array(t, "from_poses: t"), "from_poses: t")
        rows = _checks.host_array(_poses(x, q), "from_poses: x and q")
        if times.shape != rows.shape[:1] or times.size < 12 or not (np.diff(times) > 0).all():
            words = f"got shapes {times.shape} and {rows.shape[:1]}"
            raise ValueError(f"from_poses: wanted t, x, q of 12 or more increasing times, {words}")
        grid = np.linspace(times[0], times[-1], times.size)
        path, turning = _smoothing_spline(times, rows[:, :3]), _smoothing_spline(times, rows[:, 3:])
        length = np.linalg.norm(turning(grid), axis=1)[:, None]
        poses = path(grid), turning(grid) / length
        # The rates and accelerations are those of the smooth splines, not of the cubic ones.
        p, dp, ddp = (turning(grid, order) / length for order in range(3))
        back = jnp.asarray(p * [1.0, -1.0, -1.0, -1.0])
        body = jax.vmap(lambda a, b: 2.0 * quaternion.multiply(a, b)[1:])
        omega = body(back, jnp.asarray(dp))
        alpha = body(back, jnp.asarray(ddp)) - 2.0 * np.sum(p * dp, axis=1)[:, None] * omega
        lifted = jax.vmap(quaternion.rotate)(back, jnp.asarray(path(grid, 2)))
        return LoggedMotion(grid, *poses, omega, lifted, alpha)

    def __call__(self, t: ScalarLike) -> Kinematics:
        """Return the motion of the frame at the time `t`, s."""
        # A spline is constant beyond its ends, where its derivatives are zero: at the last sample
        # itself round-off would decide. (A table that was padded to the length of another goes on.)
        now = _checks.array_of_shape(t, (), "t").astype(self.end.dtype)
        t = jnp.minimum(jnp.maximum(now, self.pose.start), self.end)

        def pose(t: Array) -> tuple[Array, Array]:
            row = self.pose(t)
            return row[:3], row[3:] / jnp.sqrt(jnp.sum(row[3:] ** 2))

        def moving(t: Array) -> tuple[Vec3, Vec3]:
            (_, q), (v, dq) = jax.jvp(pose, (t,), (jnp.ones_like(t),))
            if self.omega is not None:
                return v, self.omega(t)
            return v, 2.0 * quaternion.multiply(quaternion.conjugate(q), dq)[1:]

        (v, omega), (a, alpha) = jax.jvp(moving, (t,), (jnp.ones_like(t),))
        x, q = pose(t)
        a = a if self.acceleration is None else quaternion.rotate(q, self.acceleration(t))
        return Kinematics(x, v, a, q, omega, alpha if self.alpha is None else self.alpha(t))


def _poses(x: Vectors, q: Quaternions) -> Float[Array, "n 7"]:
    """Return positions and unit quaternions, which never change their sign, after checks."""
    place = _checks.array_of_shape(x, (3,), "x", batched=True, unit="m")
    turn = _checks.array_of_shape(q, (4,), "q", batched=True, hint="w, x, y, z")
    turn = turn.astype(jnp.result_type(float))
    if turn.shape[:-1] != place.shape[:-1] or turn.ndim != 2:
        words = f"got shapes {place.shape} and {turn.shape}"
        raise ValueError(f"LoggedMotion: wanted x (n, 3) and q (n, 4), {words}")
    place, turn = (
        _checks.check_if_known(_checks.require_finite, value, name)
        for value, name in ((place, "x"), (turn, "q"))
    )
    length = jnp.sqrt(jnp.sum(turn * turn, axis=1))
    wrong = ~(jnp.abs(length - 1.0).max(initial=0.0) < 1e-3)
    turn = _checks.error_if(turn, wrong, "LoggedMotion: q: wanted quaternions of unit length")
    signs = jnp.where(jnp.sum(turn[1:] * turn[:-1], axis=1) < 0.0, -1.0, 1.0)
    turn = turn / length[:, None]
    turn = turn.at[1:].multiply(jnp.cumprod(signs).astype(turn.dtype)[:, None])
    return jnp.concatenate([place.astype(turn.dtype), turn], axis=1)


def _motion(value: Any) -> Any:
    """Return a function of time, or an `Input`, which stands for one."""
    if isinstance(value, Input):
        return value
    return _checks.require_function(value, "motion", "of time to Kinematics")


def _spline(t: Any, rows: Any, name: str) -> Series:
    """Return the spline through logged vectors; `name` is their name in errors."""
    size = 7 if name == "x or q" else 3
    try:
        return Series(t, _checks.array_of_shape(rows, (size,), name, batched=True))
    except ValueError as error:
        raise ValueError(f"LoggedMotion: {name}: {error}") from None


def _smoothing_spline(t: Float[np.ndarray, " n"], rows: Float[np.ndarray, "n k"]) -> Any:
    """Return the spline of degree 5 with the least generalised cross-validation."""
    from scipy.interpolate import make_lsq_spline

    best: tuple[float, Any] = np.inf, None
    for pieces in np.unique(np.geomspace(1, t.size / 3, 24).astype(int)):
        ends = np.repeat([t[0], t[-1]], 5)
        knots = np.sort(np.concatenate([ends, np.linspace(t[0], t[-1], pieces + 1)]))
        try:
            spline = make_lsq_spline(t, rows, knots, 5)
        except ValueError:  # times are so uneven that a piece has too few
            break
        left = np.sum((spline(t) - rows) ** 2) / (1.0 - (pieces + 5) / t.size) ** 2
        if left < best[0]:
            best = left, spline
    if best[1] is None:
        raise ValueError(
            "from_poses: found no spline through x or q: they overflow, or t is uneven"
        )
    return best[1]


class Carried(AbstractForce):
    """Apply the wrench that carries a body along a given motion.

    In a `Model` the motion of the recording is then the logged one: no state is integrated, and no
    initial state is free. A `ForceTorque` sensor reads the wrench of the support, from which a fit
    finds all ten numbers of the body. The wrench needs no inverse of the inertia: the body may be a
    rod or a point.

    **Arguments:** `motion` a function of time t, s, that returns the `Kinematics` of the body
    frame, such as a `LoggedMotion`; by default the input `"motion"` of the recording. Source:
    `F = m a`, `τ = I dΩ/dt + Ω × IΩ` about the centre of mass (notes, eqs 1, 56).

    >>> t = jnp.linspace(0.0, 1.0, 11)
    >>> still = jnp.tile(jnp.array([1.0, 0, 0, 0]), (11, 1))
    >>> push = Carried(LoggedMotion(t, jnp.stack([t**2, 0 * t, 0 * t], axis=1), still))
    >>> body = rj.MassProperties(2.0, [0.0, 0, 0.1], jnp.eye(3))
    >>> state = rj.Rigid([0.25, 0, 0.1], [1.0, 0, 0], [1.0, 0, 0, 0], [0.0, 0, 0])
    >>> push(0.5, state, body).force.round(9).tolist()  # N
    [4.0, 0.0, 0.0]
    """

    feels: ClassVar[type] = HasPose
    motion: Any = eqx.field(converter=_motion, default=Input("motion"))

    def __call__(self, t: ScalarLike, state: HasPose, body: MassProperties) -> Wrench:
        now, tensor = self.motion(t), body.inertia.tensor
        force = body.mass * (
            now.a + quaternion.rotate(now.q, relative_acceleration(now.omega, now.alpha, body.com))
        )
        momentum = apply(tensor, now.omega)
        return Wrench(force, apply(tensor, now.alpha) + cross(now.omega, momentum))


def relative_acceleration(omega: Vec3, alpha: Vec3, place: Vec3) -> Vec3:
    """Return the acceleration of the point r = `place` of a body relative to that of the origin of
    r, m/s², body frame: `dΩ/dt × r + Ω × (Ω × r)` (notes, eq 88).
    """
    return cross(alpha, place) + cross(omega, cross(omega, place))
