"""A run as one function of numbers, with derivatives of both modes, for one body or a batch."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero, zero_from_primal
from jaxtyping import Array

from rigidjax.solve import adaptive_loop, adjoint
from rigidjax.solve.adaptive_loop import LoopState, Method, Record, Run
from rigidjax.solve.adjoint import Smooth
from rigidjax.solve.batching import Arrays, Layout, in_lanes
from rigidjax.solve.linear_map import linear_map, refuse

SMOOTH = len(Smooth._fields)


def states_of(
    method: Method, smooth: list[bool], constants: Arrays, run: Run
) -> tuple[Array, LoopState]:
    """Return the states between (K, n), NaN where the run did not get, and the end of the loop.

    `smooth` says which of the constants have derivatives. Those of the states and of the last state
    are by these constants and the `Smooth` numbers of the run; the lengths of steps are held.
    """
    each, run_tree = jax.tree.flatten(run)
    number, no = len(constants), jnp.zeros((), jnp.int32)
    like = adaptive_loop.start(run)
    tree = jax.tree.structure((no, like, Record(like, no, no, no)))
    between, end, record = tree.unflatten(range(tree.num_leaves))
    # The results that have derivatives, and those that the value has.
    states = [between, end.y, record.starts.y, record.rows]
    head = tree.num_leaves - len(jax.tree.leaves(record))

    def mapped(program: Any, linear: int, *args: Any) -> Arrays:
        call = partial(program, method, run_tree)
        return in_lanes(call, list(args[:number]), list(args[number:]), linear)

    answer: Any = jax.custom_jvp(partial(mapped, partial(_forward, False), 0))
    recorded: Any = jax.custom_jvp(partial(mapped, partial(_forward, True), 0))

    def tangents_of(primals: Any, tangents: Any, pull: Any = None) -> tuple[Arrays, Arrays]:
        """Return the result of `recorded` and the tangents of its states; transposed by `pull`."""
        # A number without a tangent needs no derivative.
        there = [not isinstance(t, SymbolicZero) for t in tangents]
        of_run = [t and i < SMOOTH for i, t in enumerate(there[number:])]
        moving = [s and t for s, t in zip(smooth, there[:number], strict=True)], of_run
        along = [t for t, m in zip(tangents, [*moving[0], *moving[1]], strict=True) if m]
        found = recorded(*primals)
        held = tree.unflatten(found)[2]
        push = partial(mapped, partial(_pushed, moving), len(along))
        given = [*primals, *jax.tree.leaves(held)]
        if pull is None:
            return found, linear_map(push, refuse, given, along)
        # The states between and at the end alone are transposed.
        back = partial(mapped, partial(pull, moving), 2)
        return found, linear_map(lambda *args: push(*args)[:2], back, given, along)

    def with_zeros(found: Arrays, moved: Arrays) -> tuple[Arrays, Arrays]:
        along = [zero_from_primal(a) for a in found]
        for i, tangent in zip(states, moved, strict=False):
            along[i] = tangent
        return found, along

    def of_answer(primals: Any, tangents: Any) -> Any:
        found, moved = tangents_of(primals, tangents, _pulled)
        return with_zeros(found[:head], moved)

    def of_record(primals: Any, tangents: Any) -> Any:
        return with_zeros(*tangents_of(primals, tangents))

    answer.defjvp(of_answer, symbolic_zeros=True)
    recorded.defjvp(of_record, symbolic_zeros=True)
    between, *end = answer(*constants, *each)
    return between, jax.tree.structure(like).unflatten(end)


def _over_bodies(method: Method, layout: Layout, constants: Arrays) -> Method:
    """Return the method on (n, *bodies); that of one body has `halt(constants, t, y)`."""
    halt = None if method.halt is None else partial(layout.over(method.halt), constants)
    project = jax.vmap(method.project, -1, -1) if layout.bodies else method.project
    return method._replace(field=layout.over(method.field), project=project, halt=halt)


def _forward(
    record: bool, method: Method, tree: Any, layout: Layout, constants: Arrays, each: Arrays
) -> Arrays:
    """Return the states between and the end, with the `record` if asked for."""
    method, run = _over_bodies(method, layout, constants), tree.unflatten(each)
    if record:
        return jax.tree.leaves(adaptive_loop.recording(method, constants, run))
    if not run.between.shape[0]:
        return [run.y0[None][:0], *jax.tree.leaves(adaptive_loop.value(method, constants, run))]
    if layout.bodies:
        return jax.tree.leaves(adaptive_loop.recording(method, constants, run)[:2])
    return jax.tree.leaves(adaptive_loop.states_of_one(method, constants, run))


# Which of the constants and which numbers of a run have tangents.
Moving = tuple[list[bool], list[bool]]


def _again(
    moving: Moving, method: Method, tree: Any, layout: Layout, constants: Arrays, each: Arrays
) -> tuple[Method, Arrays, Run, Record, Arrays]:
    """Return a recorded run, the constants that move, one a body; and tangents or cotangents."""
    run = tree.unflatten(each[: tree.num_leaves])
    like = adaptive_loop.start(run)
    held = jax.tree.structure(Record(like, *like[:3]))
    whole = tree.num_leaves + held.num_leaves
    record = held.unflatten(each[tree.num_leaves : whole])
    layout, constants = layout.broadcast_to_bodies(constants, moving[0], run.t0)
    method = _over_bodies(method, layout, constants)

    def of_moving(chosen: Arrays, t: Array, y: Array) -> Array:
        rest = iter(chosen)
        mixed = [next(rest) if m else c for c, m in zip(constants, moving[0], strict=True)]
        return method.field(mixed, t, y)

    chosen = [c for c, m in zip(constants, moving[0], strict=True) if m]
    return method._replace(field=of_moving), chosen, run, record, each[whole:]


def _pushed(
    moving: Moving, method: Method, tree: Any, layout: Layout, constants: Arrays, each: Arrays
) -> Arrays:
    """Return the tangents of the states; `each` ends with those of the moving numbers."""
    method, chosen, run, record, along = _again(moving, method, tree, layout, constants, each)
    rest = iter(along[len(chosen) :])
    smooth = Smooth(*run[:SMOOTH])
    still = zip(smooth, moving[1], strict=False)
    of_run = Smooth(*(next(rest) if moves else jnp.zeros_like(a) for a, moves in still))

    def again(chosen: Arrays, smooth: Smooth) -> Any:
        now = run._replace(**smooth._asdict())
        return adjoint.replay_steps(method, chosen, now, record)

    return list(jax.jvp(again, (chosen, smooth), (along[: len(chosen)], of_run))[1])


def _pulled(
    moving: Moving, method: Method, tree: Any, layout: Layout, constants: Arrays, each: Arrays
) -> Arrays:
    """Return the cotangents of the moving numbers; `each` ends with those of the states."""
    method, chosen, run, record, bars = _again(moving, method, tree, layout, constants, each)
    total, of_run = adjoint.cotangents(method, chosen, run, record, bars, any(moving[1][:3]))
    return [*total, *(a for a, moves in zip(of_run, moving[1], strict=False) if moves)]
