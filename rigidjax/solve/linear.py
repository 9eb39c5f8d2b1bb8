"""The derivative of many steps at once, as matrices.

The steps are known: their derivatives do not wait for each other and are worked out side by side,
a lane each. Only the product of 7×7 matrices along the trajectory is a chain. Lanes are the last
axis of every array.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from rigidjax.solve.explicit import Atoms
from rigidjax.solve.method import Method
from rigidjax.solve.scalarise import atoms_of, gathered
from rigidjax.solve.tableaus import Tableau


class Lanes(NamedTuple):
    """Steps: time, length and end (R,), state at the start (n, R)."""

    t: Array
    h: Array
    end: Array
    y: Array


class Stages(NamedTuple):
    """What happens inside the steps: times (s, R); states, slopes (s, n, R); end (n, R).

    `turns` (n, n, s, R) is ∂f_i/∂y_j at each stage, `last` (n, n, R) that of the projection.
    """

    times: Array
    places: Array
    slopes: Array
    turns: Array
    last: Array


class Pull(NamedTuple):
    """Cotangents of the states at the ends pulled back to the starts, and onto the slopes.

    `start` (n, m, R), `slopes` (s, n, m, R).
    """

    start: Array
    slopes: Array


def stepped(
    tableau: Tableau, field: Callable[..., Atoms], lanes: Lanes
) -> tuple[Array, tuple[Array, Array, Array]]:
    """The states at the ends, not projected (n, R); times, states and slopes at the stages.

    One stage after another in a loop: written out they would be as fast, and longer to compile.

    **Arguments:** `field(t, *y)` of lanes, all of one body, or each of its own.
    """
    size, many = lanes.y.shape
    count = len(tableau.a) + 1
    weights = np.zeros((count + 1, count))
    for i, row in enumerate([{}, *tableau.a, tableau.b]):
        weights[i, list(row)] = list(row.values())
    weights = jnp.asarray(weights, lanes.y.dtype)[..., None, None]
    nodes = np.array([0.0, *tableau.c])

    def stage(slopes: Array, which: Any) -> tuple[Array, tuple[Array, Array]]:
        i, row, node, final = which
        place = lanes.y + lanes.h[None] * (row * slopes).sum(0)
        t = jnp.where(final, lanes.end, lanes.t + node * lanes.h)
        slope = jnp.stack(lax.optimization_barrier(field(t, *place)))
        return slopes.at[i].set(slope), (t, place)

    stages = (
        jnp.arange(count),
        weights[:-1],
        jnp.asarray(nodes, lanes.t.dtype),
        jnp.asarray(nodes == 1),
    )
    begin = jnp.zeros((count, size, many), lanes.y.dtype)
    slopes, (times, places) = lax.scan(stage, begin, stages)
    end = lanes.y + lanes.h[None] * (weights[-1] * slopes).sum(0)
    return end, (times, places, slopes)


def _of_one(method: Method, values: Any) -> Callable[..., Atoms]:
    return jax.vmap(lambda t, *y: method.field(values, t, *y))


def looped_step(
    method: Method, values: Any, t: Array, end: Array, h: Array, y: Atoms
) -> tuple[Atoms, Atoms]:
    """`Method.step_and_error`, its stages in a loop."""
    lanes = Lanes(t[None], h[None], end[None], jnp.stack(y)[:, None])
    raw, (_, _, slopes) = stepped(method.tableau, _of_one(method, values), lanes)
    return method.ended(values, end, h, tuple(raw[:, 0]), [tuple(k) for k in slopes[..., 0]])


def ends_of(method: Method, values: Any, lanes: Lanes) -> Array:
    """The states at the ends (n, R), on the group."""
    raw, _ = stepped(method.tableau, _of_one(method, values), lanes)
    return jnp.stack(jax.vmap(method.project)(*raw))


def stages_of(method: Method, values: Any, lanes: Lanes) -> Stages:
    """Everything inside the steps that their derivatives are made of."""
    raw, (times, places, slopes) = stepped(method.tableau, _of_one(method, values), lanes)
    count, size, many = places.shape
    wide = places.transpose(1, 0, 2).reshape(size, count * many)

    def turn(t: Array, *y: Array) -> Any:
        return _jacobian(lambda *z: method.field(values, t, *z), y)

    turns = _matrix(jax.vmap(turn)(times.reshape(-1), *wide))
    turns = turns.reshape(size, size, count, many)
    last = _matrix(jax.vmap(lambda *y: _jacobian(method.project, y))(*raw))
    return Stages(times, places, slopes, turns, last)


def pulled(method: Method, stages: Stages, h: Array, seeds: Array) -> Pull:
    """The transposed step, applied to `seeds` (n, m, R), cotangents of the states at the ends."""
    tableau = method.tableau
    # Columns of the tableau: which stages and results a slope goes into.
    rows = [{}, *tableau.a]
    end = _transposed(stages.last, seeds)
    below: dict[int, Array] = {}
    slopes: dict[int, Array] = {}
    for i in reversed(range(len(rows))):
        total = tableau.b.get(i, 0.0) * end
        for j in range(i + 1, len(rows)):
            if i in rows[j]:
                total = total + rows[j][i] * below[j]
        slopes[i] = lax.optimization_barrier(h[None, None] * total)
        below[i] = lax.optimization_barrier(_transposed(stages.turns[:, :, i], slopes[i]))
    start = end + sum(below.values())
    return Pull(start, jnp.stack([slopes[i] for i in range(len(rows))]))


def fed(
    method: Method, values: Any, stages: Stages, slopes: Array
) -> tuple[list[Array | None], Array]:
    """Cotangents of the field's constants, summed, and of the stages' times (s, R).

    **Arguments:** `slopes` (s, n, R) those of the slopes. `None` for constants of whole numbers.
    """
    count, size, many = slopes.shape
    atoms, replaced = atoms_of(values)

    few, long = eqx.partition(atoms, [not atom.ndim for atom in atoms])
    wide = [a.transpose(1, 0, 2).reshape(size, count * many) for a in (stages.places, slopes)]
    places, cotangents = (tuple(a) for a in wide)
    times = stages.times.reshape(-1)

    def field(few: Any, long: Any, t: Array, y: Atoms) -> Atoms:
        return method.field(replaced(eqx.combine(few, long)), t, *y)

    def one(t: Array, y: Atoms, cotangent: Atoms) -> Any:
        return jax.vjp(lambda few, t: field(few, long, t, y), few, t)[1](cotangent)

    found, by_time = jax.vmap(one)(times, places, cotangents)
    found = jax.tree.map(lambda c: c.sum(0), lax.optimization_barrier(found))
    if jax.tree.leaves(long):
        # Of a table, or a network's weights, one cotangent for all lanes, not one in each.
        def every(long: Any) -> Atoms:
            return jax.vmap(lambda t, y: field(few, long, t, y))(times, places)

        found = eqx.combine(found, jax.vjp(every, long)[1](cotangents)[0])
    return gathered(values, found), by_time.reshape(count, many)


def lengths(method: Method, stages: Stages, h: Array, slopes: Array, times: Array) -> Array:
    """Cotangents of the steps' lengths (R,), from those of slopes and times of the stages."""
    nodes = jnp.asarray([0.0, *method.tableau.c], times.dtype)
    return (slopes * stages.slopes).sum((0, 1)) / h + (nodes[:, None] * times).sum(0)


