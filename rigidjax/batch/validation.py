"""Check the arguments of a batch, before anything runs: shapes, types and known numbers."""

from collections.abc import Callable, Mapping
from types import ModuleType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, PyTree

from rigidjax import _checks
from rigidjax._types import HasAttitude, ScalarLike
from rigidjax.body.inertia import Inertia, MassProperties, tensor_of
from rigidjax.body.validation import first_impossible_inertia, require_physical_body
from rigidjax.motion import Attitude, Rigid, Spin
from rigidjax.motion.equations import project_to_group
from rigidjax.motion.torques.base import Torque
from rigidjax.motion.torques.inputs import delays_of, require_inputs
from rigidjax.rotation.validation import rotation_tolerance
from rigidjax.solve.answer import validation

# The type of `torque_axes`, which says which arrays of a torque have a row for each body: 0 for
# all, a function that selects the arrays, or a tree of 0 and `None`.
TorqueAxes = int | Callable[[Any], Any] | PyTree


class Check(NamedTuple):
    """Hold the result of one check of many bodies."""

    index: Any  # of the first wrong body, or −1
    refuse: Callable[[int], None]  # raise the error for this body


class BodyBatch(NamedTuple):
    """Hold the bodies, initial states and torque of many runs, split into three trees of the
    structure `(bodies, states0, torque)`: each leaf is in one, and the other two have `None` in its
    place.
    """

    shared: PyTree  # the arrays that all bodies share
    per_body: PyTree  # the arrays with a row for each body
    constants: PyTree  # the leaves that are no arrays
    num_bodies: int  # the number N of bodies
    dtype: np.dtype  # the precision of the states
    # The checks of inertias and quaternions that are not traced; `require_valid_numbers` reads
    # their results.
    checks: tuple[Check, ...] = ()

    def require_valid_numbers(self) -> None:
        """Raise an error for the first body with a known impossible inertia or non-unit quaternion.

        Call this function after the computation has been started: the device then checks the bodies
        while the host works on, and neither waits for the other.
        """
        for index, refuse in self.checks:
            if (i := int(index)) >= 0:
                refuse(i)


class OneBody(NamedTuple):
    """Hold body, initial state and torque of one run of a batch."""

    body: Inertia | MassProperties
    state0: Any  # NaN if it is invalid
    torque: Torque | None


def one_body(shared: PyTree, row: PyTree, constants: PyTree) -> OneBody:
    """Return one body of a batch, from a row of `per_body` and the rest of a `BodyBatch`."""
    body, state0, torque = eqx.combine(shared, row, constants)
    return OneBody(body, project_to_group(validation.checked_start(state0, False)), torque)


