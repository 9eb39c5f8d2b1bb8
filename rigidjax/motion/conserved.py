"""Compute the conserved quantities of a body under torques, and their drift in a simulation."""

from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from rigidjax import _checks
from rigidjax._types import HasAttitude, HasPose, HasSpin, Scalar, ScalarLike, Vec3
from rigidjax.body.energy import angular_momentum, kinetic_energy
from rigidjax.body.inertia import Body, Inertia, MassProperties
from rigidjax.motion.coupled import Coupled, motion_of
from rigidjax.motion.equations import Turn
from rigidjax.motion.suspension import AbstractSuspension
from rigidjax.motion.torques import AbstractTorque, CentralGravity
from rigidjax.motion.torques.base import Torque, in_precision, length_or_zero, require_compatible
from rigidjax.motion.torques.composite import parts_of
from rigidjax.motion.torques.states import FrozenLaw, freeze_own_states
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import cross, dot


def energy(
    body: Inertia | MassProperties,
    state: HasSpin | Turn | Coupled,
    torque: Torque | AbstractSuspension | None = None,
    t: ScalarLike = 0.0,
) -> Scalar:
    """Return the kinetic energy plus the potential energies of all torques and forces, J: `½ m |v|²
    + ½ Ω·IΩ + U`, with the mass m, velocity v, body rate Ω, inertia I and the sum U of potentials.

    **Arguments:** `body`, `state`, `torque` as for `simulate`; `t` s, for torques that depend on
    time. For a `Turn` it is the energy of the suspension, `½ M γ̇² + V`. Wheels add no energy,
    except for `ReactionWheels`. If the torque has states of its own (such as the speed of a wheel),
    `state` is a `Coupled`, which holds the state of the body together with these states;
    `rigidjax.batch.rollout` and `rigidjax.crossings` return such states. Source: notes, eq 79.
    **Raises:** `TypeError` for a torque without a potential.

    >>> top = rj.torques.HeavyTop(2.0, [0.0, 0.0, 0.5], [0.0, 0.0, -9.81])
    >>> start = rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 1])
    >>> energy(rj.Inertia.from_principal(1.0, 1.0, 1.0), start, top)
    Array(10.31, dtype=float64)
    """
    law: Any = torque
    if isinstance(law, AbstractSuspension):
        turn = _checks.require_unbatched_instance(state, Turn, "state")
        return law.energy(law.require_body(body), turn)
    motion, parts, t = _checked_arguments(body, state, law, t)
    for part in parts:
        if not hasattr(part, "energy"):
            words = f"energy: wanted torques with a potential, got {type(part).__name__}, which has"
            raise TypeError(
                f"{words} no method energy(t, state, body); or take kinetic_energy alone"
            )
    return _energy(in_precision(body, motion.omega.dtype), motion, parts, t)