def step_back(
    method: Method, field: Callable[..., Atoms], atoms: Any, lanes: Lanes, after: Array
) -> tuple[Array, Any, Array, Array]:
    """One cotangent (n, R) after each step pulled back to its start; stages in a loop.

    **Arguments:** `field(atoms, t, y)` of lanes, `atoms` the numbers that it depends on.
    **Returns** the cotangents before, and those of the atoms, the starts' times, the lengths.
    """
    tableau = method.tableau
    count, many = len(tableau.a) + 1, after.shape[1]

    def pull(t: Array, y: Any, slope: Any) -> Any:
        return jax.vjp(field, atoms, t, y)[1](slope)

    def land(raw: Any, after: Any) -> Any:
        return jax.vjp(lambda *y: method.project(*y), *raw)[1](after)

    raw, (times, places, slopes) = stepped(tableau, lambda t, *y: field(atoms, t, y), lanes)
    end = jnp.stack(jax.vmap(land)(tuple(raw), tuple(after)))
    columns, weights = np.zeros((count, count)), np.zeros(count)
    for i, row in enumerate(tableau.a):
        columns[list(row), i + 1] = list(row.values())
    weights[list(tableau.b)] = list(tableau.b.values())
    dtype = after.dtype

    def stage(sums: Any, which: Any) -> tuple[Any, None]:
        below, found, begin, length = sums
        i, weight, column, node, t, place, slope = which
        total = weight * end + (column[:, None, None] * below).sum(0)
        seed = lax.optimization_barrier(lanes.h[None] * total)
        by_atoms, by_time, by_place = pull(t, tuple(place), tuple(seed))
        by_place = lax.optimization_barrier(jnp.stack(by_place))
        found = jax.tree.map(jnp.add, found, by_atoms)
        length = length + (total * slope).sum(0) + node * by_time
        return (below.at[i].set(by_place), found, begin + by_time, length), None

    none = jnp.zeros(many, lanes.t.dtype)
    start = (jnp.zeros_like(places), jax.tree.map(jnp.zeros_like, atoms), none, none)
    stages = (
        jnp.arange(count),
        jnp.asarray(weights, dtype),
        jnp.asarray(columns, dtype),
        jnp.asarray([0.0, *tableau.c], lanes.t.dtype),
        times,
        places,
        slopes,
    )
    (below, found, begin, length), _ = lax.scan(stage, start, stages, reverse=True)
    return end + below.sum(0), found, begin, length


def _jacobian(function: Any, y: Atoms) -> Any:
    """∂f_i/∂y_j, column by column, so that what does not depend on a number costs nothing."""
    columns = []
    for j in range(len(y)):

        def along(z: Array, j: int = j) -> Atoms:
            return function(*y[:j], z, *y[j + 1 :])

        columns.append(jax.jvp(along, (y[j],), (jnp.ones_like(y[j]),))[1])
    return tuple(columns)


def _matrix(columns: Any) -> Array:
    """Columns of lanes as one array, rows first."""
    # A stack of what is still to be computed is a loop full of branches.
    columns = lax.optimization_barrier(columns)
    return jnp.stack([jnp.stack(row) for row in zip(*columns, strict=True)])


def _transposed(matrix: Array, columns: Array) -> Array:
    """Mᵀ C, written out: XLA makes of it one pass over the lanes."""
    return sum(  # pyright: ignore[reportReturnType]
        matrix[i][:, None] * columns[i][None] for i in range(matrix.shape[0])
    )
