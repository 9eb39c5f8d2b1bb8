"""A traced field and all the times at which its steps end: declared jumps, and switches found."""

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import (
    ClosedJaxpr,  # pyright: ignore[reportPrivateImportUsage]
    jaxpr_as_fun,
)
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from rigidjax.solve.batching import Arrays
from rigidjax.solve.switching import MOST, Analysis, analysis_of
from rigidjax.solve.switching_times import by_sides, separated, times_of


def say_unseen(analysis: Analysis) -> None:
    """Warn of comparisons with the time in which no switch can be looked for."""
    for line in dict.fromkeys(analysis.unseen):
        warnings.warn(
            f"simulate: a law may jump at a time that is not found before the run ({line}): steps "
            "do not end there, and the derivative by that time is lost. Give the law `jump_times`, "
            "its jumps in s, or end the run there and begin another",
            stacklevel=2,
        )


class Traced(NamedTuple):
    """A traced function as `call(constants, *args)`, where the constants are arrays."""

    closed: ClosedJaxpr
    tree: Any  # of its result

    @property
    def constants(self) -> Arrays:
        """The arrays that the function holds; numbers of NumPy stay in its program."""
        return [c for c in self.closed.consts if eqx.is_array(c)]

    def consts(self, constants: Arrays) -> Arrays:
        """Return all constants of the program, with these arrays."""
        arrays = iter(constants)
        return [next(arrays) if eqx.is_array(c) else c for c in self.closed.consts]

    def call(self, constants: Arrays, *args: Any) -> Any:
        closed = ClosedJaxpr(self.closed.jaxpr, self.consts(constants))
        return self.tree.unflatten(jaxpr_as_fun(closed)(*jax.tree.leaves(args)))


def traced(function: Callable[..., Any], *like: Any) -> Traced:
    """Trace a function of such arguments once."""
    closed, out = jax.make_jaxpr(function, return_shape=True)(*like)
    return Traced(closed, jax.tree.structure(out))


def constants_of(
    functions: list[Callable[..., Any]], *like: Any
) -> tuple[list[Callable[..., Any]], Arrays]:
    """Return each function as `f(constants, *args)`, and the constants of all."""
    programs = [traced(function, *like) for function in functions]
    ends = np.cumsum([0, *(len(program.constants) for program in programs)])

    def call(i: int, constants: Arrays, *args: Any) -> Any:
        return programs[i].call(constants[ends[i] : ends[i + 1]], *args)

    calls = [partial(call, i) for i in range(len(programs))]
    return calls, [c for program in programs for c in program.constants]


class Stopped(NamedTuple):
    """A field whose steps end at `stops` (k,), s, in order: where it jumps, or has a kink."""

    field: Callable[..., Array]  # (constants, t, y)
    constants: Arrays
    smooth: int  # of the constants the first, which may have derivatives
    stops: Array
    over: Array | None  # whether a part switches more often than it has places for


def stopped(
    function: Callable[..., Array], declared: list[Array], a: Array, b: Array, y: Array
) -> Stopped:
    """Return the field `function(t, y, *sides)` between times a and b with all its stops.

    `declared` are the jump times of each part that declares some; if there are more than one, each
    part gets its stops as one of `sides`, in s.
    """
    declared = [times.astype(a.dtype) for times in declared if times.size]
    likes = declared if len(declared) > 1 else []
    program = traced(function, a, y, *likes)
    analysis, number = analysis_of(program.closed), len(program.constants)
    if analysis is not None:
        say_unseen(analysis)
    if analysis is None or not analysis.switches:
        if not likes:
            stops = jnp.clip(jnp.sort(declared[0]), a, b) if declared else jnp.zeros(0, a.dtype)
            return Stopped(program.call, program.constants, number, stops, None)
        stops, each = separated(jnp.concatenate(declared), a, b)
        sides = _split(lax.stop_gradient(each), declared)
        call = lambda given, t, y: program.call(given[:number], t, y, *given[number:])  # noqa: E731
        return Stopped(call, [*program.constants, *sides], number, stops, None)
    found = times_of(analysis, program.closed.consts, a, b)
    stops, each = separated(jnp.concatenate([*declared, found.times]), a, b)
    *sides, own = _split(lax.stop_gradient(each), [*declared, found.times])
    over, most = found.over, MOST + sum(times.shape[0] for times in declared)
    if stops.shape[0] > most:
        stops, over = stops[:most], over | (stops[most] < b)
    # As one array: a loop that carries many is slower.
    places = lax.stop_gradient((own, found._replace(times=own[:0])))
    one, unpacked = ravel_pytree(jax.tree.map(lambda leaf: leaf.astype(a.dtype), places))
    more, field = [*(sides if likes else []), one], by_sides(analysis)

    def call(given: Arrays, t: Array, y: Array) -> Array:
        *sides, one = given[number:]
        return field(program.consts(given[:number]), t, y, *sides, unpacked(one))

    return Stopped(call, [*program.constants, *more], number, stops, over)


def _split(whole: Array, like: list[Array]) -> list[Array]:
    return list(jnp.split(whole, np.cumsum([a.shape[0] for a in like])[:-1]))