def check_batch(
    bodies: Inertia | MassProperties,
    states0: Spin | Attitude | Rigid,
    torque: Torque | None,
    torque_axes: TorqueAxes,
) -> BodyBatch:
    """Check the arguments of `rollout`, and return them as a `BodyBatch`.

    The numbers of few bodies are checked here, too; those of many bodies are checked on the device,
    and `BodyBatch.require_valid_numbers` raises the error later.
    """
    if not isinstance(states0, Spin | Attitude | Rigid):
        raise TypeError(
            f"states0: wanted Spin, Attitude or Rigid, got {type(states0).__name__}; for points in "
            "moving frames and bodies on an axis use jax.vmap over rigidjax.simulate"
        )
    if states0.omega.ndim != 2 or not states0.omega.shape[0]:
        raise ValueError(
            "states0: wanted one row for each body, omega of shape (N, 3), got "
            f"{states0.omega.shape}"
            + ("; for one body use rigidjax.simulate" if states0.omega.ndim == 1 else "")
        )
    count = states0.omega.shape[0]
    for path, leaf in jax.tree.leaves_with_path(states0):
        if leaf.shape[0] != count or leaf.ndim != 2:
            raise ValueError(
                f"states0: wanted {count} rows as in omega, got {str(path[-1]).lstrip('.')} of "
                f"shape {leaf.shape}"
            )
    dtype = _checks.common_dtype(states0, "states0")
    _checks.numeric_array(states0.omega, "states0")
    if not isinstance(bodies, Inertia | MassProperties):
        raise TypeError(
            f"bodies: wanted Inertia, or MassProperties for Rigid, got {type(bodies).__name__}"
        )
    tensor = tensor_of(bodies)
    if tensor.ndim not in (2, 3) or (tensor.ndim == 3 and tensor.shape[0] not in (1, count)):
        raise ValueError(
            f"bodies: wanted one body (3, 3), or one for each of the {count} states, ({count}, 3, "
            f"3), got shape {tensor.shape}"
        )
    # The tensors are checked before they are cast to the precision of the states. The moments of a
    # flat body are at the limit of what a mass can have; rounded to float32 they may be beyond it,
    # by more than is allowed in float64.
    bodies, checks = _check_inertia(bodies)
    if isinstance(states0, HasAttitude):
        checks += _check_unit_quaternions(states0.q)
    bodies = jax.tree.map(lambda a: a if a.dtype == dtype else a.astype(dtype), bodies)
    own = tensor.ndim == 3
    if own and tensor.shape[0] == 1 and count > 1:
        bodies, own = jax.tree.map(lambda leaf: leaf[0], bodies), False
    arrays, constants = eqx.partition((bodies, states0, torque), eqx.is_array)
    axes = (
        jax.tree.map(lambda _: own, arrays[0]),
        jax.tree.map(lambda _: True, arrays[1]),
        _own_arrays(arrays[2], torque_axes, count),
    )
    per_body, shared = eqx.partition(arrays, axes)
    # The types are checked on one row of the arrays that have a row for each body. With an
    # `Inertia` the shape of the row is enough: to take the row itself would cost as much time as
    # many steps.
    shape = lambda a: jax.ShapeDtypeStruct(a.shape[1:], a.dtype)  # noqa: E731
    row = (lambda a: a[0]) if isinstance(bodies, MassProperties) else shape
    validation.require_compatible(*eqx.combine(shared, jax.tree.map(row, per_body), constants))
    validation.warn_of_relative_inertia(bodies, torque)
    batch = BodyBatch(shared, per_body, constants, count, dtype, tuple(checks))
    if all(isinstance(index, np.ndarray | np.integer) for index, _ in checks):
        # The numbers of few bodies have been checked on the host, not on the device. The error can
        # be raised at once, before anything is compiled.
        batch.require_valid_numbers()
    return batch


def checked_samples(
    inputs: Mapping[str, ArrayLike] | None,
    torque: Torque | None,
    states0: Spin | Attitude | Rigid,
    num_steps: int,
    step_size: Array,
) -> dict[str, Array] | None:
    """Return the inputs of a torque as arrays (N, num_steps, *k) by name, or `None` if it has none,
    after checks against the torque, the bodies and the steps.
    """
    for name, delay in delays_of(torque):
        if _checks.is_known((delay, step_size)):
            longest, whole = np.abs(np.asarray(delay)).max(), num_steps * float(step_size)
            if longest >= whole:
                raise ValueError(
                    f"inputs[{name!r}]: its delay of {longest:.6g} s is not shorter than the run "
                    f"of {whole:.6g} s, so that no sample would be used"
                )
    wanted = (*states0.omega.shape[:1], num_steps)
    samples = {}
    for name, value in require_inputs(torque, inputs).items():
        rows = _checks.numeric_array(value, f"inputs[{name!r}]")
        if rows.shape[:2] != wanted:
            raise ValueError(
                f"inputs[{name!r}]: wanted shape (N, num_steps, *k) that begins with {wanted}, got "
                f"{rows.shape}"
            )
        rows = _checks.require_finite(rows.astype(states0.omega.dtype), f"inputs[{name!r}]")
        samples[name] = jnp.asarray(rows)
    return samples or None


