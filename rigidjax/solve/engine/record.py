"""Define a run as one function of arrays, which has derivatives in forward and in reverse mode.

The function runs one body or, under `jax.vmap`, a batch of bodies.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_derivatives import SymbolicZero, zero_from_primal
from jaxtyping import Array

from rigidjax.solve.engine import adjoint
from rigidjax.solve.engine.adjoint import Smooth
from rigidjax.solve.engine.loop import (
    LoopState,
    Method,
    Record,
    Run,
    loop_at_end,
    loop_at_start,
    pack_loop,
    record_run,
    run_one,
    unpack_loop,
)
from rigidjax.solve.programs.batching import Arrays, Layout, bodies_last, with_replacements
from rigidjax.solve.programs.linear_map import linear_map, no_transpose

SMOOTH = len(Smooth._fields)


def run_replayed(
    method: Method, smooth: list[bool], constants: Arrays, controller_states: Any, run: Run
) -> tuple[Array, LoopState]:
    """Run one body, with derivatives that repeat its recorded steps at constant lengths.

    Return the states (K, n) at the saved times (NaN if not reached), and the loop at the end. The
    states have derivatives with respect to the constants that `smooth` selects, and to `Smooth`.
    All bodies of a batch may share the `controller_states`.
    """
    arrays_of_bodies, run_tree = jax.tree.flatten(run)
    first, state_tree = jax.tree.flatten(controller_states)
    number, smooth = len(constants) + len(first), [*smooth, *(False for _ in first)]
    like = loop_at_start(run._replace(state=controller_states))
    trees = run_tree, state_tree
    # The function `recorded` below runs the bodies, and returns a list of arrays: the states at the
    # saved times; the state of the loop over the steps at the end, packed into `size` arrays; and
    # the record of the steps, which is divided into segments. The record is `size` arrays for the
    # states of the loop at the starts of the segments, one array for the rows (one row for each
    # step) and one for the counts of segments and rows. `states` are the indices of the arrays in
    # the list that have derivatives. The function `answer` below makes no record, and returns only
    # the first `head` arrays of the list.
    size = len(jax.eval_shape(pack_loop, like))
    states, head = [0, 1, 1 + size, 1 + 2 * size], 1 + size

    def mapped(program: Any, linear: int, *args: Any) -> Arrays:
        call = partial(program, method, trees)
        return bodies_last(call, list(args[:number]), list(args[number:]), linear)

    answer: Any = jax.custom_jvp(partial(mapped, partial(_run_bodies, False), 0))
    recorded: Any = jax.custom_jvp(partial(mapped, partial(_run_bodies, True), 0))

    def results_and_tangents(
        primals: Sequence[Any], tangents: Sequence[Any], pull: Callable[..., Arrays] | None = None
    ) -> tuple[Arrays, Arrays]:
        """Return the results and the record of a run, and the tangents of their states.

        Reverse mode calls `pull`, and raises an error if it is `None`.
        """
        # `there` says of each input whether it has a tangent. Derivatives with respect to the other
        # inputs are not computed.
        there = [not isinstance(t, SymbolicZero) for t in tangents]
        of_run = [t and i < SMOOTH for i, t in enumerate(there[number:])]
        has_tangent = [s and t for s, t in zip(smooth, there[:number], strict=True)], of_run
        along = [t for t, m in zip(tangents, [*has_tangent[0], *has_tangent[1]], strict=True) if m]
        found = recorded(*primals)
        push = partial(mapped, partial(_push, has_tangent), len(along))
        given = [*primals, *found[head:]]
        if pull is None:
            return found, linear_map(push, no_transpose, given, along)
        # Reverse mode takes only the first two results of `push`: the tangents of the states at the
        # saved times, and those of the state at the end.
        back = partial(mapped, partial(pull, has_tangent), 2)
        return found, linear_map(lambda *args: push(*args)[:2], back, given, along)

    def with_zeros(found: Arrays, moved: Arrays) -> tuple[Arrays, Arrays]:
        along = [zero_from_primal(a) for a in found]
        for i, tangent in zip(states, moved, strict=False):
            along[i] = tangent
        return found, along

    def of_answer(primals: Any, tangents: Any) -> Any:
        found, moved = results_and_tangents(primals, tangents, _pull)
        return with_zeros(found[:head], moved)

    def of_record(primals: Any, tangents: Any) -> Any:
        return with_zeros(*results_and_tangents(primals, tangents))

    answer.defjvp(of_answer, symbolic_zeros=True)
    recorded.defjvp(of_record, symbolic_zeros=True)
    between, *end = answer(*constants, *first, *arrays_of_bodies)
    return between, unpack_loop(end, like)


class _BodiesLast(NamedTuple):
    """Hold a run whose method takes arrays with the bodies in the last axis."""

    method: Method
    run: Run
    layout: Layout
    constants: Arrays


def _with_bodies_last(
    method: Method,
    trees: tuple[Any, Any],
    layout: Layout,
    constants: Arrays,
    arrays_of_bodies: Arrays,
) -> _BodiesLast:
    """Return a run, whose method is for one body, with a method for bodies in the last axis.

    The last `constants`, the states of the controller, become `run.state`. The others are bound,
    without derivatives, to `halt` and `control`.
    """
    run_tree, state_tree = trees
    run, count = run_tree.unflatten(arrays_of_bodies), len(constants) - state_tree.num_leaves
    state = layout.broadcast(constants, [i >= count for i in range(len(constants))], run.t0)
    run = run._replace(state=state_tree.unflatten(state[1][count:]))
    constants, layout = constants[:count], layout._replace(shared=layout.shared[:count])
    held, one = lax.stop_gradient(constants), method.control
    halt = None if method.halt is None else partial(layout.vmap(method.halt), held)

    control = lambda again, *numbers: layout.vmap(partial(one, again))(held, *numbers)  # noqa: E731
    project = jax.vmap(method.project, -1, -1) if layout.bodies else method.project
    field = layout.vmap(method.field)
    method = method._replace(field=field, project=project, halt=halt, control=control)
    return _BodiesLast(method, run, layout, constants)


def _run_bodies(keep: bool, *bodies: Any) -> Arrays:
    """Run all bodies; return the saved states, the packed end and, to `keep` it, the record."""
    method, run, layout, constants = _with_bodies_last(*bodies)
    record = None
    if keep or (run.between.shape[0] and layout.bodies):
        between, end, record = record_run(method, constants, run)
    elif run.between.shape[0]:
        between, end = run_one(method, constants, run)
    else:
        between, end = run.y0[None][:0], loop_at_end(method, constants, run)
    return [between, *pack_loop(end), *jax.tree.leaves(record if keep else None)]


# A pair of lists of truth values. The first says of each constant whether it has a tangent; the
# second says the same of each array of a run.
HasTangent = tuple[list[bool], list[bool]]


class _RunAndTangents(NamedTuple):
    """Hold the recorded run of all bodies, and the tangents or cotangents along it."""

    method: Method  # its field takes only the constants below
    constants: Arrays  # those that have a tangent, with one copy for each body
    run: Run
    record: Record
    along: Arrays  # the tangents of the inputs, or the cotangents of the results


def _recorded_run(
    has_tangent: HasTangent, method: Method, trees: tuple[Any, Any], layout: Layout,
    constants: Arrays, arrays_of_bodies: Arrays,
) -> _RunAndTangents:  # fmt: skip
    """Return the recorded run whose own arrays, those of its record, and the tangents or cotangents
    are joined in `arrays_of_bodies`.
    """
    whole, one = trees[0].num_leaves, method.field
    method, run, layout, constants = _with_bodies_last(
        method, trees, layout, constants, arrays_of_bodies[:whole]
    )
    size = len(jax.eval_shape(pack_loop, loop_at_start(run)))
    starts, (rows, counts, *along) = (
        arrays_of_bodies[whole : whole + size],
        arrays_of_bodies[whole + size :],
    )
    there = has_tangent[0][: len(constants)]
    layout, constants = layout.broadcast(constants, there, run.t0)
    field = layout.vmap(one)

    def of_moving(chosen: Arrays, t: Array, y: Array) -> Array:
        return field(with_replacements(constants, there, chosen), t, y)

    chosen = [c for c, m in zip(constants, there, strict=True) if m]
    return _RunAndTangents(
        method._replace(field=of_moving), chosen, run, Record(starts, rows, counts), along
    )


def _push(has_tangent: HasTangent, *bodies: Any) -> Arrays:
    """Return the tangents of the states of a recorded run (see `Replayed`), in forward mode."""
    method, chosen, run, record, along = _recorded_run(has_tangent, *bodies)
    smooth = Smooth(run.t0, run.stops, run.between, run.y0)
    zeros = [jnp.zeros_like(a) for a in smooth]
    of_run = Smooth(*with_replacements(zeros, has_tangent[1][:SMOOTH], along[len(chosen) :]))

    def again(chosen: Arrays, smooth: Smooth) -> Any:
        return adjoint.replay(method, chosen, run._replace(**smooth._asdict()), record)

    return list(jax.jvp(again, (chosen, smooth), (along[: len(chosen)], of_run))[1])


def _pull(has_tangent: HasTangent, *bodies: Any) -> Arrays:
    """Return the cotangents of the inputs of a recorded run, in reverse mode."""
    _, moving = has_tangent
    total, of_run = adjoint.pull_run(*_recorded_run(has_tangent, *bodies), any(moving[:3]))
    return [*total, *(a for a, moves in zip(of_run, moving, strict=False) if moves)]
