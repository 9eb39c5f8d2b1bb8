"""Solve the motion of a torque-free body at any time in closed form."""

import functools
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from rigidjax import _checks
from rigidjax._types import HasAttitude, HasPose, HasSpin, Mat3, Quat, Scalar, ScalarLike, Vec3
from rigidjax.body import validation
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.body.scaling import binary_exponent, times_power_of_two
from rigidjax.exact.derivatives import (
    FreeMotionConstants,
    motion_constants,
    rate_and_turn,
)
from rigidjax.motion import Rigid
from rigidjax.rotation.kernels import quaternion_product
from rigidjax.rotation.linalg3 import components
from rigidjax.rotation.validation import require_near_unit, rotation_tolerance

State = TypeVar("State", bound=HasSpin)


class FreeMotion(eqx.Module):
    """Hold the motion of a free body from any initial state, a `Spin`, an `Attitude` or a `Rigid`.

    The body and the state are not checked. Call the object with one time or with times (n,), s,
    since `state0`. The result is NaN at a time until which the body turns by more than 1/eps rad,
    where eps is the machine epsilon of the dtype.
    """

    state0: Any
    tensor: Mat3
    omega: Vec3
    exponent: Array
    setting: FreeMotionConstants

    def __init__(self, body: Inertia | MassProperties, state0: PyTree):
        tensor = (body if isinstance(body, Inertia) else body.inertia).tensor
        # Divide the tensor and the body rate by powers of two, so that their largest entries are
        # near 1: this loses no digit, and no product below overflows or underflows for a huge or a
        # tiny body.
        self.exponent = binary_exponent(state0.omega)
        self.tensor = times_power_of_two(tensor, -binary_exponent(tensor))
        self.omega = times_power_of_two(state0.omega, -self.exponent)
        self.setting = motion_constants(*jax.lax.stop_gradient((self.tensor, self.omega)))
        self.state0 = state0

    def __call__(self, since: Float[Array, "*n"]) -> Any:
        """Return the state at the time `since`, or the states at the times `since`."""
        t = since.astype(self.tensor.dtype)
        # If the body turns by more than 1/eps rad until the time t, the dtype holds no digit of the
        # angle within one turn, and the state is unknown: replace t by NaN, so that the state is
        # NaN, too.
        turned = jnp.abs(t) * jnp.max(jnp.abs(self.state0.omega))
        t = jnp.where(turned <= 1 / jnp.finfo(t.dtype).eps, t, jnp.nan)
        scaled = times_power_of_two(t, self.exponent)
        omega, turn = rate_and_turn(self.tensor, self.omega, self.setting, scaled)
        omega = times_power_of_two(omega, self.exponent)
        state = eqx.tree_at(lambda s: s.omega, self.state0, omega)
        if isinstance(state, HasAttitude):
            first = jnp.broadcast_to(state.q, turn.shape)
            state = eqx.tree_at(lambda s: s.q, state, _unit_product(first, turn))
        if not isinstance(state, Rigid):
            return state
        v = jnp.broadcast_to(state.v, omega.shape)
        x = jnp.broadcast_to(state.x, v.shape) + since[..., None] * v
        return Rigid(x, v, state.q, omega)


class FreeBody(eqx.Module):
    """Hold the motion of a free body for all times: call the object with one time, or its method
    `at` with many times.

    The constants of the motion are computed once. **Arguments:** `inertia` of the body about its
    centre of mass, kg m², body frame; `state0` the state at time 0, a `Spin` (the body rate Ω) or
    an `Attitude` (the quaternion q and Ω). `free_body` describes the same two arguments in full.

    >>> motion = FreeBody(rj.Inertia.from_principal(1.0, 2.0, 2.5), rj.Spin([0.0, 0.0, 1.0]))
    >>> motion(10.0).omega
    Array([0., 0., 1.], dtype=float64)
    """

    motion: FreeMotion

    def __init__(self, inertia: Inertia, state0: HasSpin):
        self.motion = FreeMotion(_checked_inertia(inertia, state0), state0)

    def __call__(self, t: ScalarLike) -> HasSpin:
        """Return the state of the free body at the time `t`, one number, s; the time is 0 at the
        initial state `state0`.
        """
        return self.at(_checked_time(t, self.motion.state0.omega))

    def at(self, ts: Float[Array, "*n"]) -> HasSpin:
        """Return the states of the free body at the times `ts` (n,), s; the time is 0 at the
        initial state `state0`.

        Each array of the result begins with an axis of length n. `jax.vmap` over the times has the
        same result, but this method compiles sooner.

        >>> motion = FreeBody(rj.Inertia.from_principal(1.0, 2.0, 2.5), rj.Spin([0.0, 0.0, 1.0]))
        >>> motion.at(jnp.array([0.0, 10.0])).omega
        Array([[0., 0., 1.],
               [0., 0., 1.]], dtype=float64)
        """
        return self.motion(ts)


