"""Compute the motion of many bodies: by the closed form, by fixed steps or by adaptive steps."""

from collections.abc import Sequence
from typing import Any, Generic, NamedTuple, TypeVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float, Int, PyTree

from rigidjax import _checks
from rigidjax._names import suggest_arguments
from rigidjax._types import ScalarLike
from rigidjax.batch.rollout import Inputs, rollout
from rigidjax.batch.sharding import (
    CompiledFunction,
    Devices,
    Division,
    divide_batch,
    fit_chunk,
    map_bodies,
    share_of,
)
from rigidjax.batch.validation import (
    BodyBatch,
    TorqueAxes,
    check_batch,
    checked_steps,
    one_body,
)
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.motion import Attitude, Rigid, Spin
from rigidjax.motion.coupled import Coupled, motion_of, with_own_states
from rigidjax.motion.torques.base import Torque
from rigidjax.rotation.barrier import platform
from rigidjax.solve import equations_of_motion, simulate as simulate_one
from rigidjax.solve.answer import validation
from rigidjax.solve.engine.loop import NONFINITE, is_finite, result_of_body
from rigidjax.solve.steps.explicit import DormandPrince8
from rigidjax.solve.steps.magnus import Magnus4

State = TypeVar("State", Spin, Attitude, Rigid)


class Steps(NamedTuple):
    """Describe fixed steps, which `rigidjax.batch.simulate` takes in place of times to save.

    **Fields:**

    - `size`: the length of a step, s.
    - `number`: the number of steps.
    - `save_every`: a number k to save the states after k, 2k, … steps, or `None` to save the last
      states only.
    - `t0`: the time of the initial states, s.

    >>> Steps(0.01, 1000).number
    1000
    """

    size: ScalarLike
    number: int
    save_every: int | None = None
    t0: ScalarLike = 0.0


class Batch(eqx.Module, Generic[State]):
    """Hold the motion of many bodies, as `rigidjax.batch.simulate` returns it.

    **Fields:**

    - `ts` (T,): the times of the states, s.
    - `ys`: the states at these times, of the type of the initial states, with leading axes (N, T),
      in the order of the given bodies; NaN at times that a body did not reach.
    - `result`: a `diffrax.RESULTS` for each body: `successful`, `nonfinite`, `nonfinite_input` (an
      impossible inertia or state), `max_steps_reached` or `dt_min_reached`.
    - `num_steps` (N,): the number of all steps of each body, rejected steps included; 0 for free
      bodies whose motion was computed in closed form, which takes no steps.
    - `own`: a tuple of the states that torques have of their own, such as the speed of a wheel,
      with the leading axes (N, T); `None` if no torque has a state.

    >>> bodies, omega = rj.Inertia(jnp.diag(jnp.array([1.0, 2.0, 3.0]))), jnp.ones((5, 3))
    >>> rj.batch.simulate(bodies, rj.Spin(omega), [0.0, 1.0]).ys.omega.shape
    (5, 2, 3)
    """

    ts: Float[Array, " times"]
    ys: State
    result: dfx.RESULTS
    num_steps: Int[Array, " bodies"]
    own: tuple[Any, ...] | None = None


