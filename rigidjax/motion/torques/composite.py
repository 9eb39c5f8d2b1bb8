"""Add several torques, and describe a body whose inertia changes in time."""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from rigidjax import _checks, _show
from rigidjax._types import HasAttitude, HasSpin, Mat3, Scalar, ScalarLike, Vec3
from rigidjax.body.inertia import Body, Inertia, tensor_of, with_tensor
from rigidjax.body.symmetric3 import from_components
from rigidjax.body.validation import is_physical_inertia
from rigidjax.motion.torques import base
from rigidjax.motion.torques.inputs import require_no_jumps
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import apply, components, cross, dot, solve


class Sum(eqx.Module):
    """Add several torques and forces. The state of motion must have each part (body rate, attitude,
    position) that any of these torques and forces reads, as their attributes `feels` declare;
    `feels` of the sum is the smallest such state.

    **Arguments:** `*parts` torques, forces, your own callables. **Raises:** `TypeError` for a part
    that cannot be called; `ValueError` for an empty sum.

    >>> damping = rj.torques.Damping([1.0, 1, 1])
    >>> Sum(damping, rj.torques.HeavyTop(1.0, [0.0, 0, 1], [0.0, 0, -9.81])).feels
    <class 'rigidjax._types.HasAttitude'>
    """

    parts: tuple[Any, ...]

    __repr__ = _show.fields_as_text

    def __init__(self, *parts: base.Torque):
        if not parts:
            raise ValueError("Sum: wanted at least one torque; for a free body give torque=None")
        for part in parts:
            base.require_torque(part, "Sum")
            if isinstance(part, ChangingInertia) and len(parts) > 1:
                raise TypeError(
                    "Sum: ChangingInertia divides all torques by the inertia at time t: put "
                    "the others inside it, ChangingInertia(inertia, Sum(a, b))"
                )
        self.parts = parts

    @property
    def feels(self) -> base.StateType:
        """Return the type of the smallest state of motion with all parts that the torques in this
        sum declare to read, such as `HasAttitude`.
        """
        types = base.STATE_TYPES_BY_SIZE
        needed = [getattr(part, "feels", types[0]) for part in self.parts]
        return max(needed, key=lambda kind: types.index(kind) if kind in types else len(types))

    @property
    def rate_free(self) -> bool:
        """Return whether this sum of torques does not depend on the body rate: true if no torque in
        the sum depends on it.
        """
        return all(not base.may_read_rate(part) for part in self.parts)

    @property
    def jump_times(self) -> Float[Array, " n"]:
        """Return the times (n,), s, at which any torque in this sum jumps or has a kink, in
        ascending order.
        """
        return base.sorted_jumps(*self.parts)

    def __call__(self, t: ScalarLike, state: PyTree, body: Body) -> Vec3 | base.Wrench:
        forces, torque = [], None
        for part in self.parts:
            force, part_torque = base.force_and_torque(part, t, state, body)
            torque = part_torque if torque is None else torque + part_torque
            forces += [] if force is None else [force]
        if not forces:
            return torque  # pyright: ignore[reportReturnType]
        return base.Wrench(sum(forces[1:], forces[0]), torque)


def parts_of(torque: base.Torque | None) -> tuple[Any, ...]:
    """Return the single torques and forces in `torque`, also of each `Sum` inside a `Sum`."""
    if isinstance(torque, Sum):
        return tuple(inner for part in torque.parts for inner in parts_of(part))
    return () if torque is None else (torque,)


