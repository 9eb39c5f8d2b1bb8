"""The errors of all readings, and their derivatives recording by recording."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from rigidjax.identify import padding
from rigidjax.identify.free_parameters import put
from rigidjax.identify.parameters import Local, Parameters, columns, local, places
from rigidjax.identify.propagation import states_at
from rigidjax.identify.recording import Recording
from rigidjax.identify.reference_states import ReferenceStates
from rigidjax.identify.sensor_inputs import sensor_inputs, what_turns
from rigidjax.identify.sensors import SensorInput
from rigidjax.identify.several_bodies import matter
from rigidjax.motion.coupled import motion_of

if TYPE_CHECKING:
    from rigidjax.identify.problem import Problem


def filled(problem: "Problem", mine: Local, record: Recording) -> Recording:
    """One recording with the values of the free numbers in it."""
    values = [
        slot.move(slot.read(record), step)
        for slot, step in zip(problem.slots, mine.steps, strict=True)
    ]
    return put(record, problem.slots, values)


def states_of_one(
    problem: "Problem", mine: Local, record: Recording, ref: ReferenceStates, which: Array | None
) -> tuple[Recording, Any, Any, Any]:
    """One recording with its values filled in, its body, its initial state and its states.

    The states are `Coupled` if a torque has states of its own.
    """
    record = filled(problem, mine, record)
    body = matter(problem.body, mine.body, which)
    state0 = ref.moved(mine)
    turned = what_turns(body, problem.rung)
    states = states_at(problem.integrator, turned, state0, record.t, record.torque)
    return record, body, state0, states


def errors_of_one(
    problem: "Problem", mine: Local, record: Recording, ref: ReferenceStates, which: Array | None
) -> tuple[tuple[Array, ...], Any]:
    """The errors (T, k) of each sensor in one recording, and the last state.

    **Arguments:** `mine` the numbers that it depends on; `record`, `ref`; `which` the index of its
    body among several.
    """
    record, body, state0, states = states_of_one(problem, mine, record, ref, which)
    out = []
    for reading in record.readings:
        sensor = reading.sensor
        times, seen, now = sensor_inputs(sensor, body, record.torque, record.t, state0, states)

        def error(t: Array, state: Any, value: Array, of: Any = (sensor, now)) -> Array:
            sensor, now = of
            return _error_of(sensor, now(t, state), value)

        lowpass = getattr(sensor, "lowpass", None)
        if lowpass is None:
            errors = jax.vmap(error)(times, seen, reading.values)
        else:
            # The error of a zero reading is the prediction with the opposite sign.
            shown = jax.vmap(error)(times, seen, jnp.zeros_like(reading.values))
            errors = reading.values + lowpass(times, shown)
        out.append(jnp.where(reading.mask[:, None], errors, 0.0))
    return tuple(out), jax.tree.map(lambda leaf: leaf[-1], motion_of(states))


def _error_of(sensor: Any, now: SensorInput, value: Array) -> Array:
    """The checked result of a sensor's `error`, which a user may have written."""
    name = type(sensor).__name__
    try:
        found = sensor.error(now, value)
    except AttributeError as wrong:
        if type(now.state).__name__ not in str(wrong):
            raise
        raise TypeError(
            f"{name}.error: {wrong}; it has feels = {sensor.feels.__name__}, but it reads more "
            "than that: set feels = rj.motion.HasAttitude, or rj.motion.HasPose"
        ) from wrong
    wanted = (sensor.components,)
    if jnp.shape(found) != wanted:
        raise ValueError(
            f"{name}.error: wanted reading minus prediction of shape {wanted}, as components = "
            f"{sensor.components} says, got {jnp.shape(found)}"
        )
    return found


