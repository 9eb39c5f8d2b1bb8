"""A second pass over a recorded run, for its tangents, and a pass back, for cotangents.

The derivative is that of the steps taken, with fixed lengths, except that steps cut short at a stop
follow it, as in `diffrax.RecursiveCheckpointAdjoint`. All segments but the last are run once more;
they may take other steps between the same two ends if another program rounds differently: the
derivative is then that of these steps, the same to the tolerance.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax.solve import dense_output, runge_kutta
from rigidjax.solve.adaptive_loop import going, recorded, segment
from rigidjax.solve.components import lift
from rigidjax.solve.runge_kutta import Step
from rigidjax.solve.step_control import HEAD, STEP, Method, Record, Run, Segment, times_of, unpacked


def replayed(
    method: Method, constants: list[Array], run: Run, record: Record
) -> tuple[Array, Array, Array, Array]:
    """The states between and at the end, the starts and the rows by the steps of the record.

    These are held: so the tangents of all four are those of the run.
    """
    head = record.starts.shape[1] - run.y0.shape[0]

    def one(i: Array, state: tuple[Array, Array, Array, Array]) -> Any:
        y, ys, starts, _ = state
        part = _again(method, *still, held, i)
        starts = lax.dynamic_update_index_in_dim(starts, starts[i].at[head:].set(y), i, 0)

        def step(k: Array, both: tuple[Array, Array]) -> tuple[Array, Array]:
            y, rows = both
            row = part.rows[k]
            there = runge_kutta.stages(
                method.tableau, method.field, constants, Step(*times_of(run, row), y)
            )
            rows = lax.dynamic_update_index_in_dim(rows, row.at[HEAD:].set(y), k, 0)
            return jnp.where(lift(row[2] >= STEP, y), method.project(there.end), y), rows

        y, rows = lax.fori_loop(0, part.number, step, (y, part.rows))
        if run.between.shape[0]:
            ys = dense_output.saved(method, constants, run, part, rows[:, HEAD:], ys)
        return y, ys, starts, rows

    still, held = lax.stop_gradient(((constants, run), record))
    number = jnp.max(held.number)
    ys = jnp.zeros((run.between.shape[0], *run.y0.shape), run.y0.dtype)
    state = (run.y0, ys, held.starts, held.rows)
    y, ys, starts, rows = lax.fori_loop(0, number, one, state)
    starts = lax.dynamic_update_index_in_dim(starts, starts[number].at[head:].set(y), number, 0)
    return ys, y, starts, rows


def cotangents(
    method: Method,
    constants: list[Array],
    run: Run,
    record: Record,
    bars: Sequence[Array],
    timed: bool,
) -> tuple[list[Array], Run]:
    """The transpose of the tangents of `replayed`: cotangents of the constants and of the run.

    Those of times only where they are `timed`; those of tolerances and of the first step are 0.

    **Arguments:** `bars` of the states between (K, n, *bodies) and at the end (n, *bodies).
    """
    number, size = jnp.max(record.number), run.between.shape[0]

    def one(i: Array, sums: tuple[list[Array], Run]) -> tuple[list[Array], Run]:
        part = _again(method, constants, run, record, number - 1 - i)
        known = dense_output.known(run, part) if size else None

        def step(k: Array, sums: tuple[list[Array], Run]) -> tuple[list[Array], Run]:
            total, of_run = sums
            k = part.number - 1 - k
            row = part.rows[k]
            by = lambda t0, stops: times_of(run._replace(t0=t0, stops=stops), row)  # noqa: E731
            (t, h, end), of_times = jax.vjp(by, run.t0, run.stops)
            here = Step(t, h, end, row[HEAD:])
            dense, seeds, of_slopes, between = False, [], None, of_run.between
            if known is not None:
                dense = jnp.any(known[k] < known[k + 1])
            there = runge_kutta.stages(method.tableau, method.field, constants, here, dense)
            bar = jax.vjp(method.project, there.end)[1](of_run.y0)[0]
            if known is not None:
                between, *seeds, of_slopes = dense_output.pulled(
                    method, run, here, there.slopes, known[k], known[k + 1], bars[0],
                    between if timed else None,
                )  # fmt: skip
            by_constants, *rest = runge_kutta.pulled(
                method.tableau, method.field, constants, here, there, bar, of_slopes, dense
            )
            if seeds:
                rest = [a + b for a, b in zip(rest, seeds, strict=True)]
            # A body that has no step here may be NaN.
            on = row[2] >= STEP
            by_t, by_h, by_y = (_where(on, a) for a in rest)
            by_t0, by_stops = of_times((by_t, by_h, jnp.zeros_like(end)))
            total = [a + _where(on, b) for a, b in zip(total, by_constants, strict=True)]
            of_run = of_run._replace(y0=by_y + _where(~on, of_run.y0))
            if between is None or not timed:
                return total, of_run
            t0, stops = of_run.t0 + by_t0, of_run.stops + by_stops
            return total, of_run._replace(t0=t0, stops=stops, between=between)

        return lax.fori_loop(0, part.number, step, sums)

    none = Run(*(jnp.zeros_like(a) for a in run))._replace(y0=bars[1])
    return lax.fori_loop(0, number, one, ([jnp.zeros_like(c) for c in constants], none))


def _where(there: Array, a: Array) -> Array:
    """`a` (…, *bodies), nothing where it is not `there`."""
    return jnp.where(lift(there, a), a, jnp.zeros_like(a))


def _again(
    method: Method, constants: list[Array], run: Run, record: Record, number: Array
) -> Segment:
    """A segment of the record; any but the last is run once more."""
    loop, after = (unpacked(record.starts[i]) for i in (number, number + 1))
    again = number < jnp.max(record.number) - 1
    # Nothing is left to do of the last one.
    until = jnp.where(again, after.t, -jnp.inf)
    end, rows, count = recorded(method, constants, run, loop, record.rows, until)
    # With too little room for its steps there would be wrong numbers: then there are none.
    short = jnp.where(jnp.any(going(method, run, end, until)), jnp.nan, 0.0)
    rows = rows.at[:, HEAD:].add(short.astype(rows.dtype))
    count = jnp.where(again, count, jnp.max(record.filled))
    return segment(rows, loop.t, after.t, count)
