"""Simulate many bodies with fixed steps, differentiably in forward and reverse mode."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeVar, overload

import diffrax as dfx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, PyTree

from rigidjax import _checks
from rigidjax._names import suggest_arguments
from rigidjax._types import ScalarLike
from rigidjax.batch.sharding import CompiledFunction, Devices, Division, divide_batch, map_bodies
from rigidjax.batch.validation import (
    TorqueAxes,
    check_batch,
    checked_samples,
    checked_steps,
    one_body,
)
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.motion import Attitude, Rigid, Spin
from rigidjax.motion.coupled import with_own_states
from rigidjax.motion.torques import bind
from rigidjax.motion.torques.base import Torque
from rigidjax.solve import equations_of_motion
from rigidjax.solve.steps.explicit import AbstractExplicit
from rigidjax.solve.steps.fixed import inputs_at_start, march_steps
from rigidjax.solve.steps.magnus import Magnus4
from rigidjax.solve.steps.pieces import steps_per_piece
from rigidjax.solve.steps.splitting import AbstractSplitting
from rigidjax.solve.steps.steppers import stepper_of

State = TypeVar("State", Spin, Attitude, Rigid)
Reduced = TypeVar("Reduced")
# The type of `reduce`: (carried value, time, state of one body) → next carried value.
Reduce = Callable[[Any, Array, Any], Any]
# The type of `inputs`: by the name of each input of the torque an array (N, steps, *k), which has
# a sample of the shape k for each of N bodies and each step. A sample is constant during its step.
Inputs = Mapping[str, ArrayLike] | None
Solver = AbstractExplicit | Magnus4 | AbstractSplitting | None
# The largest size, in bytes, of the intermediate states that reverse mode stores for all chunks
# together. If they are larger, reverse mode computes each chunk once more instead.
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
    progress_meter: dfx.AbstractProgressMeter | None = None,
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
    progress_meter: dfx.AbstractProgressMeter | None = None,
) -> tuple[State, Reduced]: ...


@suggest_arguments
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
    progress_meter: dfx.AbstractProgressMeter | None = None,
) -> Any:
    """Take `num_steps` fixed steps of N bodies, each with its own state, inertia and torque.

    **Arguments:**

    - `bodies`: an `Inertia` in kg m², body frame: (3, 3) if all bodies share it, or (N, 3, 3), one
      for each body. For `Rigid` states a `MassProperties`, shared or one for each body.
    - `states0`: the states at `t0`: a `Spin`, `Attitude` or `Rigid` whose arrays have a leading
      axis N.
    - `step_size`: the length of a step in seconds, equal for all bodies.
    - `num_steps`: the number of steps, a Python `int`; for another number the function is compiled
      again.
    - `torque`: `None`, or any torque that `rigidjax.simulate` takes. All bodies share its arrays
      unless `torque_axes` says otherwise.
    - `torque_axes`: which arrays of the torque have a leading axis N, with one row for each body.
      `None` means that no array has it. 0 means that all have it (`jax.vmap` of the torque's
      constructor makes such a torque). A function selects the arrays, or the parts of the torque
      that hold them: `lambda law: law.speed`, or `lambda law: law.parts[1]` for a `Sum`; it returns
      several in a tuple. Or give a tree with the structure of the torque, with 0 in the place of
      each array with this axis, and `None` in the place of each array without it.
    - `solver`: `None` takes `Magnus4` for the attitude of a free body or under a torque that does
      not depend on the attitude, and `rigidjax.solvers.RungeKutta4` otherwise. Any explicit method
      of `rigidjax.solvers` may be given; its steps agree with those of `diffrax` to round-off. Runs
      of 10 000 steps or more use compensated addition (the digits that one addition loses enter the
      next addition), so that the round-off of n steps grows as √n, not as n.
    - `save_every`: `None` returns the last states only; a number k returns the states after k, 2k,
      … steps.
    - `reduce`: a function `(carried, t, state) → carried` of one body, which is called after every
      `save_every` steps (every step by default). With `reduce` only the last states are returned.
      Define the function once, best as a Module: JAX compiles again for each new function.
    - `initial`: the first carried value of `reduce`, the same for all bodies.
    - `t0`: the time at which the first step begins, in seconds.
    - `inputs`: the inputs of the torque, by the names of its `rigidjax.torques.Input`s: arrays (N,
      num_steps, *k). Row i of a body is constant during step i. Inside a `rigidjax.torques.Delayed`
      each row acts later by the delay.
    - `chunk`: the number of bodies computed at a time; `None` takes as many as fill the
      first-level cache (64 in float64) on CPU, and all bodies on a GPU. Another `chunk` changes the
      last digits at most.
    - `devices`: `None` for the default device, `"all"` for all devices of this process, or a
      sequence of devices. The devices get equal shares of the bodies. Another choice changes the
      last digits at most.
    - `progress_meter`: a progress meter of diffrax, such as `diffrax.TextProgressMeter()`, which is
      moved after each chunk; it cannot be given together with `devices`.

    **Returns** the states, of the type of `states0`, with leading axes (N,) or, with `save_every`,
    (N, num_steps // save_every); with `reduce` the pair (last states, carried value). Under a
    torque with states of its own the returned states have two fields: `.motion`, of the type of
    `states0`, and `.own`, the states of the torque.

    The memory needed is that of the inputs, of the results and of one chunk, also in reverse mode.
    A reverse-mode gradient takes five to ten times as long as the value. In forward and reverse
    mode the derivatives are the exact derivatives of the discrete steps. A body that becomes NaN
    changes no other body. For calls inside your own `jax.jit` see `compiler_options`.

    **Raises:** `TypeError` if bodies, states, torque and solver do not fit together; `ValueError`
    for shapes that do not agree, an input that is missing or that no torque reads, a step that is
    not positive, or a `save_every` that does not divide `num_steps`. Numbers that are not traced
    are checked, too: `ValueError` for an inertia that no mass has, for a moment of zero, and for a
    quaternion that is not unit. For a traced inertia that is NaN, or that no mass has, no error is
    raised: it makes the states of its own body NaN, and those of no other body.

    >>> bodies = rj.Inertia(jnp.diag(jnp.array([1.0, 2.0, 3.0])))
    >>> states = rj.Attitude(jnp.tile(jnp.eye(4)[0], (5, 1)), jnp.tile(jnp.eye(3)[2], (5, 1)))
    >>> rj.batch.rollout(bodies, states, 0.01, 100).q[4, 3]
    Array(0.47942554, dtype=float64)
    """
    batch = check_batch(bodies, states0, torque, torque_axes)
    h, count = checked_steps(step_size, num_steps, batch.dtype)
    samples = checked_samples(inputs, torque, states0, count, h)
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
    numbers = Arrays(batch.shared, (batch.per_body, samples), start, h, begin)
    steps = FixedSteps(solver, count, every, save_every is not None and reduce is None)
    division = divide_batch(chunk, devices, progress_meter, batch.dtype, batch.num_bodies)
    out = _compiled(steps, division, reduce, batch.constants, numbers)
    batch.require_valid_numbers()
    return out


class FixedSteps(NamedTuple):
    """Hold the steps of a rollout."""

    solver: Solver
    number: int
    every: int  # the number of steps between two saved states, or two calls of `reduce`
    keep: bool  # whether these states are returned, in place of the last ones


class Arrays(NamedTuple):
    """Hold the arrays of a rollout."""

    shared: PyTree
    per_body: tuple[PyTree, PyTree]  # of bodies, states and torque, and the inputs of the torque
    initial: PyTree  # the first carried value of `reduce`
    h: Array  # the step size, s
    t0: Array  # s


def _rollout(
    steps: FixedSteps, division: Division, reduce: Reduce | None, constants: PyTree, numbers: Arrays
) -> PyTree:
    """Take fixed steps of many bodies, and return what `rollout` returns."""
    (solver, count, every, keep), (shared, per_body, initial, h, t0) = steps, numbers

    def step_body(numbers: PyTree, row: PyTree) -> PyTree:
        shared, initial, h, t0 = numbers
        own, inputs = row
        body, state0, torque = one_body(shared, own, constants)
        state0 = with_own_states(body, state0, bind(torque, inputs_at_start(torque, h, inputs)), t0)
        field = equations_of_motion(body, state0, torque)
        stepper = stepper_of(solver, field, state0, count)

        def advance(carry: PyTree, first: Array) -> tuple[PyTree, PyTree]:
            # This function takes the steps from one saved state to the next one. They begin with
            # step number `first` of the run, counted from 0.
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
    if size * (count // every) * (every // steps_per_piece(every) + 1) > _MOST_KEPT:
        # With `jax.checkpoint` the reverse pass computes each chunk once more, and stores the
        # states of one chunk at a time.
        step_body = jax.checkpoint(step_body)
    return map_bodies(step_body, (shared, initial, h, t0), per_body, division)


_compiled = CompiledFunction(_rollout)