def free_body(inertia: Inertia, state0: State, t: ScalarLike) -> State:
    """Return the state of a torque-free body at any time t in closed form, without a solver or
    steps.

    **Arguments:**

    - `inertia`: about the centre of mass, any tensor with positive moments, kg m², body frame.
    - `state0`: the initial state, a `Spin` (Ω) or an `Attitude` (q, Ω): Ω rad/s in the body frame,
      q a unit quaternion (w, x, y, z), body → world.
    - `t`: scalar time since `state0`, s, of either sign.

    **Returns** the state at `t`, of the type and dtype of `state0`. Use `jax.vmap` for many times
    or bodies; `FreeBody(inertia, state0)` keeps the constants of the motion.

    Let Π = IΩ, with the axes 1, 2, 3 in the order of their moments, and `dᵢⱼ = 1/Iᵢ − 1/Iⱼ`. Let S,
    C, D be Jacobi's functions in a scaling that is symmetric in the axes, and ξ the phase of these
    functions (`rigidjax.exact.jacobi_duplication`); Ξ = 2ξ/|Π| with ξ at t/2. Then, with Π for
    Π(0), with exp of a pure quaternion, and with |…| for the length of the last factor,

        Π(t) ∝ (Π₁C − d₂₃Π₂Π₃SD, Π₂CD + d₁₃Π₁Π₃S, Π₃D − d₁₂Π₁Π₂SC)              S, C, D at t
        q(t) = q(0) ⊗ exp(½(t/I₁ − Ξ) Π) ⊗ (C, 0, −d₁₂SΠ₂(t/2)C, −d₁₃SΠ₃(t/2))/|…|   S, C, D at t/2

    (Jacobi 1850; Landau and Lifshitz, Mechanics, eq 37.10 for Ω; the attitude is the addition
    theorem of the Weierstrass sigma function at the half time.) Sphere, symmetric tops, plates,
    spins about any axis, the separatrix and rest are ordinary points. The quaternion is continuous
    in t, has length 1, and `R(q) I Ω` is constant to round-off. A time that JAX traces and in which
    the body turns by more than 1/eps rad gives NaN.

    Derivatives with respect to all arguments are closed forms, correct to second order at all these
    points, as functions of the whole tensor. For a spin about the unstable middle axis they grow as
    e^{λt}, where λ is the rate at which a small deviation grows, up to λt ≈ 150 (float32: 40).

    **Raises:** `TypeError`, `ValueError` for a wrong shape or dtype, dtypes that differ, or a state
    with a position (`Rigid`); for values that JAX does not trace, also for NaN, a tensor that no
    real body has (a traced one gives NaN), a moment of zero, a quaternion that is not unit, and a
    time in which the body turns by more than 1/eps rad, where eps is the machine epsilon.

    >>> state0 = rj.Attitude([1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 1e-4])
    >>> free_body(rj.Inertia.from_principal(1.0, 2.0, 3.0), state0, 20.0).omega
    Array([-0.42522037, -0.90508985,  0.24550111], dtype=float64)
    """
    inertia = _checked_inertia(inertia, state0)
    return _jitted(inertia, state0, _checked_time(t, state0.omega))


_jitted = jax.jit(lambda inertia, state0, t: FreeMotion(inertia, state0)(t))


def _checked_time(t: ScalarLike, omega: Array) -> Scalar:
    """Return the time, s, as an array; raise a `ValueError` if the dtype holds no digit of the
    angle within one turn of the body in this time, where both arguments are known.
    """
    t = _checks.checked_time(t)
    if not _checks.is_known((t, omega)):
        return t
    dtype = jnp.promote_types(t.dtype, omega.dtype)
    with np.errstate(over="ignore"):
        angle = abs(float(t)) * np.abs(np.asarray(omega, dtype=np.float64)).max()
    if angle > 1 / jnp.finfo(dtype).eps:
        raise ValueError(
            f"t: in {float(t):.3g} s the body turns by {angle:.3g} rad, of which {dtype} holds no "
            "digit within one turn; wanted a shorter time"
        )
    return t


def _checked_inertia(inertia: Inertia, state0: HasSpin) -> Inertia:
    """Return the inertia after checks of it and the state; a traced impossible one is NaN."""
    if isinstance(state0, HasPose) or not isinstance(state0, HasSpin):
        raise TypeError(
            f"state0: wanted a Spin or an Attitude, got {type(state0).__name__}; the centre "
            "of mass of a free body moves at constant velocity: add x + v t yourself, or use "
            "simulate"
        )
    _checks.require_unbatched_instance(
        inertia, Inertia, "inertia", hint="of MassProperties pass .inertia"
    )
    tensor = inertia.tensor
    arrays = {"omega": _checks.array_of_shape(state0.omega, (3,), "omega")}
    if isinstance(state0, HasAttitude):
        arrays["q"] = _checks.array_of_shape(
            state0.q, (4,), "q", hint="a quaternion is (w, x, y, z)"
        )
    for name, array in arrays.items():
        if array.dtype != tensor.dtype:
            raise TypeError(f"{name} is {array.dtype}, but the inertia tensor is {tensor.dtype}")
    inertia = validation.require_physical_body(inertia, throw=False)
    if not _checks.is_known((tensor, arrays)):
        return inertia
    for name, array in arrays.items():
        _checks.require_finite(array, name)
    if "q" in arrays:
        require_near_unit(arrays["q"], "q", rotation_tolerance(tensor.dtype))
    return inertia


@functools.partial(jnp.vectorize, signature="(n),(n)->(n)")
def _unit_product(left: Quat, right: Quat) -> Quat:
    """Return the product of two quaternions, divided by its length."""
    out = jnp.stack(quaternion_product(components(left), components(right)))
    return out / jnp.sqrt(jnp.sum(out * out))
