"""Find the most probable motion, given all readings, by an iterated smoother."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from rigidjax import _checks
from rigidjax._types import Scalar
from rigidjax.identify.filtering import roots, steps
from rigidjax.identify.filtering.filter import (
    WORDS,
    Belief,
    FilterInput,
    checked_input,
    outcome,
    require_followed,
    scan_filter,
)
from rigidjax.identify.filtering.linear import LinearEstimate, Moves, linear_smooth
from rigidjax.identify.filtering.steps import Dynamics, ExtendedState, ReadNumbers, Stops
from rigidjax.identify.model.model import Model
from rigidjax.motion import Attitude, Rigid, Spin
from rigidjax.motion.manifold import dimension, minus, plus
from rigidjax.motion.torques import CorrelatedTorque, RandomTorque
from rigidjax.motion.torques.composite import parts_of


class Push(NamedTuple):
    """Hold the estimate of an unknown torque in each of the N steps of a smoother.

    **Fields:** `mean` (N, 3) is the mean and `deviation` (N, 3) the standard deviation of the
    torque, in newton metres, body frame. A `CorrelatedTorque` is taken at the end of each step. A
    `RandomTorque` is averaged over each step: white noise has no value at one time, and the shorter
    a step, the larger the variance of its average.
    """

    mean: Float[Array, "stops 3"]
    deviation: Float[Array, "stops 3"]


class Smoothed(eqx.Module):
    """Hold the result of `smooth`.

    **Fields:**

    - `belief`: a `Belief` at each of N stops. The stops are the T times of the recording and, if
      the intervals between these times are long, some times between them.
    - `rows`: (T,) for each time of the recording, its index among the stops.
    - `pushes`: a `Push` for each unknown torque, in the order of the model's `process`.
    - `readings`: for each sensor a `ReadNumbers` with arrays (N, k) for the k components of a
      reading: the innovations (reading minus prediction) of the last iteration, their variances,
      and a mask, true for a component that was read.
    - `log_likelihood`: the logarithm of the density of all readings, by Laplace's method about the
      most probable motion.
    - `change`: the largest change of a component of a state in the last iteration, in standard
      deviations of this component.
    - `iterations`: the number of iterations.
    - `status`: 0 if `filter`, with whose motion the iteration starts, followed the readings; 1 if
      `filter` was lost; 2 if an estimate of the filter or the smoother is not finite.
    - `lost_at`: the time, s, at which `filter` was lost; NaN if it was not lost.
    """

    belief: Belief
    rows: Int[Array, " times"]
    pushes: tuple[Push, ...]
    readings: tuple[ReadNumbers, ...]
    log_likelihood: Scalar
    change: Scalar
    iterations: Int[Array, ""]
    status: Int[Array, ""]
    lost_at: Scalar

    @property
    def words(self) -> str:
        """Return the `status` of this result in words: the filter followed the readings, was lost,
        or stopped because an estimate is NaN or infinite.
        """
        return WORDS[int(self.status)]

    @property
    def t(self) -> Float[Array, " stops"]:
        """Return the times, s, of all N stops: the times of the recording and the times between
        them at which steps end.
        """
        return self.belief.t

    @property
    def states(self) -> Spin | Attitude | Rigid:
        """Return the most probable motion at the times of the recording, as one `Spin`, `Attitude`
        or `Rigid` with a leading time axis.
        """
        return jax.tree.map(lambda leaf: leaf[self.rows], self.belief.state)


def smooth(
    model: Model,
    belief: Belief,
    x: Float[Array, " n"] | None = None,
    *,
    iterations: int = 10,
    tolerance: float = 1e-2,
    substeps: int | None = None,
    throw: bool = True,
) -> Smoothed:
    """Return attitude, rate, unknown torque and sensor errors from all readings.

    The result is the motion of largest posterior density, which the Gauss–Newton method finds. The
    first iteration linearises the equations of motion and the sensors about the motion that
    `filter` returns, each further iteration about the result of the iteration before it. An
    iteration solves the linear problem exactly by a Kalman filter and the backward pass of Rauch,
    Tung and Striebel (Bell 1994, doi:10.1137/0804035).

    **Arguments:** `model`, `belief`, `x`, `substeps` and `throw` of `filter`, and

    - `iterations`: the largest number of iterations.
    - `tolerance`: the iteration ends when no component of a state changes by more than `tolerance`
      times its standard deviation. The error that remains is about `tolerance`² standard
      deviations.

    **Returns** `belief`, `rows`, `pushes`, `readings`, `log_likelihood`, `change`, `iterations`,
    `status` and `lost_at` (`Smoothed`). It may be jitted, differentiated in forward mode, and
    batched. **Raises:** the errors of `filter`; with `throw` also an error if the last iteration
    changed a component of a state by more than its standard deviation.

    >>> record = rj.identify.Recording([0.0, 0.1], (rj.identify.Gyro(0.1), [[1.0, 0, 0]] * 2))
    >>> body = rj.identify.Known(rj.Inertia.from_principal(1.0, 2.0, 2.5))
    >>> model = rj.identify.Model(record, body, process=rj.torques.RandomTorque(1.0))
    >>> best = rj.identify.smooth(model, rj.identify.first_belief(model, rate=1.0))
    >>> best.pushes[0].mean.shape, best.rows.tolist()  # of three stops two are readings
    ((3, 3), [0, 2])
    """
    _checks.integer(iterations, "iterations", 1)
    _checks.positive_float(tolerance, "tolerance")
    run = _smooth(checked_input(model, belief, x, substeps), iterations, tolerance)
    if not throw:
        return run
    words = (
        "smooth: the motion still moves by a standard deviation after the last iteration; give "
        "more iterations, a better initial state, or a model that the readings fit; throw=False "
        "returns it"
    )
    return _checks.error_if(require_followed(run), run.change > 1, words)


@eqx.filter_jit
def _smooth(run: FilterInput, iterations: int, tolerance: float) -> Smoothed:
    sensors, first, grid = run.scene.sensors, run.first, run.grid
    dynamics, stops, kept = scan_filter(run, lambda belief, read: (belief, read))
    beliefs, read = grid.at_recording(kept)
    status, lost_at = outcome(beliefs, steps.split_by_sensor(sensors, read), first.t)
    path = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first.x, kept[0].x)

    def iterate(state: tuple) -> tuple:
        path, estimate, _, count = state
        kicks = estimate.kicks[:, : dynamics.normals_per_step]
        return *_iteration(dynamics, first, stops, path, kicks), count + 1

    still = jnp.zeros((stops.t.shape[0], dynamics.normals_per_step), first.root.dtype)
    # Start the loop from an estimate of zeros: a first iteration before the loop would compile the
    # iteration a second time.
    blank = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, leaf.dtype),
        jax.eval_shape(lambda: _iteration(dynamics, first, stops, path, still).estimate),
    )
    far = jnp.asarray(jnp.inf, first.root.dtype)
    path, estimate, change, count = lax.while_loop(
        lambda state: (state[3] < iterations) & (state[2] > tolerance),
        iterate,
        (path, blank, far, jnp.asarray(0)),
    )
    h = jnp.diff(stops.t, prepend=first.t).astype(first.root.dtype)
    white = []
    for index, root in enumerate(dynamics.white):
        mine = slice(6 * index, 6 * index + 3)
        size = roots.inverse_sqrt(h)[:, None] * root[None]
        variance = jnp.diagonal(estimate.kick_covariance, axis1=1, axis2=2)[:, mine]
        white.append(Push(size * estimate.kicks[:, mine], size * jnp.sqrt(variance)))
    belief = Belief(stops.t, jax.tree.map(lambda leaf: leaf[1:], path), estimate.root[1:])
    # The rows of the correlated torques come after those of the motion.
    first_row = dimension(first.x.motion)
    rows = (first_row + 3 * index + np.arange(3) for index in range(len(belief.torques)))
    coloured = [
        Push(mean, belief.deviation[:, row]) for mean, row in zip(belief.torques, rows, strict=True)
    ]
    kinds = {RandomTorque: iter(white), CorrelatedTorque: iter(coloured)}
    pushes = [next(kinds[type(part)]) for part in parts_of(run.scene.process)]
    last_read = ReadNumbers(estimate.innovation[1:], estimate.variance[1:], kept[1].mask)
    reads = steps.split_by_sensor(sensors, last_read)
    status = jnp.where(jnp.isfinite(change), status, 2)
    total = estimate.log_likelihood
    return Smoothed(belief, grid.rows, tuple(pushes), reads, total, change, count, status, lost_at)


class _Iteration(NamedTuple):
    path: ExtendedState  # N + 1 states: before the first reading, and at each stop
    estimate: LinearEstimate  # of the changes of the states
    change: Scalar  # the largest one of a component of a state, in standard deviations


def _iteration(
    dynamics: Dynamics,
    belief: Belief,
    stops: Stops,
    path: ExtendedState,
    kicks: Float[Array, "stops normals"],
) -> _Iteration:
    """Return the most probable motion of the problem that is linearised about the N + 1 states of
    `path` and about the noise of `kicks`: one Gauss–Newton iteration.
    """
    dtype = belief.root.dtype

    def linearise(
        row: tuple[Array, Stops, ExtendedState, ExtendedState, Array],
    ) -> tuple[Moves, steps.LinearReadings]:
        """Return a step from the state x of the path to y, and the readings at y, linearised.

        An error e of x becomes `F e + d + G u` at y, with the unit normal noise u; F, G and d are
        returned.
        """
        t0, stop, x, y, kick = row
        after, grown, noise = dynamics.predict(
            t0.astype(dtype), (stop.t - t0).astype(dtype), x, kick
        )
        off = minus(after, y)
        grown, noise = (steps.recentred_root(y, off, part, inverse=True) for part in (grown, noise))
        push = off - jnp.sum(noise[:, : dynamics.normals_per_step] * kick[None], 1)
        return Moves(grown, noise, push), steps.linearise_readings(dynamics, stop, y)

    before = jnp.concatenate([belief.t[None], stops.t[:-1]])
    x0, earlier, later = (
        jax.tree.map(lambda leaf, at=at: leaf[at], path) for at in (0, slice(-1), slice(1, None))
    )
    moves, rows = lax.map(linearise, (before, stops, earlier, later, kicks))
    # The first row belongs to the time of the belief before the first reading; nothing is read at
    # this time.
    rows = jax.tree.map(lambda a: jnp.pad(a, [(1, 0)] + [(0, 0)] * (a.ndim - 1)), rows)
    off = minus(x0, belief.x)
    out = linear_smooth(moves, rows, -off, steps.recentred_root(x0, off, belief.root))
    change = jnp.max(jnp.abs(out.mean) * roots.inverse_sqrt(jnp.sum(out.root**2, -1)))
    return _Iteration(jax.vmap(plus)(path, out.mean), out, change)
