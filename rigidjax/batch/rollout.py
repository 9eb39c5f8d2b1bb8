"""Fixed steps for a whole batch, differentiable in both modes in bounded memory."""

from collections.abc import Callable
from typing import Any, TypeVar, overload

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax import _checks
from rigidjax._types import ScalarLike
from rigidjax.batch.sharding import Compiled, chunk_of, mesh_of, over_bodies
from rigidjax.batch.validation import bodies_of, driven_by, one_of, step_of
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.motion import Attitude, Rigid, Spin
from rigidjax.motion.coupled import started
from rigidjax.motion.torques import bind
from rigidjax.solve import equations_of_motion
from rigidjax.solve.explicit import AbstractExplicit
from rigidjax.solve.fixed_loop import first_row, march
from rigidjax.solve.magnus import Magnus4
from rigidjax.solve.pieces import piece_length
from rigidjax.solve.splitting import AbstractSplitting
from rigidjax.solve.steppers import stepper_of

State = TypeVar("State", Spin, Attitude, Rigid)
Reduced = TypeVar("Reduced")
# Carried value, time, state of one body → next carried value.
Reduce = Callable[[Any, Array, Any], Any]
# By name, samples of each body (N, steps, *k), held through a step.
Inputs = Any
Solver = AbstractExplicit | Magnus4 | AbstractSplitting | None
# Bytes that reverse mode may keep of all chunks together.
_KEPT = 2**23


@overload
def rollout(
    bodies: Inertia | MassProperties,
    states0: State,
    step_size: ScalarLike,
    num_steps: int,
    torque: Any = None,
    *,
    solver: Solver = None,
    save_every: int | None = None,
    reduce: None = None,
    initial: None = None,
    t0: ScalarLike = 0.0,
    inputs: Inputs = None,
    torque_axes: Any = None,
    chunk: int | None = None,
    devices: Any = None,
) -> State: ...


@overload
def rollout(
    bodies: Inertia | MassProperties,
    states0: State,
    step_size: ScalarLike,
    num_steps: int,
    torque: Any = None,
    *,
    reduce: Reduce,
    initial: Reduced,
    solver: Solver = None,
    save_every: int | None = None,
    t0: ScalarLike = 0.0,
    inputs: Inputs = None,
    torque_axes: Any = None,
    chunk: int | None = None,
    devices: Any = None,
) -> tuple[State, Reduced]: ...


