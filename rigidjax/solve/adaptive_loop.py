"""Steps as long as the tolerances allow, for one body or many, with the states at any times.

The steps do not look at the times that are asked for. A state between two steps is one more step,
a shorter one, from the step's start: of the method's own order, on the group, with an error less
than that of the step it lies in. All of them are computed side by side.

For derivatives the steps are recorded in segments: the start of each is kept, and the steps of the
last one; the others are run once more when they are needed.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax.solve import runge_kutta
from rigidjax.solve.components import lift
from rigidjax.solve.runge_kutta import Field, Step
from rigidjax.solve.tableaus import Tableau

# What diffrax.PIDController does unless told: the same steps, so that figures can be compared.
_SAFETY, _SMALLEST, _LARGEST = 0.9, 0.2, 10.0
# Steps in a segment, rejected ones included.
SEGMENT = 512
# The same where only states are asked for: less memory to touch.
_SHORT = 256
# XLA on CPU makes one kernel of a loop whose state is smaller than a kilobyte: steps are written
# into a block that small, and blocks into the record.
_BLOCK = 560
# Saved states that are computed side by side.
MANY = 32


class Method(NamedTuple):
    """What a run is made of, beside its numbers.

    **Fields:** `tableau`; `field` and `project`, on (n, *bodies); `sizes` how many numbers each
    array of the state has; `max_steps`.
    """

    tableau: Tableau
    field: Field
    project: Callable[[Array], Array]
    sizes: list[int]
    max_steps: int


class Run(NamedTuple):
    """The numbers of a run, a last axis of bodies in each.

    **Fields:** `t0`; `stops` (J,) where the torque jumps, and the last time; `between` (K,) times
    asked for; `y0` (n,); `rtol`, `atol`; `h0` the first step, NaN to choose one.
    """

    t0: Array
    stops: Array
    between: Array
    y0: Array
    rtol: Array
    atol: Array
    h0: Array

    @property
    def before(self) -> Array:
        """The last moment before each stop (J,): a stage there sees the torque before the jump."""
        jumps = lax.stop_gradient(self.stops[:-1])
        gap = jnp.nextafter(jumps, jnp.full_like(jumps, -jnp.inf)) - jumps
        return jnp.concatenate([self.stops[:-1] + gap, self.stops[-1:]])


class Walk(NamedTuple):
    """Where the loop is: time, next step, state, index of the next stop, counters."""

    t: Array
    h: Array
    y: Array
    stop: Array
    steps: Array
    rejected: Array


# A recorded step is one row (3 + n, *bodies): start; length, 0 if it was rejected or a body had no
# need of it; twice the index of the stop ahead, and one more if it ends there; the state.
Rows = Array


class Book(NamedTuple):
    """A recorded run: the start of each segment, how many there are, the last one's rows."""

    starts: Walk
    number: Array
    rows: Rows
    filled: Array


class Answer(NamedTuple):
    """States `between` (K, n, *bodies) and at the `end` (n, *bodies), NaN where not reached; last
    time, next step and counters of the loop.
    """

    between: Array
    end: Array
    t: Array
    h: Array
    steps: Array
    rejected: Array


def value(method: Method, constants: list[Array], run: Run) -> Answer:
    """The answer, with nothing kept."""
    walk = start(method, constants, run)
    if not run.between.shape[0]:
        walk = lax.while_loop(
            lambda walk: jnp.any(going(method, run, walk)),
            lambda walk: _attempt(method, constants, run, walk, None)[0],
            walk,
        )
        return _answer(run, walk, jnp.zeros((0, *run.y0.shape), run.y0.dtype))

    def segment(state: Any) -> Any:
        walk, saved, rows = state
        walk, rows, count = recorded(method, constants, run, walk, rows, None)
        saved = _saved(method, constants, run, walk.t, rows, count, saved)
        return walk, saved, rows

    state = (walk, _none_saved(run), empty_rows(run, _SHORT))
    more = lambda state: jnp.any(going(method, run, state[0]))  # noqa: E731
    walk, saved, _ = lax.while_loop(more, segment, state)
    return _answer(run, walk, _kept(run, saved))