@suggest_arguments
def simulate(
    bodies: Inertia | MassProperties,
    states0: State,
    ts_or_steps: Steps | Float[ArrayLike, " times"] | Sequence[float],
    torque: Torque | None = None,
    *,
    solver: dfx.AbstractSolver | None = None,
    rtol: float | None = None,
    atol: float | None = None,
    max_steps: int = 100_000,
    adjoint: dfx.AbstractAdjoint | None = None,
    inputs: Inputs = None,
    torque_axes: TorqueAxes = None,
    chunk: int | None = None,
    devices: Devices = None,
    progress_meter: dfx.AbstractProgressMeter | None = None,
) -> Batch[State]:
    """Return the motion of N bodies, each with its own initial state, inertia and torque.

    **Arguments:**

    - `bodies`, `states0`, `torque`, `torque_axes`, `devices`, `progress_meter`, and `inputs` (with
      `Steps` only): as for `rigidjax.batch.rollout`.
    - `ts_or_steps`: times (T,), s, increasing or decreasing, which begin with the time of
      `states0`; or `Steps(size, number)` for fixed steps.
    - `solver`: `None` takes the closed form for free bodies, `rigidjax.solvers.DormandPrince8`
      under a torque, and the choice of `rollout` for `Steps`. With times any
      `diffrax.AbstractSolver` may be given; the explicit methods of `rigidjax.solvers` run in a
      loop of rigidjax, which is faster than the loop of diffrax.
    - `rtol`, `atol`, `max_steps`, `adjoint`: as for `rigidjax.simulate`. On a GPU the memory of a
      gradient grows as the root of `max_steps`.
    - `chunk`: as for `rigidjax.batch.rollout`. But with times to save, a device that is no CPU
      computes by default as many bodies at a time as fit a quarter of its memory with the record of
      their steps; a derivative in reverse mode computes each of several chunks once more.

    All bodies of a chunk wait for the slowest body of this chunk. Each chunk therefore gets bodies
    with similar initial rates, which need similar numbers of steps. The results of a body do not
    depend, to the last bit, on what happens to other bodies.

    **Returns** a `Batch`. A run that fails raises no error: look at `result`.

    **Raises:** as `rollout`; `ValueError` for times that neither increase nor decrease.

    >>> bodies = rj.Inertia(jnp.diag(jnp.array([1.0, 2.0, 3.0])))
    >>> states = rj.Attitude(jnp.tile(jnp.eye(4)[0], (5, 1)), jnp.tile(jnp.eye(3)[2], (5, 1)))
    >>> rj.batch.simulate(bodies, states, [0.0, 1.0]).ys.q.shape
    (5, 2, 4)
    """
    if isinstance(ts_or_steps, Steps):
        size, number, save_every, t0 = ts_or_steps
        every = number if save_every is None else save_every
        options: dict[str, Any] = dict(
            solver=solver, inputs=inputs, torque_axes=torque_axes, chunk=chunk
        )
        options |= dict(save_every=every, t0=t0, devices=devices, progress_meter=progress_meter)
        ys: Any = rollout(bodies, states0, size, number, torque, **options)
        batch = check_batch(bodies, states0, torque, torque_axes)
        h, count = checked_steps(size, number, batch.dtype)
        ts = h * jnp.arange(every, count + 1, every).astype(h.dtype)
        ts = _checks.checked_time(t0, "t0").astype(h.dtype) + ts
        num_steps = jnp.full(batch.num_bodies, count, jnp.int32)
        own = ys.own if isinstance(ys, Coupled) else None
        result = _results(batch._replace(checks=()), ys)
        return Batch(ts, motion_of(ys), result, num_steps, own)
    if inputs is not None:
        raise ValueError(
            "simulate: inputs are for Steps(size, number); with times give the torque "
            "torques.Held(times, values) in place of each input"
        )
    if isinstance(solver, Magnus4):
        raise ValueError("simulate: Magnus4 takes fixed steps; give Steps(size, number), not times")
    batch = check_batch(bodies, states0, torque, torque_axes)
    ts = validation.checked_times(ts_or_steps, True).astype(batch.dtype)
    if torque is not None or solver is not None:
        max_steps = _checks.integer(max_steps, "max_steps", 1)
        rtol, atol = validation.checked_tolerances(rtol, atol, batch.dtype)
        solver = DormandPrince8() if solver is None else solver
    options = dict(solver=solver, rtol=rtol, atol=atol, max_steps=max_steps, adjoint=adjoint)
    division = divide_batch(chunk, devices, progress_meter, batch.dtype, batch.num_bodies)
    numbers = (batch.shared, batch.per_body, ts)
    out = Batch(ts, *_compiled(options, division, batch.constants, numbers))
    batch.require_valid_numbers()
    return out


class Runs(NamedTuple):
    """Hold the runs of many bodies, with the fields of a `Batch`."""

    ys: PyTree
    result: dfx.RESULTS
    num_steps: Array
    own: tuple[Any, ...] | None