def _own_arrays(torque: Torque | None, torque_axes: TorqueAxes, num_bodies: int) -> PyTree[bool]:
    """Return which arrays of a torque have a row for each body, as a tree of booleans that may be a
    prefix of the torque.
    """
    if callable(torque_axes) and not isinstance(torque_axes, eqx.Module):
        # The function selects one array, a tuple of arrays, or a member that holds arrays: call it
        # on the torque with the numbers of its leaves in their place.
        leaves, structure = jax.tree.flatten(torque)
        numbered = jax.tree.unflatten(structure, list(range(len(leaves))))
        try:
            picked = jax.tree.leaves(torque_axes(numbered))
        except (AttributeError, IndexError, KeyError, TypeError) as error:
            raise ValueError(
                f"torque_axes: the function selects a part that the torque does not have ({error})"
            ) from None
        if not picked or not all(type(index) is int for index in picked):
            raise ValueError(
                "torque_axes: wanted a function that picks arrays of the law, or parts of it, such "
                f"as lambda law: law.parts[0], got {picked or 'none'}"
            )
        prefix = jax.tree.unflatten(structure, [i in picked for i in range(len(leaves))])
    else:
        for axis in jax.tree.leaves(torque_axes):
            if not isinstance(axis, int) or axis != 0:
                raise ValueError(
                    "torque_axes: wanted 0 and None, or a function that picks the arrays, such as "
                    f"lambda law: law.speed, got {axis!r}"
                )
        prefix = jax.tree.map(
            lambda axis: axis is not None, torque_axes, is_leaf=lambda a: a is None
        )
    own, _ = eqx.partition(torque, prefix)
    for path, leaf in jax.tree.leaves_with_path(own):
        if leaf.ndim == 0 or leaf.shape[0] != num_bodies:
            raise ValueError(
                f"torque_axes: wanted {num_bodies} rows in torque{jax.tree_util.keystr(path)}, got "
                f"shape {leaf.shape}; to make a torque with one row for each body, call its "
                "constructor under jax.vmap"
            )
    return prefix


def _check_inertia(
    bodies: Inertia | MassProperties,
) -> tuple[Inertia | MassProperties, list[Check]]:
    """Return the bodies, with NaN for impossible traced inertias, and checks of known ones."""
    tensor = tensor_of(bodies)
    if not _checks.is_known(tensor):
        return require_physical_body(bodies, throw=False), []
    # Under an outer trace the reshape of a known tensor would be traced without this context.
    with jax.ensure_compile_time_eval():
        tensors = tensor.reshape(-1, 3, 3)

    def refuse(i: int) -> None:
        try:
            Inertia(np.asarray(tensors)[i]).require_invertible()
        except ValueError as error:
            raise ValueError(f"bodies: {error}; this is body {i}") from None

    return bodies, [Check(first_impossible_inertia(tensors), refuse)]


def _check_unit_quaternions(q: Array) -> list[Check]:
    """Return a check of the quaternions, if they are known."""
    if not _checks.is_known(q):
        return []

    def is_not_unit(xp: ModuleType, q: np.ndarray | Array) -> Any:
        length = xp.sqrt(xp.sum(xp.square(q), axis=-1))
        return xp.abs(length - 1) > rotation_tolerance(q.dtype)

    def refuse(i: int) -> None:
        length = np.linalg.norm(np.asarray(q)[i])
        raise ValueError(
            f"q: wanted unit quaternions (w, x, y, z), got length {length:.6g} for body {i}; "
            "normalise with rigidjax.quaternion.normalise, and mind that the scalar is first"
        )

    return [Check(_checks.first_bad_row(is_not_unit, q), refuse)]


def checked_steps(step_size: ScalarLike, num_steps: int, dtype: np.dtype) -> tuple[Array, int]:
    """Return the length of a step, s, and the number of steps, after checks."""
    h = _checks.array_of_shape(step_size, (), "step_size").astype(dtype)
    if _checks.is_known(h) and not 0 < float(h) < np.inf:
        raise ValueError(
            f"step_size: wanted a positive step, s, got {step_size}; to run backwards, start "
            "with −Ω and give a torque that is evaluated at −t"
        )
    return h, _checks.integer(num_steps, "num_steps", 1)
