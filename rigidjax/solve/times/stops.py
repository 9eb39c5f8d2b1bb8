"""Find all stops, which are the times at which steps end because the vector field jumps there.

A law may declare its jumps; other jumps are found as switches in the traced field.
"""

import warnings
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from rigidjax.solve.programs.batching import Arrays
from rigidjax.solve.programs.traced import trace_program
from rigidjax.solve.times.switching import MOST, find_switches
from rigidjax.solve.times.switching_times import find_changes, separate_equal_times, values_between


class ProgramWithStops(NamedTuple):
    """Hold a vector field, and the `stops`: the times at which it jumps or has a kink.

    Steps end at the stops.
    """

    field: Callable[..., Array]  # (constants, t, y)
    constants: Arrays
    smooth: int  # only the first `smooth` constants may have derivatives
    stops: Array  # (k,), s, in order
    # Whether some times are missing in `stops`, because a part of the field switches more often
    # than can be stored; `None` if no part was found to switch.
    over: Array | None


def program_with_stops(
    function: Callable[..., Array], declared_jumps: list[Array], t0: Array, t1: Array, y: Array
) -> ProgramWithStops:
    """Return a field `function(t, y, *sides)`, and its jump times between t0 and t1.

    If several parts declare jumps, `sides` has for each of them the times, s, at which steps end
    because of its jumps, else it is empty. `y` is an example of the state.
    """
    declared = [times.astype(t0.dtype) for times in declared_jumps if times.size]
    likes = declared if len(declared) > 1 else []
    program = trace_program(function, t0, y, *likes)
    found, number = find_switches(program.closed), len(program.jax_constants)
    for line in found.unfound:
        warnings.warn(
            f"simulate: a law may jump at a time that is not found before the run ({line}): steps "
            "do not end there, and the derivative with respect to that time is lost. Give the law "
            "`jump_times`, its jumps in s, or end the run there and begin another",
            stacklevel=2,
        )
    if not found.switches:
        if not likes:
            stops = jnp.clip(jnp.sort(declared[0]), t0, t1) if declared else jnp.zeros(0, t0.dtype)
            return ProgramWithStops(program.call, program.jax_constants, number, stops, None)
        stops, each = separate_equal_times(jnp.concatenate(declared), t0, t1)
        sides = _split_like(lax.stop_gradient(each), declared)
        call = lambda given, t, y: program.call(given[:number], t, y, *given[number:])  # noqa: E731
        return ProgramWithStops(call, [*program.jax_constants, *sides], number, stops, None)
    changes = find_changes(found, program.closed.consts, t0, t1)
    times = [*declared, changes.times]
    stops, each = separate_equal_times(jnp.concatenate(times), t0, t1)
    *sides, own = _split_like(lax.stop_gradient(each), times)
    over, most = changes.over, MOST + sum(t.shape[0] for t in declared)
    if stops.shape[0] > most:
        stops, over = stops[:most], over | (stops[most] < t1)
    # The arrays that describe the changes are joined to one, because a loop that carries many
    # arrays is slower.
    places = lax.stop_gradient((own, changes._replace(times=own[:0])))
    one, unpacked = ravel_pytree(jax.tree.map(lambda leaf: leaf.astype(t0.dtype), places))

    def call(given: Arrays, t: Array, y: Array) -> Array:
        *sides, one = given[number:]
        own, changes = unpacked(one)
        values = values_between(found, changes, own, t)
        consts = program.replace_jax_constants(given[:number])
        return found.field(values, changes.over > 0, consts, t, y, *sides)

    more = [*(sides if likes else []), one]
    return ProgramWithStops(call, [*program.jax_constants, *more], number, stops, over)


def _split_like(whole: Array, like: list[Array]) -> list[Array]:
    """Return `whole` cut along its first axis into parts as long as the arrays in `like`."""
    return list(jnp.split(whole, np.cumsum([a.shape[0] for a in like])[:-1]))