class ChangingInertia(eqx.Module):
    """Describe the effect of a changing inertia I on the body rate Ω: `d(IΩ)/dt = IΩ × Ω + τ`, that
    is `I dΩ/dt = IΩ × Ω − İΩ + τ`.

    **Arguments:**

    - `inertia`: I (3, 3), kg m², body frame, about the point that the body turns about (the centre
      of mass of a `Rigid`). It is either a function of time, t → (3, 3), such as `Linear(times,
      tensors)`, which replaces the inertia of the body given to `simulate`; or a Module that is
      called as `(t, state, body)` and has the attribute `feels`, as torques have, such as `Tide`. A
      tensor that no body has (not symmetric, or with moments that are not positive or break the
      triangle inequality) becomes NaN, which ends the run.
    - `torque`: the sum τ of all other torques, or `None`. Give all other torques here, not in a
      `Sum` with this object, because they act on the body with the inertia I.

    If `inertia` is a function of time, `simulate` integrates the momentum: where the inertia jumps,
    as in `jnp.where(t < t1, I0, I1)`, the momentum does not change. In other integrators, such as
    `rigidjax.batch.rollout`, and for a Module with `feels`, the derivative İ along the motion is
    used instead, in which a jump of the inertia is lost.

    Parts that move inside the body must have no angular momentum in the body frame (Σ mᵢ rᵢ × ṙᵢ =
    0, a sum over the parts), as booms that extend in a straight line from the centre have none;
    otherwise add the momentum of the moving parts as a `Flywheel` to `torque`. Ejected fuel carries
    its momentum away: if İ_f is the rate at which the loss of fuel changes the inertia, add the
    torque İ_f Ω to `torque`.

    Source: Hughes 1986, Spacecraft Attitude Dynamics, ch. 3; the momentum `R I(t) Ω` is conserved
    without τ.

    >>> grows = ChangingInertia(lambda t: (1.0 + t) * jnp.eye(3))
    >>> body = rj.Inertia(jnp.eye(3))
    >>> rj.simulate(body, rj.Spin([0.0, 0, 1.0]), [0.0, 1.0], grows).ys.omega[-1, 2]
    Array(0.5, dtype=float64)
    """

    inertia: Callable[..., Any]
    torque: Any

    __repr__ = _show.fields_as_text

    def __init__(self, inertia: Callable[..., Any], torque: base.Torque | None = None):
        if hasattr(inertia, "feels"):
            base.require_torque(inertia, "inertia")
        else:
            _checks.require_function(inertia, "inertia", "of time to (3, 3), kg m²")
            require_no_jumps(inertia, "inertia")
        self.inertia = inertia
        if torque is not None:
            base.require_torque(torque)
        self.torque = torque

    @property
    def feels(self) -> base.StateType:
        """Return the type of the smallest state of motion with all parts that the fields `inertia`
        and `torque` of this `ChangingInertia` read, such as `HasAttitude`.
        """
        needed = [getattr(part, "feels", HasSpin) for part in (self.inertia, self.torque)]
        return max(needed, key=base.STATE_TYPES_BY_SIZE.index)

    jump_times = property(base.field_jumps)

    def tensor(self, t: ScalarLike, state: PyTree = None, body: Body | None = None) -> Mat3:
        """Return the inertia tensor I (3, 3), kg m², body frame, at the time `t`, s. The arguments
        `state` and `body` are not used if the field `inertia` of this `ChangingInertia` is a
        function of time.
        """
        arguments = (t, state, body) if hasattr(self.inertia, "feels") else (t,)
        inertia = self.inertia(*arguments)
        inertia = inertia.tensor if isinstance(inertia, Inertia) else inertia
        return _checks.array_of_shape(inertia, (3, 3), "inertia(t)")

    def __call__(self, t: ScalarLike, state: HasSpin, body: Body) -> Vec3 | base.Wrench:
        omega = state.omega
        t = jnp.asarray(t, omega.dtype)
        q = state.q if isinstance(state, HasAttitude) else None

        def momentum(t: Array, q: Array, omega: Array) -> tuple[Vec3, Mat3]:
            here = eqx.tree_at(lambda s: s.omega, state, omega)
            here = here if q is None else eqx.tree_at(lambda s: s.q, here, q)
            now = tensor_or_nan(self.tensor(t, here, body).astype(omega.dtype))
            return apply(now, omega), now

        # The derivative Ω̇ of the body rate is not known yet, but d(IΩ)/dt is linear in Ω̇. One
        # linearisation of IΩ gives a linear system for Ω̇; it is evaluated along four directions: t
        # and q together, and the three components of Ω one by one.
        (held, now), along = jax.linearize(momentum, t, q, omega)
        still, first = jnp.zeros((1, 3), omega.dtype), jnp.eye(4, 1, dtype=omega.dtype)
        turns = None if q is None else first * quaternion.rate(q, omega)[None]
        ways = jnp.concatenate([still, jnp.eye(3, dtype=omega.dtype)])
        slopes, _ = jax.vmap(along)(first[:, 0], turns, ways)
        turning = cross(held, omega) - slopes[0]
        force = None
        if self.torque is not None:
            force, torque = base.force_and_torque(self.torque, t, state, with_tensor(body, now))
            turning = turning + torque
        # Euler's equations, to which the returned torque is added, use the fixed inertia of `body`,
        # not the changing inertia I. The torque is therefore computed such that Euler's equations
        # with the fixed inertia give the right Ω̇.
        fixed = tensor_of(body)
        slope = solve(slopes[1:].T, turning)
        torque = apply(fixed, slope) - cross(apply(fixed, omega), omega)
        return torque if force is None else base.Wrench(force, torque)