def recording(method: Method, constants: list[Array], run: Run) -> tuple[Answer, Book]:
    """The answer, and what derivatives need."""
    walk = start(method, constants, run)
    most = -(-method.max_steps // SEGMENT) + run.stops.shape[0] // SEGMENT + 1
    starts: Any = jax.tree.map(lambda a: jnp.zeros((most, *a.shape), a.dtype), walk)
    zero = jnp.zeros((), jnp.int32)

    def segment(state: Any) -> Any:
        walk, saved, book = state
        starts = jax.tree.map(lambda a, b: a.at[book.number].set(b), book.starts, walk)
        walk, rows, count = recorded(method, constants, run, walk, book.rows, None)
        saved = _saved(method, constants, run, walk.t, rows, count, saved)
        return walk, saved, Book(starts, book.number + 1, rows, count)

    state = (walk, _none_saved(run), Book(starts, zero, empty_rows(run, SEGMENT), zero))
    more = lambda state: jnp.any(going(method, run, state[0]))  # noqa: E731
    walk, saved, book = lax.while_loop(more, segment, state)
    return _answer(run, walk, _kept(run, saved)), book


def start(method: Method, constants: list[Array], run: Run) -> Walk:
    """A loop about to begin."""
    t0, y0 = run.t0, run.y0
    f0 = method.field(constants, t0, y0)
    h = lax.stop_gradient(_first_step(method, constants, run, f0))
    # Where there is no slope to begin with, no step is short enough.
    sound = jnp.all(jnp.isfinite(f0), 0) & jnp.all(jnp.isfinite(y0), 0)
    sound = sound & jnp.isfinite(t0) & jnp.isfinite(run.stops[-1])
    h = jnp.where(sound, jnp.where(jnp.isnan(run.h0), h, run.h0), jnp.nan)
    zero = jnp.zeros(t0.shape, jnp.int32)
    return Walk(t0, h, y0, zero, zero, zero)


def going(method: Method, run: Run, walk: Walk) -> Array:
    """Whether a body has not arrived, may still step, and has a step to take."""
    ahead = walk.stop < run.stops.shape[0]
    return ahead & (walk.steps < method.max_steps) & (walk.h > 0)


def _attempt(
    method: Method, constants: list[Array], run: Run, walk: Walk, until: Array | None
) -> tuple[Walk, tuple[Array, Array]]:
    """One attempt at a step of every body; the length, 0 if there was none, and the code."""
    on = going(method, run, walk)
    begin, end = at(run.stops, walk.stop), at(run.before, walk.stop)
    # A stop that is passed already, such as a jump before the start, needs no step.
    arrived = on & (walk.t >= begin)
    cut = jnp.zeros_like(on)
    if until is not None:
        # A segment that is run again ends where it ended.
        on = on & (walk.t < until)
        cut = until < end
        end = jnp.minimum(end, until)
    moving = on & ~arrived
    left = end - walk.t
    # The step kept is the controller's own, not the one cut short at a stop.
    last = walk.h >= left
    h = jnp.where(moving, jnp.where(last, left, walk.h), jnp.zeros_like(walk.h))
    late = jnp.where(last, end, walk.t + h)
    step = Step(walk.t, h, late, walk.y)
    there = runge_kutta.stages(method.tableau, method.field, constants, step)
    y = method.project(there.end)
    slope = None
    if runge_kutta.needs_last_slope(method.tableau):
        slope = method.field(constants, late, y)
    error = runge_kutta.error_estimate(method.tableau, method.sizes, h, there.slopes, slope)
    size = _size_of(error, walk.y, y, run.rtol, run.atol)
    # NaN in a step too long says as little as infinity: try a shorter one.
    size = lax.stop_gradient(jnp.where(jnp.isnan(size), jnp.inf, size))
    accept = moving & (size < 1)
    order = method.tableau.order
    factor = jnp.clip(_SAFETY * size ** (-1 / order), _SMALLEST, _LARGEST)
    following = lax.stop_gradient(h) * factor.astype(h.dtype)
    kept = lax.stop_gradient(walk.h)
    following = jnp.where(last & accept, jnp.maximum(following, kept), following)
    # Where no step is left to try the loop ends: h = 0, or NaN where it met one. Where t is 0 its
    # round-off is, too: then that of the run's length counts.
    least = jnp.finfo(h.dtype).eps * (run.stops[-1] - run.t0)
    unit = 8 * jnp.finfo(h.dtype).eps * jnp.maximum(jnp.abs(walk.t), least)
    why = jnp.where(jnp.isfinite(size), 0.0, jnp.nan).astype(h.dtype)
    following = jnp.where(moving & ~accept & ~(following > unit), why, following)
    reached = accept & last & ~cut
    following = jnp.where(moving, following, kept)
    after = Walk(
        jnp.where(accept, jnp.where(reached, begin, late), walk.t),
        following,
        jnp.where(lift(accept, y), y, walk.y),
        walk.stop + (arrived | reached).astype(jnp.int32),
        walk.steps + moving.astype(jnp.int32),
        walk.rejected + (moving & ~accept).astype(jnp.int32),
    )
    taken = jnp.where(accept, h, jnp.zeros_like(h))
    return after, (taken, 2 * walk.stop + reached.astype(jnp.int32))


def recorded(
    method: Method,
    constants: list[Array],
    run: Run,
    walk: Walk,
    rows: Rows,
    until: Array | None,
) -> tuple[Walk, Rows, Array]:
    """As many attempts from here on as there are rows, and how many there were."""
    many = _block_size(run)
    room = rows.shape[0] - many

    def on(walk: Walk) -> Array:
        here = going(method, run, walk)
        return jnp.any(here if until is None else here & (walk.t < until))

    def attempt(state: Any) -> Any:
        walk, few, k = state
        after, (h, code) = _attempt(method, constants, run, walk, until)
        head = jnp.stack([walk.t, h, code.astype(h.dtype)])
        row = jnp.concatenate([head, walk.y])
        return after, lax.dynamic_update_slice_in_dim(few, row[None], k, 0), k + 1

    def block(state: Any) -> Any:
        walk, rows, count = state
        few = jnp.zeros((many, *rows.shape[1:]), rows.dtype)
        more = lambda s: on(s[0]) & (s[2] < many)  # noqa: E731
        walk, few, k = lax.while_loop(more, attempt, (walk, few, jnp.zeros((), jnp.int32)))
        return walk, lax.dynamic_update_slice_in_dim(rows, few, count, 0), count + k

    more = lambda s: on(s[0]) & (s[2] < room)  # noqa: E731
    return lax.while_loop(more, block, (walk, rows, jnp.zeros((), jnp.int32)))


def _block_size(run: Run) -> int:
    size = run.y0.dtype.itemsize * (run.y0.shape[0] + 3)
    return max(1, min(8, _BLOCK // size))


def empty_rows(run: Run, room: int) -> Rows:
    """Space for `room` steps at least."""
    return jnp.zeros((room + _block_size(run), 3 + run.y0.shape[0], *run.t0.shape), run.y0.dtype)


def row_of(run: Run, row: Array) -> tuple[Step, Array]:
    """A recorded step, and its code."""
    t, h, code = row[0], row[1], row[2].astype(jnp.int32)
    end = jnp.where(code % 2 == 1, at(run.before, code // 2), t + h)
    return Step(t, h, end, row[3:]), code


def at(a: Array, index: Array) -> Array:
    """a[index] of each body, along the first axis; a (J, …, *bodies), index (…, *bodies)."""
    if a.shape[0] == 1:
        return jnp.broadcast_to(a[0], index.shape)
    index = jnp.clip(index, 0, a.shape[0] - 1)
    if not index.ndim:
        return a[index]
    return jnp.take_along_axis(a, index[None], 0)[0]


def per_body(function: Callable[..., Any], bodies: int) -> Callable[..., Any]:
    """A function of one body's arrays as one of arrays with a last axis of bodies, if there is."""
    return jax.vmap(function, in_axes=-1, out_axes=-1) if bodies else function


def within(run: Run, rows: Rows, count: Array, late: Array) -> tuple[Array, Array, Step]:
    """The rows that these times (many, *bodies) lie in, their codes, the steps to there."""
    bodies = run.t0.ndim
    there = jnp.arange(rows.shape[0], dtype=jnp.int32).reshape(-1, *[1] * bodies) < count
    starts = jnp.where(there, rows[:, 0], jnp.inf)

    def find(starts: Array, late: Array) -> Array:
        return jnp.searchsorted(starts, late, side="left", method="scan_unrolled") - 1

    index = jnp.maximum(per_body(find, bodies)(starts, late), 0)
    found = per_body(lambda a, i: a[i].T, bodies)(rows, index)
    t, h, code = found[0], found[1], found[2].astype(jnp.int32)
    before = per_body(lambda a, i: a[i], bodies)(
        run.before, jnp.minimum(code // 2, run.stops.shape[0] - 1)
    )
    limit = jnp.where(code % 2 == 1, before, t + h)
    # The limit is the last moment before a jump: it moves nothing, and has no derivative here.
    end = late + lax.stop_gradient(jnp.minimum(late, limit) - late)
    return index, code, Step(t, end - t, end, found[3:])


def side_by_side(method: Method) -> Method:
    """The method for (n, many, *bodies), the constants as they were."""
    field = jax.vmap(method.field, (None, 0, 1), 1)
    return method._replace(field=field, project=jax.vmap(method.project, 1, 1))


def _none_saved(run: Run) -> tuple[Array, Array]:
    size = run.between.shape[0]
    more = min(MANY, size)
    ys = jnp.full((size + more, *run.y0.shape), jnp.nan, run.y0.dtype)
    return ys, jnp.zeros(run.t0.shape, jnp.int32)


def _saved(
    method: Method,
    constants: list[Array],
    run: Run,
    reach: Array,
    rows: Rows,
    count: Array,
    saved: tuple[Array, Array],
) -> tuple[Array, Array]:
    """The states at the times between, as far as the run has come, and how many there are."""
    size = run.between.shape[0]
    if not size:
        return saved
    many, bodies = min(MANY, size), run.t0.ndim
    wide = side_by_side(method)
    each = jnp.arange(many, dtype=jnp.int32).reshape(-1, *[1] * bodies)

    def waiting(saved: Any) -> Array:
        known = saved[1]
        return jnp.any((known < size) & (at(run.between, known) <= reach))

    def batch(saved: Any) -> Any:
        ys, known = saved
        place = lift(known, each) + each
        late = per_body(lambda a, i: a[i], bodies)(run.between, jnp.minimum(place, size - 1))
        ready = (place < size) & (late <= lift(reach, late))
        _, _, step = within(run, rows, count, jnp.where(ready, late, lift(reach, late)))
        found = wide.project(runge_kutta.stages(wide.tableau, wide.field, constants, step).end)
        found = jnp.where(lift(ready, found), found, jnp.nan)

        def put(ys: Array, found: Array, known: Array) -> Array:
            return lax.dynamic_update_slice_in_dim(ys, found.T, known, 0)

        ys = per_body(put, bodies)(ys, found, known)
        return ys, known + jnp.sum(ready, 0, dtype=jnp.int32)

    return lax.while_loop(waiting, batch, saved)


def _kept(run: Run, saved: tuple[Array, Array]) -> Array:
    return saved[0][: run.between.shape[0]]


def _answer(run: Run, walk: Walk, between: Array) -> Answer:
    there = walk.stop >= run.stops.shape[0]
    end = jnp.where(lift(there, walk.y), walk.y, jnp.nan)
    return Answer(between, end, walk.t, walk.h, walk.steps, walk.rejected)


def _size_of(error: Array, left: Array, right: Array, rtol: Array, atol: Array) -> Array:
    """Root mean square of error over tolerance, as `diffrax.PIDController` takes it."""
    scale = lift(atol, left) + lift(rtol, left) * jnp.maximum(jnp.abs(left), jnp.abs(right))
    tiny = float(jnp.finfo(error.dtype).tiny)
    return jnp.sqrt(jnp.mean((error / scale) ** 2, 0) + tiny)


def _first_step(method: Method, constants: list[Array], run: Run, slope: Array) -> Array:
    """Hairer, Nørsett and Wanner (1993), II.4, algorithm for the starting step."""
    y0, t0 = run.y0, run.t0
    scale = lift(run.atol, y0) + lift(run.rtol, y0) * jnp.abs(y0)

    def norm(a: Array) -> Array:
        return jnp.sqrt(jnp.mean((a / scale) ** 2, 0))

    d0, d1 = norm(y0), norm(slope)
    small = (d0 < 1e-5) | (d1 < 1e-5)
    h = jnp.where(small, 1e-6, 0.01 * d0 / jnp.where(small, 1.0, d1)).astype(d0.dtype)
    turned = method.field(constants, t0 + h.astype(t0.dtype), y0 + lift(h, y0) * slope)
    d2 = norm(turned - slope) / h
    largest = jnp.maximum(d1, d2)
    flat = largest <= 1e-15
    guess = (0.01 / jnp.where(flat, 1.0, largest)) ** (1 / method.tableau.order)
    h = jnp.minimum(100 * h, jnp.where(flat, jnp.maximum(1e-6, 1e-3 * h), guess))
    return h.astype(t0.dtype)
