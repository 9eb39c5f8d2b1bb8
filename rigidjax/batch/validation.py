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
from rigidjax.body.validation import index_of_first_impossible_inertia
from rigidjax.motion import Attitude, Rigid, Spin
from rigidjax.motion.equations import project_to_group
from rigidjax.motion.torques.base import Torque
from rigidjax.motion.torques.inputs import delays_of, require_inputs
from rigidjax.rotation.validation import rotation_tolerance
from rigidjax.solve import validation

# The type of `torque_axes`, which says which arrays of a torque have a row for each body: 0 for
# all, a function that selects the arrays, or a tree of 0 and `None`.
TorqueAxes = int | Callable[[Any], Any] | PyTree
# A check is a pair: the index of the first wrong body, or −1; and a function that raises the error
# for this body.
Check = tuple[Any, Callable[[int], None]]


class BodyBatch(NamedTuple):
    """Hold the bodies, initial states and torque of many runs, split into three trees.

    The three trees are `shared`, `per_body` and `constants`. Each of them has the structure of the
    tree `(bodies, states0, torque)`. Each leaf of this tree is in one of the three trees; the other
    two have `None` in its place.
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
        """Raise an error for the first body with an impossible inertia or a non-unit quaternion.

        The bodies are those of this batch. Traced numbers are not checked. Call this function after
        the computation has been started: the device then checks the bodies while the host works on,
        and neither waits for the other.
        """
        for index, refuse in self.checks:
            if (i := int(index)) >= 0:
                refuse(i)


def inertia_state_and_torque(
    shared: PyTree, row: PyTree, constants: PyTree
) -> tuple[Inertia | MassProperties, Any, Torque | None]:
    """Return the inertia, the initial state and the torque of one body of a batch.

    **Arguments:**

    - `shared`, `constants`: the trees with these names of a `BodyBatch`: the arrays that all bodies
      share, and the leaves that are no arrays.
    - `row`: the row of this body in the tree `per_body` of the `BodyBatch`.

    **Returns** three things: the `Inertia` or `MassProperties`; the state, which is NaN if it is
    invalid; and the torque.
    """
    body, state0, torque = eqx.combine(shared, row, constants)
    return body, project_to_group(validation.checked_start(state0, False)), torque


def check_batch(
    bodies: Inertia | MassProperties,
    states0: Spin | Attitude | Rigid,
    torque: Torque | None,
    torque_axes: TorqueAxes,
) -> BodyBatch:
    """Check the bodies, initial states and torque of `rollout`, and return them as a `BodyBatch`.

    The arguments are those of `rollout` with the same names. Raise `TypeError` and `ValueError` for
    wrong types and shapes. The numbers of few bodies are checked here, too; those of many bodies
    are checked on the device, and `BodyBatch.require_valid_numbers` raises the error later.
    """
    if not isinstance(states0, Spin | Attitude | Rigid):
        raise TypeError(
            f"states0: wanted Spin, Attitude or Rigid, got {type(states0).__name__}; for points in "
            "moving frames use jax.vmap over rigidjax.simulate"
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
    dtype = validation.common_dtype(states0, "states0")
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
        _mask_of_arrays_with_body_rows(arrays[2], torque_axes, count),
    )
    per_body, shared = eqx.partition(arrays, axes)
    # The types are checked on one row of the arrays that have a row for each body. With an
    # `Inertia` the shape of the row is enough: to take the row itself would cost as much time as
    # many steps.
    shape = lambda a: jax.ShapeDtypeStruct(a.shape[1:], a.dtype)  # noqa: E731
    row = (lambda a: a[0]) if isinstance(bodies, MassProperties) else shape
    validation.require_compatible_types(
        *eqx.combine(shared, jax.tree.map(row, per_body), constants)
    )
    validation.warn_of_unknown_inertia_scale(bodies, torque)
    batch = BodyBatch(shared, per_body, constants, count, dtype, tuple(checks))
    if all(isinstance(index, np.ndarray | np.integer) for index, _ in checks):
        # The numbers of few bodies have been checked on the host, not on the device. The error can
        # be raised at once, before anything is compiled.
        batch.require_valid_numbers()
    return batch


def checked_inputs_of_bodies(
    inputs: Mapping[str, ArrayLike] | None,
    torque: Torque | None,
    states0: Spin | Attitude | Rigid,
    num_steps: int,
    step_size: Array,
) -> dict[str, Array] | None:
    """Return the inputs of a torque as arrays (N, num_steps, *k) by name, after a check.

    **Arguments:**

    - `inputs`: arrays by the names of the torque's inputs, or `None`.
    - `torque`: the torque, or `None`.
    - `states0`: the initial states of the N bodies, whose precision the arrays get.
    - `num_steps`, `step_size`: the number of steps, and the length of a step, s.

    Raise `ValueError` for inputs that do not fit the torque, the bodies or the steps. The result is
    `None` for a torque without inputs.
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


