"""The motion of many bodies: closed form, fixed steps, or adaptive steps."""

from collections.abc import Sequence
from typing import Any, Generic, NamedTuple, TypeVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float, Int

from rigidjax import _checks
from rigidjax._types import ScalarLike
from rigidjax.batch.rollout import Inputs, rollout
from rigidjax.batch.sharding import Compiled, chunk_of, mesh_of, over_bodies
from rigidjax.batch.validation import BodyBatch, bodies_of, one_of, step_of
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.motion import Attitude, Rigid, Spin
from rigidjax.motion.coupled import Coupled, motion_of, started
from rigidjax.solve import equations_of_motion, simulate as simulate_one, validation
from rigidjax.solve.adaptive_loop import NONFINITE, finite, of_body
from rigidjax.solve.explicit import DormandPrince8
from rigidjax.solve.magnus import Magnus4

State = TypeVar("State", Spin, Attitude, Rigid)


class Steps(NamedTuple):
    """Fixed steps, instead of times.

    **Fields:** `size` s; `number` of steps; `save_every` k saves each k-th state, `None` the last;
    `t0` s.

    >>> Steps(0.01, 1000).number
    1000
    """

    size: ScalarLike
    number: int
    save_every: int | None = None
    t0: ScalarLike = 0.0


class Batch(eqx.Module, Generic[State]):
    """The result of `simulate`.

    **Fields:** `ts` (T,) s; `ys` the states there, of the type of `states0`, with leading axes (N,
    T), in the order of the given bodies; NaN at times that a body did not reach. `result` a
    `diffrax.RESULTS` for each body: `successful`, `nonfinite`, `nonfinite_input` (no body has these
    numbers), `max_steps_reached`, `dt_min_reached`. `num_steps` (N,) accepted and rejected, 0 for
    the closed form. `own` a tuple of the torques' own states, as `ys`, or `None`.

    >>> bodies, omega = rj.Inertia(jnp.diag(jnp.array([1.0, 2.0, 3.0]))), jnp.ones((5, 3))
    >>> rj.batch.simulate(bodies, rj.Spin(omega), [0.0, 1.0]).ys.omega.shape
    (5, 2, 3)
    """

    ts: Float[Array, " times"]
    ys: State
    result: dfx.RESULTS
    num_steps: Int[Array, " bodies"]
    own: Any = None


def simulate(
    bodies: Inertia | MassProperties,
    states0: State,
    ts_or_steps: Steps | Float[ArrayLike, " times"] | Sequence[float],
    torque: Any = None,
    *,
    solver: dfx.AbstractSolver | None = None,
    rtol: float | None = None,
    atol: float | None = None,
    max_steps: int = 100_000,
    adjoint: dfx.AbstractAdjoint | None = None,
    inputs: Inputs = None,
    torque_axes: Any = None,
    chunk: int | None = None,
    devices: Any = None,
) -> Batch[State]:
    """The motion of N bodies, each with its own initial state, inertia and torque.

    **Arguments:**

    - `bodies`, `states0`, `torque`, `torque_axes`, `chunk`, `devices`, and for `Steps` `inputs`: as
      for `rigidjax.batch.rollout`.
    - `ts_or_steps`: (T,) increasing or decreasing times, s, the first is the start; or
      `Steps(size, number)` for fixed steps.
    - `solver`: `None` takes the closed form for free bodies, `rigidjax.solvers.DormandPrince8`
      under a torque, and the choice of `rollout` for `Steps`. With times any
      `diffrax.AbstractSolver` may be given; the explicit ones of `rigidjax.solvers` run in our own
      loop.
    - `rtol`, `atol`, `max_steps`, `adjoint`: as for `rigidjax.simulate`.

    Bodies are computed in the order of their initial rates: those of one chunk wait for the last.
    The other bodies get the same bits whatever happens to one.

    **Returns** a `Batch`. Nothing is raised for what happens during a run: look at `result`.

    **Raises:** as `rollout`; `ValueError` for times that neither increase nor decrease.

    >>> bodies = rj.Inertia(jnp.diag(jnp.array([1.0, 2.0, 3.0])))
    >>> states = rj.Attitude(jnp.tile(jnp.eye(4)[0], (5, 1)), jnp.tile(jnp.eye(3)[2], (5, 1)))
    >>> rj.batch.simulate(bodies, states, [0.0, 1.0]).ys.q.shape
    (5, 2, 4)
    """
    if isinstance(ts_or_steps, Steps):
        size, number, save_every, t0 = ts_or_steps
        every = number if save_every is None else save_every
        how = dict(solver=solver, inputs=inputs, torque_axes=torque_axes, chunk=chunk)
        how |= dict(save_every=every, t0=t0, devices=devices)
        ys: Any = rollout(bodies, states0, size, number, torque, **how)
        batch = bodies_of(bodies, states0, torque, torque_axes)
        h, count = step_of(size, number, batch.dtype)
        ts = h * jnp.arange(every, count + 1, every).astype(h.dtype)
        ts = _checks.time(t0, "t0").astype(h.dtype) + ts
        taken = jnp.full(batch.many, count, jnp.int32)
        own = ys.own if isinstance(ys, Coupled) else None
        return Batch(ts, motion_of(ys), _statuses(batch._replace(looks=()), ys), taken, own)
    if inputs is not None:
        raise ValueError(
            "simulate: inputs are for Steps(size, number); with times put torques.Held(times, "
            "values) in the law"
        )
    if isinstance(solver, Magnus4):
        raise ValueError("simulate: Magnus4 takes fixed steps; give Steps(size, number), not times")
    batch = bodies_of(bodies, states0, torque, torque_axes)
    ts = validation.times(ts_or_steps, True).astype(batch.dtype)
    if torque is not None or solver is not None:
        max_steps = _checks.whole(max_steps, "max_steps", 1)
        rtol, atol = validation.tolerances(rtol, atol, batch.dtype)
        solver = DormandPrince8() if solver is None else solver
    how = dict(solver=solver, rtol=rtol, atol=atol, max_steps=max_steps, adjoint=adjoint)
    among = chunk_of(chunk, batch.dtype, batch.many), mesh_of(devices)
    numbers = (batch.shared, batch.each, ts)
    out = Batch(ts, *_compiled(how, among, batch.rest, numbers))
    batch.require()
    return out


