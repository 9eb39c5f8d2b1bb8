"""Simulate a batch with fixed steps, differentiably in both modes and in bounded memory."""

from collections.abc import Callable, Mapping
from typing import Any, TypeVar, overload

import jax
import jax.numpy as jnp
from jax import lax
from jax.sharding import Mesh
from jaxtyping import Array, ArrayLike, PyTree

from rigidjax import _checks
from rigidjax._types import ScalarLike
from rigidjax.batch.sharding import CompiledFunction, Devices, chunk_of, map_bodies, mesh_of
from rigidjax.batch.validation import TorqueAxes, check_batch, inputs_of_bodies, one_body, step_of
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.motion import Attitude, Rigid, Spin
from rigidjax.motion.coupled import with_own_states
from rigidjax.motion.torques import bind
from rigidjax.motion.torques.base import Torque
from rigidjax.solve import equations_of_motion
from rigidjax.solve.explicit import AbstractExplicit
from rigidjax.solve.fixed_loop import first_row, march_steps
from rigidjax.solve.magnus import Magnus4
from rigidjax.solve.pieces import piece_length
from rigidjax.solve.splitting import AbstractSplitting
from rigidjax.solve.steppers import stepper_of

State = TypeVar("State", Spin, Attitude, Rigid)
Reduced = TypeVar("Reduced")
# (carried value, time, state of one body) → next carried value.
Reduce = Callable[[Any, Array, Any], Any]
# By name, samples of each body (N, steps, *k), each held through a step.
Inputs = Mapping[str, ArrayLike] | None
Solver = AbstractExplicit | Magnus4 | AbstractSplitting | None
# Bytes that reverse mode may keep of all chunks together.
_MOST_KEPT = 2**23


@overload
def rollout(
    bodies: Inertia | MassProperties,
    states0: State,
    step_size: ScalarLike,
    num_steps: int,
    torque: Torque | None = None,
    *,
    solver: Solver = None,
    save_every: int | None = None,
    reduce: None = None,
    initial: None = None,
    t0: ScalarLike = 0.0,
    inputs: Inputs = None,
    torque_axes: TorqueAxes = None,
    chunk: int | None = None,
    devices: Devices = None,
) -> State: ...


@overload
def rollout(
    bodies: Inertia | MassProperties,
    states0: State,
    step_size: ScalarLike,
    num_steps: int,
    torque: Torque | None = None,
    *,
    reduce: Reduce,
    initial: Reduced,
    solver: Solver = None,
    save_every: int | None = None,
    t0: ScalarLike = 0.0,
    inputs: Inputs = None,
    torque_axes: TorqueAxes = None,
    chunk: int | None = None,
    devices: Devices = None,
) -> tuple[State, Reduced]: ...


