"""The way back along chapters of many bodies under `jax.vmap`: a lane each, one step at a time.

One body has to work out the derivatives of many steps side by side, for every cotangent that may
come. Many bodies fill the lanes by themselves: here a step waits for its cotangent, and one vjp of
the field at each stage is all there is to do.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax.solve import linear
from rigidjax.solve.backward import Bars, Chapter, alone, asked, steps_of, within
from rigidjax.solve.march import Rows
from rigidjax.solve.method import Method, spread
from rigidjax.solve.scalarise import atoms_of, gathered

# Bodies abreast, so that on CPU the stages of a step stay in the second cache; fewer than `_FEW` do
# not pay for the many small loops over them.
_ABREAST, _FEW = 128, 8


def back_through(method: Method, chapter: Chapter, bars: Bars) -> Bars:
    """`rigidjax.solve.backward.alone`, and under `jax.vmap` as many bodies as there are."""
    one: Any = jax.custom_batching.custom_vmap(partial(alone, method))
    one.def_vmap(partial(_batched, method))
    return one(chapter, bars)


def _batched(method: Method, size: int, batched: Any, *given: Any) -> tuple[Bars, Bars]:
    def each(a: Any, is_batched: bool) -> Any:
        return a if is_batched else jnp.broadcast_to(a, (size, *jnp.shape(a)))

    chapter, bars = jax.tree.map(each, given, tuple(batched))
    if size < _FEW or any(jax.tree.leaves(batched[0].rest)):
        out = lax.map(lambda lane: alone(method, *lane), (chapter, bars))
    else:
        # What is not a real number of the field is the same for all.
        out = _abreast(method, chapter._replace(rest=given[0].rest), bars)
    return out, jax.tree.map(lambda _: True, out)


def _abreast(method: Method, chapter: Chapter, bars: Bars) -> Bars:
    """All bodies, some at a time."""
    size = chapter.length.shape[0]
    some = min(_ABREAST, size) if jax.default_backend() == "cpu" else size
    bars0, one = bars, jax.tree.map(lambda a: a[0], chapter.constants)
    values = spread(eqx.combine(one, chapter.rest))
    _, replaced = atoms_of(values)

    def numbers(constants: Any) -> list[Array]:
        return atoms_of(spread(eqx.combine(constants, chapter.rest)))[0]

    atoms = jax.vmap(numbers)(chapter.constants)

    @jax.vmap
    def field(atoms: list[Array], t: Array, y: Any) -> Any:
        return method.field(replaced(atoms), t, *y)

    back = partial(linear.step_back, method, field)

    def group(number: Any, bars: Bars) -> Bars:
        # The last group begins early rather than ends late; those met twice are done twice.
        begin = jnp.minimum(number * some, size - some).astype(jnp.int32)

        def cut(a: Array) -> Array:
            return lax.dynamic_slice_in_dim(a, begin, some, 0)

        own = jax.tree.map(cut, (bars0, atoms))
        new, found = _group(back, chapter, begin, *own)
        constants = jax.vmap(lambda found: gathered(values, found))(found)
        constants = jax.tree.map(jnp.add, new.constants, constants)
        new = new._replace(constants=constants)
        return jax.tree.map(lambda a, b: lax.dynamic_update_slice_in_dim(a, b, begin, 0), bars, new)

    if some == size:
        return group(jnp.zeros((), jnp.int32), bars)
    return lax.fori_loop(0, -(-size // some), group, bars)


def _group(
    back: Any, chapter: Chapter, begin: Any, bars: Bars, atoms: list[Array]
) -> tuple[Bars, list[Array]]:
    """Some bodies from the ends of their chapters to the starts, and the sums by the atoms."""
    some = bars.state.shape[0]
    each = jnp.arange(some, dtype=jnp.int32)

    def cut(a: Array) -> Array:
        return lax.dynamic_slice_in_dim(a, begin, some, 0)

    on, stops, count, between, seeds = jax.tree.map(
        cut, (chapter.on, chapter.stops, chapter.length, chapter.between, chapter.seeds)
    )
    count = jnp.where(on, count, 0)

    def row(i: Array) -> Rows:
        """Of each body; the record is not cut out of the batch's, only this is read."""

        def read(a: Array) -> Array:
            place = (begin, i, *[jnp.zeros((), i.dtype)] * (a.ndim - 2))
            return lax.dynamic_slice(a, place, (some, 1, *a.shape[2:]))[:, 0]

        return jax.tree.map(read, chapter.rows)

    def pulled(lanes: linear.Lanes, there: Array, after: Array, found: Any) -> Any:
        """One step of those who are there; what is in the others' rows is no step."""

        def kept(a: Array) -> Array:
            here = there.reshape(-1, *[1] * (a.ndim - 1))
            return jnp.where(here, a, jnp.zeros_like(a))

        before, by_atoms, by_time, by_length = back(atoms, lanes, after.T)
        before, by_atoms, *times = jax.tree.map(kept, (before.T, by_atoms, by_time, by_length))
        return before, jax.tree.map(jnp.add, found, by_atoms), *times

    found = jax.tree.map(jnp.zeros_like, atoms)
    ends, asked_for = bars.ends, bars.between
    extra = None
    if between.shape[1]:
        rows = jax.tree.map(cut, chapter.rows)
        first, last = jax.vmap(asked)(stops, rows, count, between)
        where, short = jax.vmap(within)(stops, rows, count, between)
        short = short._replace(y=short.y.transpose(1, 0, 2))

        def look(sums: Any, k: Array) -> tuple[Any, None]:
            extra, found, ends, asked_for = sums
            there = on & (first <= k) & (k < last)
            lanes = jax.tree.map(lambda a: a[..., k], short)
            before, found, by_time, by_length = pulled(lanes, there, seeds[:, k], found)
            extra = extra.at[each, where[:, k]].add(before)
            stop = rows.code[each, where[:, k]] // 2
            ends = ends.at[each, stop].add(by_time - by_length)
            return (extra, found, ends, asked_for.at[:, k].add(by_length)), None

        begin_with = (jnp.zeros_like(rows.y), found, ends, asked_for)
        sums, _ = lax.scan(look, begin_with, jnp.arange(between.shape[1], dtype=jnp.int32))
        extra, found, ends, asked_for = sums

    def step(state: Any) -> Any:
        i, bar, found, ends = state
        i = i - 1
        there, here = i < count, row(i)
        lanes = jax.vmap(steps_of)(stops, here)
        lanes = lanes._replace(y=lanes.y.T)
        before, found, by_time, by_length = pulled(lanes, there, bar, found)
        if extra is not None:
            before = before + extra[:, i]
        cut_short = jnp.where(here.code % 2 == 1, by_length, jnp.zeros_like(by_length))
        ends = ends.at[each, here.code // 2].add(by_time - cut_short)
        ends = ends.at[each, here.code // 2 + 1].add(cut_short)
        return i, jnp.where(there[:, None], before, bar), found, ends

    state = (jnp.max(count), bars.state, found, ends)
    _, bar, found, ends = lax.while_loop(lambda state: state[0] > 0, step, state)
    return bars._replace(state=bar, ends=ends, between=asked_for), found
