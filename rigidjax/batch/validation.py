"""Checks of a batch before anything runs: shapes, types, and known numbers."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from rigidjax import _checks
from rigidjax._types import HasAttitude
from rigidjax.body.inertia import Inertia, MassProperties, tensor_of
from rigidjax.body.validation import first_impossible
from rigidjax.motion import Attitude, Rigid, Spin
from rigidjax.motion.equations import on_the_group
from rigidjax.motion.torques.inputs import delays_of, require_inputs
from rigidjax.rotation.validation import tolerance
from rigidjax.solve import validation


class BodyBatch(NamedTuple):
    """A batch `(body, state0, torque)`, split into three trees."""

    shared: Any  # the arrays that all bodies share, `None` elsewhere
    each: Any  # the arrays of each body
    rest: Any  # the leaves that are no arrays
    many: int
    dtype: Any
    looks: tuple[tuple[Any, Callable[[int], None]], ...] = ()

    def require(self) -> None:
        """Raise for the first body with a known number that is wrong.

        To be called after the work was started: a device then looks at the bodies while the host
        prepares the rest, and nobody waits.
        """
        for index, refuse in self.looks:
            if (i := int(index)) >= 0:
                refuse(i)


def one_of(shared: Any, each: Any, rest: Any) -> tuple[Any, Any, Any]:
    """A single body, its state and its torque; a state that is invalid becomes NaN."""
    body, state0, torque = eqx.combine(shared, each, rest)
    return body, on_the_group(validation.start(state0, False)), torque


def bodies_of(bodies: Any, states0: Any, torque: Any, torque_axes: Any) -> BodyBatch:
    """The batch, whose `require` names the first body with a known number that is wrong."""
    if not isinstance(states0, Spin | Attitude | Rigid):
        raise TypeError(
            f"states0: wanted Spin, Attitude or Rigid, got {type(states0).__name__}; for points in "
            "moving frames use jax.vmap over rigidjax.simulate"
        )
    if states0.omega.ndim != 2 or not states0.omega.shape[0]:
        raise ValueError(
            f"states0: wanted one row a body, omega of shape (N, 3), got {states0.omega.shape}"
            + ("; for one body use rigidjax.simulate" if states0.omega.ndim == 1 else "")
        )
    count = states0.omega.shape[0]
    for path, leaf in jax.tree.leaves_with_path(states0):
        if leaf.shape[0] != count or leaf.ndim != 2:
            raise ValueError(
                f"states0: {count} rows of omega, but {str(path[-1]).lstrip('.')} of shape "
                f"{leaf.shape}"
            )
    dtype = validation.one_dtype(states0, "states0")
    _checks.numbers(states0.omega, "states0")
    if not isinstance(bodies, Inertia | MassProperties):
        raise TypeError(
            f"bodies: wanted Inertia, or MassProperties for Rigid, got {type(bodies).__name__}"
        )
    tensor = tensor_of(bodies)
    if tensor.ndim not in (2, 3) or (tensor.ndim == 3 and tensor.shape[0] not in (1, count)):
        raise ValueError(
            f"bodies: wanted one body, or {count} as the states, of shape ({count}, 3, 3), got "
            f"{tensor.shape}"
        )
    # Before the states' precision: in a finer one, the rounding of a plate looks like a fault.
    bodies, looks = _real(bodies)
    if isinstance(states0, HasAttitude):
        looks += _unit(states0.q)
    bodies = jax.tree.map(lambda a: a if a.dtype == dtype else a.astype(dtype), bodies)
    own = tensor.ndim == 3
    if own and tensor.shape[0] == 1 and count > 1:
        bodies, own = jax.tree.map(lambda leaf: leaf[0], bodies), False
    arrays, rest = eqx.partition((bodies, states0, torque), eqx.is_array)
    axes = (
        jax.tree.map(lambda _: own, arrays[0]),
        jax.tree.map(lambda _: True, arrays[1]),
        _own_torque(arrays[2], torque_axes, count),
    )
    each, shared = eqx.partition(arrays, axes)
    # Shapes are enough for an Inertia; taking a row costs as much as many steps.
    shape = lambda a: jax.ShapeDtypeStruct(a.shape[1:], a.dtype)  # noqa: E731
    row = (lambda a: a[0]) if isinstance(bodies, MassProperties) else shape
    validation.require_fit(*eqx.combine(shared, jax.tree.map(row, each), rest))
    validation.warn_of_scale(bodies, torque)
    batch = BodyBatch(shared, each, rest, count, dtype, tuple(looks))
    if all(isinstance(index, np.ndarray | np.integer) for index, _ in looks):
        # Of few bodies at once, before anything is compiled.
        batch.require()
    return batch


def driven_by(inputs: Any, torque: Any, states0: Any, count: int, h: Array) -> Any:
    """The inputs of each body, by name (N, steps, *k), in the precision of the states."""
    for name, delay in delays_of(torque):
        if _checks.known((delay, h)):
            longest, whole = np.abs(np.asarray(delay)).max(), count * float(h)
            if longest >= whole:
                raise ValueError(
                    f"inputs[{name!r}]: a delay of {longest:.6g} s, and a run of {whole:.6g} s: "
                    "none of it would be seen"
                )
    wanted = (*states0.omega.shape[:1], count)
    found = {}
    for name, value in require_inputs(torque, inputs).items():
        rows = _checks.numbers(value, f"inputs[{name!r}]")
        if rows.shape[:2] != wanted:
            raise ValueError(
                f"inputs[{name!r}]: wanted (N, num_steps, *k) = {wanted} and more, got shape "
                f"{rows.shape}"
            )
        rows = _checks.finite(rows.astype(states0.omega.dtype), f"inputs[{name!r}]")
        found[name] = jnp.asarray(rows)
    return found or None


def _own_torque(torque: Any, axes: Any, count: int) -> Any:
    """The arrays of the torque with a row for each body."""
    if callable(axes) and not isinstance(axes, eqx.Module):
        prefix = _selected(torque, axes)
    else:
        for axis in jax.tree.leaves(axes):
            if not isinstance(axis, int) or axis != 0:
                raise ValueError(
                    "torque_axes: wanted 0 and None, or a function that picks the arrays, such as "
                    f"lambda law: law.speed, got {axis!r}"
                )
        prefix = jax.tree.map(lambda axis: axis is not None, axes, is_leaf=lambda a: a is None)
    own, _ = eqx.partition(torque, prefix)
    for path, leaf in jax.tree.leaves_with_path(own):
        if leaf.ndim == 0 or leaf.shape[0] != count:
            raise ValueError(
                f"torque_axes: wanted {count} rows in torque{jax.tree_util.keystr(path)}, got "
                f"shape {leaf.shape}; make one law a body with jax.vmap"
            )
    return prefix


def _selected(torque: Any, pick: Any) -> Any:
    """True for each array that `pick(law)` gives, alone, in a tuple, or in a part of the torque."""
    leaves, structure = jax.tree.flatten(torque)
    numbered = jax.tree.unflatten(structure, list(range(len(leaves))))
    try:
        found = jax.tree.leaves(pick(numbered))
    except (AttributeError, IndexError, KeyError, TypeError) as error:
        raise ValueError(f"torque_axes: nothing is there ({error})") from None
    if not found or not all(type(index) is int for index in found):
        raise ValueError(
            "torque_axes: wanted a function that picks arrays of the law, or parts of it, such as "
            f"lambda law: law.parts[0], got {found or 'none'}"
        )
    return jax.tree.unflatten(structure, [i in found for i in range(len(leaves))])


def _real(bodies: Inertia | MassProperties) -> tuple[Any, list[Any]]:
    """The bodies, traced ones that no mass has as NaN; and the first of known ones."""
    tensor = tensor_of(bodies)
    if not _checks.known(tensor):
        return validation.real_or_nan(bodies), []
    # Within a trace, a known tensor that JAX reshapes is no longer known.
    with jax.ensure_compile_time_eval():
        tensors = tensor.reshape(-1, 3, 3)

    def refuse(i: int) -> None:
        try:
            Inertia(np.asarray(tensors)[i]).invertible()
        except ValueError as error:
            raise ValueError(f"bodies: {error}; this is body {i}") from None

    return bodies, [(first_impossible(tensors), refuse)]


def _unit(q: Array) -> list[Any]:
    if not _checks.known(q):
        return []

    def refuse(i: int) -> None:
        far = abs(np.linalg.norm(np.asarray(q)[i]) - 1)
        raise ValueError(
            f"q: wanted unit quaternions (w, x, y, z), got length {1 + far:.6g} or less of body "
            f"{i}; normalise with rigidjax.quaternion.normalise, and mind that the scalar is first"
        )

    return [(_checks.first_bad(_not_unit, q), refuse)]


def _not_unit(xp: Any, q: Any) -> Any:
    return xp.abs(xp.sqrt(xp.sum(xp.square(q), axis=-1)) - 1) > tolerance(q.dtype)


def step_of(step_size: Any, num_steps: Any, dtype: Any) -> tuple[Array, int]:
    """The step, s, and the number of steps."""
    h = _checks.floating(step_size, (), "step_size").astype(dtype)
    if _checks.known(h) and not 0 < float(h) < np.inf:
        raise ValueError(
            f"step_size: wanted a positive step, s, got {step_size}; to go back in time negate Ω "
            "and the torque's time"
        )
    return h, _checks.whole(num_steps, "num_steps", 1)