def _run(how: dict[str, Any], among: Any, rest: Any, numbers: Any) -> Any:
    (shared, each, ts), (chunk, mesh) = numbers, among

    def one(given: Any, each: Any) -> Any:
        shared, ts = given
        body, state0, torque = one_of(shared, each, rest)
        found = simulate_one(body, state0, ts, torque, throw=False, **how)
        return found.ys, found.result, jnp.asarray(found.stats["num_steps"], jnp.int32), found.own

    if how["solver"] is None:
        return over_bodies(one, (shared, ts), each, chunk, mesh)

    def quick(each: Any) -> Array:
        # |Ω| + √|dΩ/dt| at the start, rad/s: the number of steps grows with it.
        body, state0, torque = one_of(shared, each, rest)
        y0 = started(body, state0, torque, ts[0])
        slope = motion_of(equations_of_motion(body, y0, torque)(ts[0], y0, None))
        rate, change = jnp.sum(state0.omega**2), jnp.sum(slope.omega**2)
        return lax.stop_gradient(jnp.sqrt(rate) + jnp.sqrt(jnp.sqrt(change)))

    order, back = dealt(jax.vmap(quick)(each), chunk, 1 if mesh is None else mesh.devices.size)
    each = jax.tree.map(lambda a: a[order], each)
    out = over_bodies(one, (shared, ts), each, chunk, mesh)
    return jax.tree.map(lambda a: a[back], out)


_compiled = Compiled(_run)


@eqx.filter_jit
def _statuses(batch: BodyBatch, ys: Any) -> dfx.RESULTS:
    def one(each: Any, ys: Any) -> dfx.RESULTS:
        result = dfx.RESULTS.where(finite(ys), dfx.RESULTS.successful, NONFINITE)
        return of_body(result, one_of(batch.shared, each, batch.rest)[0])

    return jax.vmap(one)(batch.each, ys)


# XLA on CPU unrolls loops over bodies to 16 doubles or 32 floats, and rounds the last otherwise.
_UNROLLED = 32


def dealt(key: Array, chunk: int, parts: int) -> tuple[Array, Array]:
    """An order by `key` (N,), NaN last, in which devices get chunks in turn, and the way back.

    Each body keeps its place among those that are computed together, whatever the keys of others.
    """
    count = key.shape[0]
    chunk = min(chunk, -(-count // parts))
    size = -(-count // (chunk * parts)) * chunk
    # The place of each device's share of `size` in the order; the last may be short.
    seats = np.arange(size * parts).reshape(-1, parts, chunk).transpose(1, 0, 2).reshape(-1)
    seats = seats[seats < count]
    place = np.arange(count) % chunk
    place = place % _UNROLLED if chunk % _UNROLLED == 0 else place
    # One order for each place: the bodies of that place by their keys, in its seats.
    bodies = jnp.lexsort((key, jnp.asarray(place, jnp.int32)))
    order = jnp.zeros_like(bodies).at[np.lexsort((seats, place))].set(bodies)
    return order, jnp.zeros_like(order).at[order].set(jnp.arange(count, dtype=order.dtype))