def rollout(
    bodies: Inertia | MassProperties,
    states0: PyTree,
    step_size: ScalarLike,
    num_steps: int,
    torque: Torque | None = None,
    *,
    solver: Solver = None,
    save_every: int | None = None,
    reduce: Reduce | None = None,
    initial: PyTree = None,
    t0: ScalarLike = 0.0,
    inputs: Inputs = None,
    torque_axes: TorqueAxes = None,
    chunk: int | None = None,
    devices: Devices = None,
) -> Any:
    """Take `num_steps` fixed steps of N bodies, each with its own state, inertia and torque.

    **Arguments:**

    - `bodies`: one `Inertia` (3, 3) for all, or one per body (N, 3, 3), kg m², body frame;
      `MassProperties` likewise for `Rigid`.
    - `states0`: `Spin`, `Attitude` or `Rigid` whose arrays have a leading axis N, at `t0`.
    - `step_size` s, the same for all; `num_steps` a whole number, a constant of the program.
    - `torque`: `None`, or any torque that `rigidjax.simulate` takes. All bodies share its arrays
      unless `torque_axes` says otherwise.
    - `torque_axes`: which arrays of the torque have a leading axis N: `None` none, 0 all
      (`jax.vmap` of its constructor makes such a torque), a function that picks them
      (`lambda law: law.speed`, for a `Sum` `lambda law: law.parts[1]`, several in a tuple), or a
      tree like the torque with 0 for those that have it and `None` for the others.
    - `solver`: `None` takes `Magnus4` for a free attitude, or a torque that does not depend on the
      attitude, and else `rigidjax.solvers.RungeKutta4`. It may be any explicit method of
      `rigidjax.solvers`; the steps agree with those of `diffrax` to round-off. Runs of 10 000
      steps or more add with compensation (the digits that an addition loses are carried to the
      next), so that round-off grows as √n, not as n.
    - `save_every`: `None` returns the last states only; k the states after k, 2k, … steps.
    - `reduce`, `initial`: a function `(carried, t, state) → carried` of one body, called after
      every `save_every` steps (one, by default), and the first carried value. No states are
      kept then. Define the function once, best as a Module: each new function compiles again.
    - `t0`: s, the time of the first step.
    - `inputs`: the inputs of the torque, by the names of its `rigidjax.torques.Input`s: arrays (N,
      num_steps, *k) whose row i is held exactly through step i of that body, or, for a
      `rigidjax.torques.Delayed` input, after its delay.
    - `chunk`: the number of bodies computed at a time; `None` takes as many as fill the
      first-level cache (64 in float64), and on a GPU all. It changes the last digits at most.
    - `devices`: `None` for the default device, `"all"` for those of this process, or a sequence
      of devices, which get equal shares of the bodies. It changes the last digits at most.

    **Returns** the states, of the type of `states0`, with leading axes (N,) or, with `save_every`,
    (N, num_steps // save_every); with `reduce` the pair (last states, carried). Under a torque with
    states of its own they have `.motion` and `.own`.

    The memory needed is that of the inputs, of the results and of one chunk, also in reverse mode,
    which takes five to ten times as long as the value. Derivatives are the exact derivatives of the
    steps, in both modes. A body that becomes NaN changes no other body. For calls inside your own
    `jax.jit` see `compiler_options`.

    **Raises:** `TypeError` if bodies, states, torque and solver do not fit together; `ValueError`
    for shapes that do not agree, an input that is missing or that no torque reads, a step that is
    not positive, or a `save_every` that does not divide `num_steps`. Known numbers are checked too:
    `ValueError` for an inertia that no mass has, for a moment of zero, and for a quaternion that is
    not unit. A traced inertia of this kind, or one of NaN, makes that body NaN and no other.

    >>> bodies = rj.Inertia(jnp.diag(jnp.array([1.0, 2.0, 3.0])))
    >>> states = rj.Attitude(jnp.tile(jnp.eye(4)[0], (5, 1)), jnp.tile(jnp.eye(3)[2], (5, 1)))
    >>> rj.batch.rollout(bodies, states, 0.01, 100).q[4, 3]
    Array(0.47942554, dtype=float64)
    """
    batch = check_batch(bodies, states0, torque, torque_axes)
    h, count = step_of(step_size, num_steps, batch.dtype)
    samples = inputs_of_bodies(inputs, torque, states0, count, h)
    if reduce is None and initial is not None:
        raise ValueError(
            "rollout: initial is the first carried value of reduce, but no reduce was given"
        )
    if reduce is not None and not callable(reduce):
        raise TypeError(
            f"reduce: wanted a function (carried, t, state) -> carried, got {type(reduce).__name__}"
        )
    every = (1 if reduce is not None else count) if save_every is None else save_every
    if not isinstance(every, int) or every < 1 or count % every:
        raise ValueError(f"save_every: wanted a divisor of num_steps = {count}, got {save_every!r}")
    start = jax.tree.map(jnp.asarray, initial)
    begin = _checks.checked_time(t0, "t0").astype(batch.dtype)
    numbers = (batch.shared, (batch.per_body, samples), start, h, begin)
    steps = solver, count, every, save_every is not None and reduce is None
    division = chunk_of(chunk, batch.dtype, batch.num_bodies), mesh_of(devices)
    out = _compiled(steps, division, reduce, batch.constants, numbers)
    batch.require()
    return out


def _take_steps(
    steps: tuple[Solver, int, int, bool],
    division: tuple[int, Mesh | None],
    reduce: Reduce | None,
    constants: PyTree,
    numbers: tuple[PyTree, ...],
) -> PyTree:
    """Return what `rollout` returns, from its arguments after they have been checked.

    **Arguments:** `steps` the solver, the number of steps, the number of steps between two saved
    states, and whether states are saved; `division` the size of a chunk and the mesh of devices;
    `constants` the leaves of the batch that are no arrays; `numbers` its shared arrays, those of
    each body with their inputs, the first carried value, the step size and t0.
    """
    (solver, count, every, keep), (shared, per_body, initial, h, t0) = steps, numbers

    def step_body(numbers: PyTree, row: PyTree) -> PyTree:
        shared, initial, h, t0 = numbers
        own, inputs = row
        body, state0, torque = one_body(shared, own, constants)
        state0 = with_own_states(body, state0, bind(torque, first_row(torque, h, inputs)), t0)
        field = equations_of_motion(body, state0, torque)
        stepper = stepper_of(solver, field, state0, count)

        def advance(carry: PyTree, first: Array) -> tuple[PyTree, PyTree]:
            # From one saved state, which is followed by the step `first`, to the next.
            y, carried = carry
            y = march_steps(stepper, h, t0, first, every, y, inputs)
            if reduce is not None:
                t = t0 + (first + every).astype(h.dtype) * h
                carried = reduce(carried, t, stepper.state(y))
            return (y, carried), stepper.state(y) if keep else None

        begin = (stepper.start, initial)
        if every == count:
            (y, carried), saved = advance(begin, jnp.zeros((), jnp.int32))
            saved = jax.tree.map(lambda leaf: leaf[None], saved)
        else:
            firsts = jnp.arange(0, count, every, dtype=jnp.int32)
            (y, carried), saved = lax.scan(advance, begin, firsts)
        if reduce is not None:
            return stepper.state(y), carried
        return saved if keep else stepper.state(y)

    size = sum(leaf.size for leaf in jax.tree.leaves(per_body[0])) * h.dtype.itemsize
    if size * (count // every) * (every // piece_length(every) + 1) > _MOST_KEPT:
        # A reverse pass then computes each chunk again, and keeps the states of one chunk only.
        step_body = jax.checkpoint(step_body)
    return map_bodies(step_body, (shared, initial, h, t0), per_body, *division)


_compiled = CompiledFunction(_take_steps)