def _mask_of_arrays_with_body_rows(
    torque: Torque | None, torque_axes: TorqueAxes, num_bodies: int
) -> PyTree[bool]:
    """Return which arrays of a torque have a row for each body of a batch, as a tree of booleans.

    The tree has the structure of `torque`, except that one boolean may stand for all arrays of a
    part of the torque. `torque_axes` says which arrays have such rows: it is a function that picks
    these arrays from a torque, or a tree with 0 for them and `None` for arrays that all bodies
    share. Raise `ValueError` if an array that is said to have such rows has not `num_bodies` of
    them.
    """
    if callable(torque_axes) and not isinstance(torque_axes, eqx.Module):
        prefix = _mask_of_selected_arrays(torque, torque_axes)
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


def _mask_of_selected_arrays(torque: Torque | None, select: Callable[[Any], Any]) -> PyTree[bool]:
    """Return which arrays of a torque a function selects, as a tree of booleans like the torque.

    `select` is that function: `select(torque)` returns one array, a tuple of arrays, or a member of
    the torque that holds arrays, all of which are then selected. Raise `ValueError` if it selects
    no array.
    """
    leaves, structure = jax.tree.flatten(torque)
    numbered = jax.tree.unflatten(structure, list(range(len(leaves))))
    try:
        picked = jax.tree.leaves(select(numbered))
    except (AttributeError, IndexError, KeyError, TypeError) as error:
        raise ValueError(
            f"torque_axes: the function selects a part that the torque does not have ({error})"
        ) from None
    if not picked or not all(type(index) is int for index in picked):
        raise ValueError(
            "torque_axes: wanted a function that picks arrays of the law, or parts of it, such as "
            f"lambda law: law.parts[0], got {picked or 'none'}"
        )
    return jax.tree.unflatten(structure, [i in picked for i in range(len(leaves))])


def _check_inertia(
    bodies: Inertia | MassProperties,
) -> tuple[Inertia | MassProperties, list[Check]]:
    """Return the bodies, and a check of whether each of them has an inertia that a mass can have.

    **Returns** two things: the bodies; and a list with one check. The check is a pair: the index of
    the first body whose inertia is impossible (−1 if there is none), and a function that raises the
    error for the body whose index it is given. If the bodies are traced, nothing can be raised: the
    list is empty, and a body with an impossible inertia is replaced by NaN.
    """
    tensor = tensor_of(bodies)
    if not _checks.is_known(tensor):
        return validation.real_or_nan(bodies), []
    # Under an outer trace the reshape of a known tensor would be traced without this context.
    with jax.ensure_compile_time_eval():
        tensors = tensor.reshape(-1, 3, 3)

    def refuse(i: int) -> None:
        try:
            Inertia(np.asarray(tensors)[i]).require_invertible()
        except ValueError as error:
            raise ValueError(f"bodies: {error}; this is body {i}") from None

    return bodies, [(index_of_first_impossible_inertia(tensors), refuse)]


def _check_unit_quaternions(q: Array) -> list[Check]:
    """Return the check that each of N quaternions `q` (N, 4) is a unit quaternion.

    The check is a list with one pair: the index of the first body whose quaternion has another
    length than 1 (−1 if there is none), and a function that raises the error for the body whose
    index it is given. If `q` is traced, nothing can be raised, and the list is empty.
    """
    if not _checks.is_known(q):
        return []

    def refuse(i: int) -> None:
        length = np.linalg.norm(np.asarray(q)[i])
        raise ValueError(
            f"q: wanted unit quaternions (w, x, y, z), got length {length:.6g} for body {i}; "
            "normalise with rigidjax.quaternion.normalise, and mind that the scalar is first"
        )

    return [(_checks.first_bad_row(_is_not_unit, q), refuse)]


def _is_not_unit(xp: ModuleType, q: np.ndarray | Array) -> Any:
    """Return for each quaternion of `q` (…, 4) whether its length differs from 1, as (…) booleans.

    A difference of at most 1e-6 in float64, or 1e-3 in float32, is not counted. `xp` is the module
    that computes: NumPy or `jax.numpy`.
    """
    return xp.abs(xp.sqrt(xp.sum(xp.square(q), axis=-1)) - 1) > rotation_tolerance(q.dtype)


def checked_step_size_and_number(
    step_size: ScalarLike, num_steps: int, dtype: np.dtype
) -> tuple[Array, int]:
    """Return the length of a step, s, and the number of steps, after a check of each.

    `step_size` and `num_steps` are the arguments of `rollout`; `dtype` is the precision that the
    length gets. Raise `ValueError` for a known length that is not positive and finite, and for a
    number of steps below 1; raise `TypeError` for a number of steps that is not an integer.
    """
    h = _checks.array_of_shape(step_size, (), "step_size").astype(dtype)
    if _checks.is_known(h) and not 0 < float(h) < np.inf:
        raise ValueError(
            f"step_size: wanted a positive step, s, got {step_size}; to go back in time negate Ω "
            "and the time of the torque"
        )
    return h, _checks.integer(num_steps, "num_steps", 1)