def rollout(
    bodies: Inertia | MassProperties,
    states0: Any,
    step_size: ScalarLike,
    num_steps: int,
    torque: Any = None,
    *,
    solver: Solver = None,
    save_every: int | None = None,
    reduce: Reduce | None = None,
    initial: Any = None,
    t0: ScalarLike = 0.0,
    inputs: Inputs = None,
    torque_axes: Any = None,
    chunk: int | None = None,
    devices: Any = None,
) -> Any:
    """`num_steps` fixed steps of N bodies, each with its own initial state, inertia and torque.

    **Arguments:**

    - `bodies`: one `Inertia` (3, 3) for all, or one per body (N, 3, 3), kg m², body frame;
      `MassProperties` likewise for `Rigid`.
    - `states0`: `Spin`, `Attitude` or `Rigid` whose arrays have a leading axis N, at `t0`.
    - `step_size` s, the same for all; `num_steps` a whole number, a constant of the program.
    - `torque`: `None`, or any torque that `rigidjax.simulate` takes. All bodies share its arrays
      unless `torque_axes` says otherwise: 0 (each array has a leading axis N: make one torque per
      body with `jax.vmap`), a function that picks the arrays with this axis
      (`lambda law: law.speed`, for a `Sum` `lambda law: law.parts[1]`, several in a tuple), or a
      tree of 0 and `None`, one for each.
    - `solver`: `None` takes `Magnus4` for a free attitude, or a torque that does not depend on the
      attitude, and else `rigidjax.solvers.RungeKutta4`. It may be any explicit method of
      `rigidjax.solvers`; the steps agree with those of `diffrax` to round-off. From 10 000 steps
      on they carry what each addition loses, so that round-off grows as √n, not as n.
    - `save_every`: `None` returns the last states only; k the states after k, 2k, … steps.
    - `reduce`, `initial`: a function `(carried, t, state) → carried` of one body, called after
      every `save_every` steps (one, by default), and its first value. States are not kept then.
      A new function for each call compiles again: define it once, best as a Module.
    - `t0` s, the time of the first step.
    - `inputs`: the inputs of the torque, by the names of its `rigidjax.torques.Input`s: arrays (N,
      num_steps, *k) whose row i is held exactly through step i of that body; rows of a
      `rigidjax.torques.Delayed` input come later.
    - `chunk`: the number of bodies computed at a time; `None` fills the first cache, 64 in
      float64, and on a GPU takes all. It changes results in the last digits at most, as do:
    - `devices`: `None` for one, `"all"` of this process, or a sequence of them; N is cut into
      equal shares.

    **Returns** the states, of the type of `states0`, with leading axes (N,) or, with `save_every`,
    (N, num_steps // save_every); with `reduce` the pair (last states, carried). Under a torque with
    states of its own they have `.motion` and `.own`.

    Memory: the inputs, the results, and a chunk, also in reverse mode, which takes five to ten
    times the time of the value. Derivatives are exact for the steps taken, in both modes. A body
    that becomes NaN changes no other. Inside your own `jax.jit` see `compiler_options`.

    **Raises:** `TypeError` if bodies, states, torque and solver do not fit together; `ValueError`
    for shapes that do not agree, an input that is missing or that no torque reads, a step that is
    not positive, a `save_every` that does not divide `num_steps`, and, for known numbers, an
    inertia that no mass has or a moment of zero (a traced one, and a NaN, make that body alone NaN)
    or quaternions that are not unit.

    >>> bodies = rj.Inertia(jnp.diag(jnp.array([1.0, 2.0, 3.0])))
    >>> states = rj.Attitude(jnp.tile(jnp.eye(4)[0], (5, 1)), jnp.tile(jnp.eye(3)[2], (5, 1)))
    >>> rj.batch.rollout(bodies, states, 0.01, 100).q[4, 3]
    Array(0.47942554, dtype=float64)
    """
    batch = bodies_of(bodies, states0, torque, torque_axes)
    h, count = step_of(step_size, num_steps, batch.dtype)
    driven = driven_by(inputs, torque, states0, count, h)
    if reduce is None and initial is not None:
        raise ValueError("rollout: initial is the first value of reduce; no reduce was given")
    if reduce is not None and not callable(reduce):
        raise TypeError(
            f"reduce: wanted a function (carried, t, state) -> carried, got {type(reduce).__name__}"
        )
    every = (1 if reduce is not None else count) if save_every is None else save_every
    if not isinstance(every, int) or every < 1 or count % every:
        raise ValueError(
            f"save_every: wanted a whole part of num_steps = {count}, got {save_every!r}"
        )
    start = jax.tree.map(jnp.asarray, initial)
    begin = _checks.time(t0, "t0").astype(batch.dtype)
    numbers = (batch.shared, (batch.each, driven), start, h, begin)
    steps = solver, count, every, save_every is not None and reduce is None
    among = chunk_of(chunk, batch.dtype, batch.many), mesh_of(devices)
    out = _compiled(steps, among, reduce, batch.rest, numbers)
    batch.require()
    return out


def _run(steps: Any, among: Any, reduce: Reduce | None, rest: Any, numbers: Any) -> Any:
    (solver, count, every, keep), (shared, each, initial, h, t0) = steps, numbers

    def one(given: Any, each: Any) -> Any:
        shared, initial, h, t0 = given
        own, inputs = each
        body, state0, torque = one_of(shared, own, rest)
        state0 = started(body, state0, bind(torque, first_row(torque, h, inputs)), t0)
        field = equations_of_motion(body, state0, torque)
        stepper = stepper_of(solver, field, state0, count)

        def piece(carry: Any, first: Array) -> Any:
            y, carried = carry
            y = march(stepper, h, t0, first, every, y, inputs)
            if reduce is not None:
                t = t0 + (first + every).astype(h.dtype) * h
                carried = reduce(carried, t, stepper.state(y))
            return (y, carried), stepper.state(y) if keep else None

        begin = (stepper.start, initial)
        if every == count:
            (y, carried), kept = piece(begin, jnp.zeros((), jnp.int32))
            kept = jax.tree.map(lambda leaf: leaf[None], kept)
        else:
            firsts = jnp.arange(0, count, every, dtype=jnp.int32)
            (y, carried), kept = lax.scan(piece, begin, firsts)
        if reduce is not None:
            return stepper.state(y), carried
        return kept if keep else stepper.state(y)

    size = sum(leaf.size for leaf in jax.tree.leaves(each[0])) * h.dtype.itemsize
    if size * (count // every) * (every // piece_length(every) + 1) > _KEPT:
        # A reverse pass computes a chunk again: else every chunk's pieces would be kept.
        one = jax.checkpoint(one)
    return over_bodies(one, (shared, initial, h, t0), each, *among)


_compiled = Compiled(_run)