def conserved(
    body: Inertia | MassProperties,
    state: HasSpin | Turn | Coupled,
    torque: Torque | AbstractSuspension | None = None,
    t: ScalarLike = 0.0,
) -> dict[str, Float[Array, "..."]]:
    """Return the quantities that the exact motion of a body under a torque conserves, at one state.

    **Arguments:** `body`, `state`, `torque` as for `simulate`; `t` the time, s. A torque declares
    what it conserves by optional members (see `rigidjax.torques.AbstractTorque`); under a torque
    without these members nothing is conserved. **Returns** a dict with the value of each conserved
    quantity; which quantities it contains does not depend on the time:

    - `energy`, J, if every torque has a potential and no torque depends on time;
    - `momentum` (3,), kg m²/s, world frame, the angular momentum `R(IΩ + h)`, if there is no
      external torque;
    - `momentum_squared`, kg² m⁴/s², the Casimir `|IΩ + h|²`, if there is no external torque;
    - `momentum_along_axis`, kg m²/s, if the only external torque has no component along a fixed
      axis of the world, such as the direction of gravity or of a field;
    - `linear_momentum` (3,), kg m/s, world frame, if no force acts on the body;
    - `momentum_about_origin` (3,), kg m²/s, world frame, the angular momentum about the origin
      `mass · x × v + R(IΩ + h)`, if the body is free, or attracted by the origin.

    Here R is the attitude, I the inertia, Ω the body rate, h the momentum of the wheels, x the
    position and v the velocity. The dict contains `momentum` and `momentum_along_axis` only if the
    state has an attitude, and the last two quantities only if it also has a position (`Rigid`) and
    `body` has a mass (`MassProperties`).

    Source: Noether's theorem; Marsden and Ratiu, Introduction to Mechanics and Symmetry, §§1.3,
    1.4.

    >>> body = rj.Inertia.from_principal(1.0, 2.0, 3.0)
    >>> sorted(conserved(body, rj.Spin([1.0, 0, 0])))
    ['energy', 'momentum_squared']
    """
    law: Any = torque
    if isinstance(law, AbstractSuspension):
        lossless = cast(Any, law).friction is None and cast(Any, law).torque is None
        return {"energy": energy(body, state, law)} if lossless else {}
    motion, parts, t = _checked_arguments(body, state, law, t)
    dtype = motion.omega.dtype
    body = in_precision(body, dtype)
    quantities: dict[str, Float[Array, "..."]] = {}
    if all(hasattr(part, "energy") and getattr(part, "steady", False) for part in parts):
        quantities["energy"] = _energy(body, motion, parts, t)
    external = [part for part in parts if not hasattr(part, "internal_momentum")]
    momentum = _momentum(body, motion, parts, t)
    if not external:
        quantities["momentum_squared"] = dot(momentum, momentum)
    if isinstance(motion, HasAttitude):
        momentum = quaternion.rotate(motion.q, momentum)
        axis = getattr(external[0], "axis", None) if len(external) == 1 else None
        if not external:
            quantities["momentum"] = momentum
        elif axis is not None:
            axis = axis.astype(dtype)
            length = length_or_zero(axis)
            quantities["momentum_along_axis"] = dot(momentum, axis) / jnp.where(
                length > 0, length, 1
            )
    if isinstance(motion, HasPose) and isinstance(body, MassProperties):
        # The linear momentum is conserved only if no part of the torque is a force. A part is known
        # to return a torque alone if it is an `AbstractTorque` that does not read the position
        # (`feels` is not `HasPose`); any other part may return a force as well.
        forces = []
        for part in parts:
            law = part.law if isinstance(part, FrozenLaw) else part
            if not isinstance(law, AbstractTorque) or law.feels is HasPose:
                forces.append(part)
        if not forces:
            quantities["linear_momentum"] = body.mass * motion.v
        if all(isinstance(part, CentralGravity) for part in [*external, *forces]):
            quantities["momentum_about_origin"] = body.mass * cross(motion.x, motion.v) + momentum
    return quantities