def tensor_or_nan(tensor: Mat3) -> Mat3:
    """Return the inertia tensor if a body can have it, else NaN, which ends a run of a solver."""
    return jnp.where(is_physical_inertia(tensor), tensor, jnp.full_like(tensor, jnp.nan))


class Tide(eqx.Module):
    """Compute the inertia tensor of an elastic body that a point mass and the body's own spin
    deform.

    `I = I₀ − κ (μ/r³)(u uᵀ − ⅓) + ⅓ κ (Ω Ωᵀ − ⅓ Ω² − n² (e_z e_zᵀ − ⅓))`, with the inertia I₀ of
    the body given to `simulate`, the body rate Ω, the direction `u = Rᵀr/r` of the point mass in
    body axes, and the unit vector e_z along the z axis of the body; a scalar that is added to a
    matrix stands for this scalar times the unit matrix. The attitude R and the position r in u are
    those at the earlier time t − `delay`. Pass a tide to `ChangingInertia`, which computes İΩ:
    `ChangingInertia(Tide(…), torque)`.

    **Arguments:**

    - `response`: κ = k₂ a⁵/G, kg m² s², for a body with the Love number k₂ and the radius a; G is
      the constant of gravitation.
    - `delay`: s, the time by which the deformation lags behind the attraction of the point mass.
    - `mu`: μ, m³/s², G times the mass of the point mass.
    - `position`: r (3,), in metres, world frame, from the body to the point mass: constant, or a
      function of time, t → (3,), such as a `Chebyshev`.
    - `mean_rate`: n, rad/s, about the z axis of the body: the spin whose deformation is already in
      I₀.

    The attitude at t − delay is computed as if the body had turned at the present body rate since
    then. Source: Folkner, Williams, Boggs, Park, Kuchynka 2014, The planetary and lunar ephemerides
    DE430 and DE431, IPN Progress Report 42-196, section III.

    >>> tide, body = Tide(3.0, 0.0, 1.0, [1.0, 0.0, 0.0]), rj.Inertia(4.0 * jnp.eye(3))
    >>> tide(0.0, rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 0]), body).diagonal()
    Array([2., 5., 5.], dtype=float64)
    """

    feels: ClassVar[type] = HasAttitude
    response: Scalar = eqx.field(converter=base.number_converter("response"))
    delay: Scalar = eqx.field(converter=base.number_converter("delay"))
    mu: Scalar = eqx.field(converter=base.number_converter("mu"))
    position: Any = eqx.field(converter=base.source_converter("position"))
    mean_rate: Scalar = eqx.field(converter=base.number_converter("mean_rate"), default=0.0)

    __repr__ = _show.fields_as_text

    def __call__(self, t: ScalarLike, state: HasAttitude, body: Body) -> Mat3:
        before = quaternion.multiply(state.q, quaternion.exp(-self.delay * state.omega))
        r = base.vector_at(self.position, t - self.delay, "position")
        distance = jnp.sqrt(dot(r, r))
        x, y, z = components(quaternion.rotate_inverse(before, r / distance))
        a, b, c = components(state.omega)
        pull, spin = self.mu / distance / distance / distance, self.mean_rate**2
        third = (pull - (a * a + b * b + c * c - spin) / 3) / 3
        added = from_components(
            third - pull * x * x + a * a / 3,
            third - pull * y * y + b * b / 3,
            third - pull * z * z + (c * c - spin) / 3,
            a * b / 3 - pull * x * y,
            a * c / 3 - pull * x * z,
            b * c / 3 - pull * y * z,
        )
        return tensor_of(body) + self.response * added