def _simulate(
    options: dict[str, Any],
    division: Division,
    constants: PyTree,
    numbers: tuple[PyTree, PyTree, Array],
) -> Runs:
    """Simulate many bodies, each by `rigidjax.simulate` with these `options`; the `numbers` are the
    arrays that all bodies share, those with a row for each body, and the times to save.
    """
    shared, per_body, ts = numbers

    def simulate_body(shared_numbers: PyTree, row: PyTree) -> Runs:
        shared, ts = shared_numbers
        body, state0, torque = one_body(shared, row, constants)
        sol = simulate_one(body, state0, ts, torque, throw=False, **options)
        return Runs(sol.ys, sol.result, jnp.asarray(sol.stats["num_steps"], jnp.int32), sol.own)

    if options["solver"] is None:
        return map_bodies(simulate_body, (shared, ts), per_body, division)
    if options["adjoint"] is None:
        division = fit_chunk(division, simulate_body, (shared, ts), per_body)
    if platform() != "cpu" and division.chunk < share_of(division, per_body):
        # On a GPU the record of a body is large, because bodies are computed many at a time. With
        # `jax.checkpoint` the reverse pass computes each chunk once more, and keeps the record of
        # one chunk at a time.
        simulate_body = jax.checkpoint(simulate_body)

    def initial_speed(row: PyTree) -> Array:
        # The bodies are sorted by |Ω| + √|dΩ/dt| at the first time, in rad/s, where Ω is the body
        # rate: the larger this number is, the more steps a body needs.
        body, state0, torque = one_body(shared, row, constants)
        y0 = with_own_states(body, state0, torque, ts[0])
        slope = motion_of(equations_of_motion(body, y0, torque)(ts[0], y0, None))
        rate, change = jnp.sum(state0.omega**2), jnp.sum(slope.omega**2)
        return lax.stop_gradient(jnp.sqrt(rate) + jnp.sqrt(jnp.sqrt(change)))

    parts = 1 if division.mesh is None else division.mesh.devices.size
    order, inverse = sorted_for_chunks(jax.vmap(initial_speed)(per_body), division.chunk, parts)
    rows = jax.tree.map(lambda a: a[order], per_body)
    out = map_bodies(simulate_body, (shared, ts), rows, division)
    return jax.tree.map(lambda a: a[inverse], out)


_compiled = CompiledFunction(_simulate)


@eqx.filter_jit
def _results(batch: BodyBatch, ys: PyTree) -> dfx.RESULTS:
    """Return how the run of each body under fixed steps ended: `nonfinite_input` for an impossible
    inertia, else `nonfinite` if a saved state is not finite, else `successful`.
    """

    def status(row: PyTree, ys: PyTree) -> dfx.RESULTS:
        result = dfx.RESULTS.where(is_finite(ys), dfx.RESULTS.successful, NONFINITE)
        return result_of_body(result, one_body(batch.shared, row, batch.constants)[0])

    return jax.vmap(status)(batch.per_body, ys)


# XLA on CPU computes loops over bodies in groups of 16 numbers in float64, or 32 in float32; the
# bodies of an incomplete last group are rounded differently. `_UNROLLED` is the size of the larger
# group.
_UNROLLED = 32


def sorted_for_chunks(key: Array, chunk: int, num_devices: int) -> tuple[Array, Array]:
    """Return an order of the bodies in which those of a chunk need similar numbers of steps, by
    `key` (N,), such as a speed, and its inverse; its element i is the old index at the new place i.

    All bodies of a chunk wait for the slowest, and consecutive chunks go to the devices in turn.
    XLA computes the bodies of a chunk in groups, so that the rounding of a body's results depends
    on its place within the chunk. Each body therefore keeps its place within a chunk, whatever the
    keys of other bodies are, and only its chunk is chosen by its key. If `chunk` is a multiple of
    32, the size of a group, only the place within the group is kept.
    """
    count = key.shape[0]
    chunk = min(chunk, -(-count // num_devices))
    size = -(-count // (chunk * num_devices)) * chunk
    # The sorted bodies fill the positions in the array for the devices in turn: first chunk 0 of
    # every device, then chunk 1 of every device, and so on. `seats[i]` is the rank of the body at
    # position i. Each device has `size` positions; the last device may have fewer.
    seats = (
        np.arange(size * num_devices).reshape(-1, num_devices, chunk).transpose(1, 0, 2).reshape(-1)
    )
    seats = seats[seats < count]
    place = np.arange(count) % chunk
    place = place % _UNROLLED if chunk % _UNROLLED == 0 else place
    # `place` is, for each body and for each position, the place within a chunk (or within a group
    # of `_UNROLLED` bodies). The bodies with one value of `place` are sorted by key, and fill the
    # positions with this value in the order of `seats`.
    bodies = jnp.lexsort((key, jnp.asarray(place, jnp.int32)))
    order = jnp.zeros_like(bodies).at[np.lexsort((seats, place))].set(bodies)
    return order, jnp.zeros_like(order).at[order].set(jnp.arange(count, dtype=order.dtype))