def over_records(function: Any, problem: "Problem", mine: Any) -> Any:
    """`function(mine, record, reference, which)` of every recording.

    On a CPU recordings run one after another: XLA makes one kernel of a loop over a few dozen
    numbers. For many recordings at once it does not; that compiles twice as long and runs longer.
    Batches have size one, since scalars within another loop run at half the speed.
    """
    trees = mine, problem.records, problem.reference, problem.which
    if problem.count == 1:
        # Without the outer loop it compiles to a smaller program.
        out = function(*(padding.one(tree, 0) for tree in trees))
        return jax.tree.map(lambda leaf: leaf[None], out)
    if jax.default_backend() == "cpu":
        return lax.map(lambda each: function(*each), trees, batch_size=1)
    return jax.vmap(function)(*trees)


@eqx.filter_custom_jvp
def all_errors(parameters: Parameters, problem: "Problem") -> tuple[tuple[Array, ...], Any]:
    """The errors (R, T, k) of each sensor, and the last states (R, …).

    Its derivative is computed recording by recording: each has a block for the numbers that it
    depends on, and no zeros pass through the motion.
    """

    def of_one(*trees: Any) -> Any:
        return errors_of_one(problem, *trees)

    return over_records(of_one, problem, local(problem, parameters))


@all_errors.def_jvp
def _all_errors_jvp(primals: Any, tangents: Any) -> Any:
    parameters, problem = primals
    step, beside = tangents
    if jax.tree.leaves(beside):
        raise TypeError(
            "all_errors: only derivatives in the parameters are taken block by block; use "
            "errors_of_one for those in the problem"
        )
    out, blocks = with_blocks(parameters, problem)
    zeros = jax.tree.map(
        lambda p, s: jnp.zeros_like(p) if s is None and p is not None else s,
        parameters,
        step,
        is_leaf=lambda node: node is None,
    )
    return out, along(problem, blocks, zeros)


def along(problem: "Problem", blocks: Any, step: Parameters) -> Any:
    """The derivatives of `with_blocks` along a step of all parameters."""
    flat = ravel_pytree(step)[0]
    where = places(problem, step)
    moved = jnp.concatenate([flat, jnp.zeros(1, flat.dtype)])[where]
    return jax.tree.map(lambda block: jnp.einsum("r...n,rn->r...", block, moved), blocks)


def normal_matrix(blocks: Sequence[Array], where: Array, size: int) -> Array:
    """Σ JᵀJ (n, n) of blocks (R, T, k, m), their columns at the places `where` (R, m) of n."""
    total = jnp.zeros((size + 1, size + 1), blocks[0].dtype)
    for rows in blocks:
        squares = jnp.einsum("rtki,rtkj->rij", rows, rows)
        total = total.at[where[:, :, None], where[:, None, :]].add(squares)
    return total[:-1, :-1]


def with_blocks(parameters: Parameters, problem: "Problem") -> tuple[Any, Any]:
    """The errors and last states, and their derivatives (…, n) in what each recording depends on.

    `places` gives the flattened parameter of each of the n columns.
    """
    mine = local(problem, parameters)
    single = padding.one(mine, 0)
    twice = columns(problem, single)

    def of_one(one: Local, record: Recording, ref: ReferenceStates, which: Array | None) -> Any:
        flat, restore = ravel_pytree(one)
        blocks, out = with_jacobian(
            lambda vector: errors_of_one(problem, restore(vector), record, ref, which), flat
        )
        if twice.size > flat.size:
            blocks = jax.tree.map(lambda block: block[..., twice], blocks)
        return out, blocks

    return over_records(of_one, problem, mine)


def with_jacobian(function: Callable[[Array], Any], at: Float[Array, " n"]) -> tuple[Any, Any]:
    """The derivative (…, n) of a function, in forward mode, and its value (…).

    >>> with_jacobian(lambda x: x * x, jnp.array([1.0, 3.0]))[0].tolist()
    [[2.0, 0.0], [0.0, 6.0]]
    """

    def twice(at: Array) -> tuple[Any, Any]:
        found = function(at)
        return found, found

    return jax.jacfwd(twice, has_aux=True)(at)