def drift(
    ts: Float[Array, " times"],
    ys: PyTree,
    body: Inertia | MassProperties,
    torque: Torque | AbstractSuspension | None = None,
) -> dict[str, Scalar]:
    """Return how far each conserved quantity drifts during a run, relative to its scale.

    **Arguments:** `ts` (n,) the times, s; `ys` the states at these times, with a leading time axis,
    as a `Coupled` (the state of the body together with the states of the torque) if the torque has
    states of its own, such as the speed of a wheel; `body`, `torque` as for `simulate`. **Returns**
    for each quantity that `conserved` names the largest distance from its value at `ts[0]`, divided
    by its scale, which is the largest value during the run of

    - the kinetic energy, for `energy`; of a `Turn` also half of |angle · dV/d angle|;
    - the magnitude of the quantity itself, for `linear_momentum` and `momentum_about_origin`;
    - the squared magnitude of the angular momentum, for `momentum_squared`;
    - the magnitude of the angular momentum, for the other momenta.

    >>> import jax
    >>> body, ts = rj.Inertia.from_principal(1.0, 2.0, 3.0), jax.numpy.linspace(0.0, 9.0, 4)
    >>> ys = rj.simulate(body, rj.Spin([0.1, 1.0, 0.0]), ts).ys
    >>> bool(drift(ts, ys, body)["energy"] < 1e-8)
    True
    """
    ts = _checks.array_of_rows(ts, (), "ts")
    if not ts.size:
        raise ValueError("ts: wanted at least one time, got none")
    motion = motion_of(ys)
    wanted = "states with a leading time axis"
    _checks.require_instance(motion, (HasSpin, Turn), "ys", requirement=wanted)
    for leaf in jax.tree.leaves(ys):
        if leaf.shape[:1] != ts.shape:
            words = f"ys: wanted arrays with one row for each of the {ts.shape[0]} times in ts"
            raise ValueError(f"{words}, got shape {leaf.shape}")
    quantities = jax.vmap(lambda t, y: conserved(body, y, torque, t))(ts, ys)
    law: Any = torque
    if isinstance(law, AbstractSuspension):

        def size(y: Turn) -> Scalar:
            # In a small swing about the angle 0 the two terms are the energy, at the turning points
            # as well as between them.
            slope = jax.grad(lambda a: law.potential(body, a))(y.angle)
            return 0.5 * (law.moment(body, y.angle) * y.rate**2 + jnp.abs(slope * y.angle))

        scale = jnp.max(jax.vmap(size)(ys))
        changes = {name: jnp.max(jnp.abs(q - q[0])) for name, q in quantities.items()}
        return {name: c / jnp.where(scale > 0, scale, 1) for name, c in changes.items()}
    kinetic = jax.vmap(lambda y: kinetic_energy(in_precision(body, y.omega.dtype), y))(motion)

    def momentum_length(t: ScalarLike, y: PyTree) -> Scalar:
        motion, parts, t = _checked_arguments(body, y, law, t)
        own = in_precision(body, motion.omega.dtype)
        return length_or_zero(_momentum(own, motion, parts, t))

    momenta = jax.vmap(momentum_length)(ts, ys)
    drifts = {}
    for name, values in quantities.items():
        distances = _lengths(values - jax.lax.slice_in_dim(values, 0, 1))
        if name == "energy":
            scale = kinetic
        elif name in ("linear_momentum", "momentum_about_origin"):
            scale = _lengths(values)
        else:
            scale = momenta**2 if name == "momentum_squared" else momenta
        scale = jnp.max(scale)
        drifts[name] = jnp.max(distances) / jnp.where(scale > 0, scale, 1)
    return drifts


class _Checked(NamedTuple):
    """Hold a state of motion, the single torques and forces (no `Sum`), and the time, s."""

    motion: HasSpin
    parts: tuple[Any, ...]
    t: Scalar


def _checked_arguments(body: Body, state: PyTree, torque: Torque | None, t: ScalarLike) -> _Checked:
    """Return a state, a torque and a time after checks; the values of the torque's own states,
    which a `Coupled` holds, are inserted.
    """
    if isinstance(state, Coupled):
        state, torque = state.motion, freeze_own_states(torque, state.own)
    parts = parts_of(torque)
    for part in parts or (None,):
        require_compatible(part, state, body)
    return _Checked(state, parts, _checks.array_of_shape(t, (), "t"))


def _energy(body: Body, state: HasSpin, torques: tuple[Any, ...], t: Scalar) -> Scalar:
    """Return the kinetic energy of a body plus the potential energy of each torque, J."""
    dtype, total = state.omega.dtype, kinetic_energy(body, state)
    for torque in torques:
        value = in_precision(torque, dtype).energy(t.astype(dtype), state, body)
        total = total + value.astype(dtype)
    return total


def _momentum(body: Body, state: HasSpin, torques: tuple[Any, ...], t: ScalarLike) -> Vec3:
    """Return the angular momentum, kg m²/s, body frame, of the body and of the wheels inside it."""
    momentum = angular_momentum(body, state)
    for torque in torques:
        if hasattr(torque, "internal_momentum"):
            momentum = momentum + torque.internal_momentum(t).astype(momentum.dtype)
    return momentum


def _lengths(values: Float[Array, "times *shape"]) -> Float[Array, " times"]:
    """Return the length of the vector, or the absolute value of the number, at each time."""
    return jnp.abs(values) if values.ndim == 1 else jnp.sqrt(jnp.sum(values**2, axis=-1))
