"""The iterated smoother: the most probable motion, given all readings."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from rigidjax import _checks
from rigidjax._types import Scalar
from rigidjax.estimate import linear, roots
from rigidjax.estimate.belief import Belief
from rigidjax.estimate.filter import WORDS, Task, looked_at, scan_filter, status_of, told
from rigidjax.estimate.scene import (
    Dynamics,
    Extended,
    Model,
    Read,
    Sensors,
    Stops,
    absorb_all,
    reset,
    reset_inverse,
)
from rigidjax.identify.recording import Recording
from rigidjax.motion.manifold import minus, plus


class Push(NamedTuple):
    """The estimate of a white torque, averaged over the step that ends at each time.

    **Fields:** `mean`, `deviation` (N, 3) N m, body frame; the deviation is large for short steps,
    since white noise has no value at a time.

    >>> shown = Push(jnp.array([[0.0, 0.0, 0.3]]), 0.1 * jnp.ones((1, 3)))
    >>> (shown.mean / shown.deviation).round(1).tolist()  # about the third axis it turns the body
    [[0.0, 0.0, 3.0]]
    """

    mean: Float[Array, "stops 3"]
    deviation: Float[Array, "stops 3"]


class Smoothed(eqx.Module):
    """The result of `smooth`.

    **Fields:** `belief` a `Belief` at each stop: the times of the recording and, where these are
    far apart, some between; `rows` (T,) which of them are of the recording; `pushes` a `Push` for
    each `RandomTorque` (a `CorrelatedTorque` is in `belief.torques`); `readings` a `Read` for each
    sensor, of the last linearisation, (N, k); `log_likelihood` of all readings, by Laplace's method
    about this motion; `change` how far the last iteration moved it, in standard deviations at most;
    `iterations`; `status`, `lost_at` as of `Filtered`.

    >>> import rigidjax as rj
    >>> record = rj.identify.Recording([0.0, 0.1], (rj.identify.Gyro(0.1), [[1.0, 0, 0]] * 2))
    >>> body = rj.Inertia.from_principal(1.0, 2.0, 2.5)
    >>> model = rj.estimate.Model(body, rj.torques.RandomTorque(1.0))
    >>> found = rj.estimate.smooth(model, record, rj.estimate.start(model, record, rate=1.0))
    >>> found.words, found.rows.tolist()  # of three stops the first and last are readings
    ('followed', [0, 2])
    """

    belief: Belief
    rows: Int[Array, " times"]
    pushes: tuple[Push, ...]
    readings: tuple[Read, ...]
    log_likelihood: Scalar
    change: Scalar
    iterations: Int[Array, ""]
    status: Int[Array, ""]
    lost_at: Scalar

    @property
    def words(self) -> str:
        """The status in words."""
        return WORDS[int(self.status)]

    @property
    def t(self) -> Float[Array, " stops"]:
        """The times of all stops, s."""
        return self.belief.t

    @property
    def states(self) -> Any:
        """The most probable states at the times of the recording, with a leading time axis."""
        return jax.tree.map(lambda leaf: leaf[self.rows], self.belief.state)


def smooth(
    model: Model,
    recording: Recording,
    first: Belief,
    *,
    iterations: int = 10,
    tolerance: float = 1e-2,
    substeps: int | None = None,
    throw: bool = True,
) -> Smoothed:
    """Attitude, rate, unknown torque and sensor errors from all readings, with their deviations.

    The motion of largest posterior density, by Gauss and Newton's method: each iteration linearises
    dynamics and sensors about the last motion, at first that of `filter`, and solves the linear
    problem exactly by a Kalman filter and the pass of Rauch, Tung and Striebel (Bell 1994,
    doi:10.1137/0804035).

    **Arguments:** as for `filter`; `iterations` at most; it ends when no number moved by more than
    `tolerance` of its standard deviation (the error that remains is about the square of that).
    **Returns** `belief`, `rows`, `pushes`, `readings`, `log_likelihood`, `change`, `iterations`,
    `status` and `lost_at` (`Smoothed`). It may be jitted, differentiated in forward mode, and
    batched. **Raises:** as `filter`; with `throw` also for a motion that still moves by a standard
    deviation.

    >>> import rigidjax as rj
    >>> record = rj.identify.Recording([0.0, 0.1], (rj.identify.Gyro(0.1), [[1.0, 0, 0]] * 2))
    >>> body = rj.Inertia.from_principal(1.0, 2.0, 2.5)
    >>> model = rj.estimate.Model(body, rj.torques.RandomTorque(1.0))
    >>> found = rj.estimate.smooth(model, record, rj.estimate.start(model, record, rate=1.0))
    >>> found.states.omega.shape, found.pushes[0].mean.shape  # one stop between
    ((2, 3), (3, 3))
    """
    _checks.whole(iterations, "iterations", 1)
    _checks.positive(tolerance, "tolerance")
    task = looked_at(model, recording, first, substeps)
    out = _smooth(task, iterations, tolerance)
    if not throw:
        return out
    words = (
        "smooth: the motion still moves by a standard deviation after the last iteration; give "
        "more iterations, a better initial state, or a model that the readings fit; throw=False "
        "returns it"
    )
    return _checks.refuse(told(out), out.change > 1, words)


class _Kept(NamedTuple):
    joint: linear.Joint
    before: Array
    mean: Array
    noise: Array
    read: tuple[Read, ...]


class _Solved(NamedTuple):
    root: Array
    read: tuple[Read, ...]
    total: Array
    kicks: Array
    kick_covariance: Array
    change: Array


@eqx.filter_jit
def _smooth(task: Task, iterations: int, tolerance: float) -> Smoothed:
    first = task.first
    stops, (_, kept) = scan_filter(task, lambda belief, read: (belief, read))
    here = jnp.arange(stops.t.shape[0]) if task.grid is None else task.grid.rows
    beliefs, reads = jax.tree.map(lambda leaf: leaf[here], kept)
    status, lost_at = status_of(beliefs, reads, first.t)
    path = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first.x, kept[0].x)
    dynamics = Dynamics(task.model, first.x, task.sensors.densities)

    def once(path: Extended, kicks: Array) -> tuple[Extended, Any]:
        return _iterate(dynamics, task.sensors, first, stops, path, kicks)

    def more(state: tuple) -> Array:
        return (state[2] < iterations) & (state[1].change > tolerance)

    def again(state: tuple) -> tuple:
        path, out = once(state[0], state[1].kicks[:, : dynamics.kicks])
        return path, out, state[2] + 1

    still = jnp.zeros((stops.t.shape[0], dynamics.kicks), first.root.dtype)
    # Nothing is solved yet: one copy of an iteration is compiled, not two.
    blank = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(once, path, still)[1]
    )
    blank = blank._replace(change=jnp.full_like(blank.change, jnp.inf))
    path, out, count = lax.while_loop(more, again, (path, blank, jnp.asarray(0)))
    x = jax.tree.map(lambda leaf: leaf[1:], path)
    h = jnp.diff(jnp.concatenate([first.t[None], stops.t])).astype(first.root.dtype)
    pushes = []
    for index, root in enumerate(dynamics.white):
        mine = slice(6 * index, 6 * index + 3)
        size = roots.inverse_root(h)[:, None] * root[None]
        variance = jnp.diagonal(out.kick_covariance, axis1=1, axis2=2)[:, mine]
        pushes.append(Push(size * out.kicks[:, mine], size * jnp.sqrt(variance)))
    return Smoothed(
        Belief(stops.t, x, out.root[1:]),
        here,
        tuple(pushes),
        out.read,
        out.total,
        out.change,
        count,
        jnp.where(jnp.isfinite(out.change), status, 2),
        lost_at,
    )


def _iterate(
    dynamics: Dynamics, sensors: Sensors, first: Belief, stops: Stops, path: Extended, kicks: Array
) -> tuple[Extended, _Solved]:
    """One linearisation about `path` and the `kicks` between its times, and its exact solution."""
    before = jnp.concatenate([first.t[None], stops.t[:-1]])
    dtype = first.root.dtype
    x0 = jax.tree.map(lambda leaf: leaf[0], path)
    off = minus(x0, first.x)
    start = (-off, reset(x0, off, first.root))

    def forward(carry: tuple[Array, Array], now: Any) -> tuple[Any, _Kept]:
        mean, root = carry
        t0, stop, x, y, kick = now
        since = (stop.t - t0).astype(dtype)
        after, grown, noise = dynamics.predict(t0.astype(dtype), since, x, kick)
        push = minus(after, y)
        grown, noise = reset_inverse(y, push, grown), reset_inverse(y, push, noise)
        push = push - jnp.sum(noise[:, : dynamics.kicks] * kick[None], 1)
        kept = linear.joint(grown, noise, root)
        predicted = jnp.sum(grown * mean[None], 1) + push
        later, root, read = absorb_all(dynamics, sensors, stop, y, predicted, kept.predicted)
        return (later, root), _Kept(kept, predicted, mean, noise, read)

    earlier = jax.tree.map(lambda leaf: leaf[:-1], path)
    later = jax.tree.map(lambda leaf: leaf[1:], path)
    end, kept = lax.scan(forward, start, (before, stops, earlier, later, kicks))

    means, spread, kicks, kick_covariance = linear.smoothed(
        kept.joint, kept.mean, kept.before, kept.noise, end
    )
    change = jnp.max(jnp.abs(means) * roots.inverse_root(jnp.sum(spread**2, -1)))
    total = jnp.sum(jnp.stack([read.log_density for read in kept.read]))
    moved = jax.vmap(plus)(path, means)
    return moved, _Solved(spread, kept.read, total, kicks, kick_covariance, change)
