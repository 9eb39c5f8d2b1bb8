"""Define a run as one function of arrays, which has derivatives in forward and in reverse mode.

The function runs one body or, under `jax.vmap`, a batch of bodies.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_derivatives import SymbolicZero, zero_from_primal
from jaxtyping import Array

from rigidjax.solve import adaptive_loop, adjoint
from rigidjax.solve.adaptive_loop import LoopState, Method, Record, Run
from rigidjax.solve.adjoint import Smooth
from rigidjax.solve.batching import Arrays, Layout, run_with_bodies_last
from rigidjax.solve.linear_map import linear_map, raise_for_missing_transpose

SMOOTH = len(Smooth._fields)


def run_with_replayed_derivatives(
    method: Method, smooth: list[bool], constants: Arrays, controller_states: Any, run: Run
) -> tuple[Array, LoopState]:
    """Run one body, with derivatives that repeat the recorded steps of the run.

    **Returns** two things: the states (K, n) at the K saved times `run.between`, and the state of
    the loop over the steps at the end of the run. Each state has n numbers, which are NaN at times
    that the run did not reach. The states have derivatives with respect to two kinds of inputs: the
    constants that `smooth` selects; and four arrays of `run`, which are the time and the state at
    the start, the saved times, and the stops (the times at which the field jumps, and the end of
    the run). The derivatives hold the lengths of the steps constant.

    **Arguments:**

    - `method`: the tableau of the Runge–Kutta method, and the functions of the run of one body: the
      vector field, the condition that ends the run, and the step control.
    - `smooth`: for each of the `constants`, whether it has derivatives.
    - `constants`: the arrays that the field, the condition and the step control hold.
    - `controller_states`: the states of step controller and progress meter at the start; all bodies
      of a batch may share them.
    - `run`: the arrays of the run of one body: its times and its state at the start.
    """
    arrays_of_bodies, run_tree = jax.tree.flatten(run)
    first, state_tree = jax.tree.flatten(controller_states)
    number, smooth = len(constants) + len(first), [*smooth, *(False for _ in first)]
    like = adaptive_loop.initial_loop_state(run._replace(state=controller_states))
    shapes = jax.eval_shape(adaptive_loop.pack_loop_state, like)
    trees = run_tree, state_tree
    # The function `recorded` below runs the bodies, and returns a list of arrays: the states at the
    # saved times; the state of the loop over the steps at the end, packed into `size` arrays; and
    # the record of the steps, which is divided into segments. The record is `size` arrays for the
    # states of the loop at the starts of the segments, one array for the rows (one row for each
    # step) and one for the counts of segments and rows. `states` are the indices of the arrays in
    # the list that have derivatives. The function `answer` below makes no record, and returns only
    # the first `head` arrays of the list.
    size = len(shapes)
    states, head = [0, 1, 1 + size, 1 + 2 * size], 1 + size

    def mapped(program: Any, linear: int, *args: Any) -> Arrays:
        call = partial(program, method, trees)
        return run_with_bodies_last(call, list(args[:number]), list(args[number:]), linear)

    answer: Any = jax.custom_jvp(partial(mapped, partial(_run_bodies, False), 0))
    recorded: Any = jax.custom_jvp(partial(mapped, partial(_run_bodies, True), 0))

    def results_and_tangents(
        primals: Sequence[Any],
        tangents: Sequence[Any],
        cotangents_of_inputs: Callable[..., Arrays] | None = None,
    ) -> tuple[Arrays, Arrays]:
        """Return a list of the results and the record of a run, and the tangents of its states.

        The results are the states at the saved times and the state of the loop over the steps at
        the end. The record holds the steps, so that derivatives can repeat them. The tangents are
        those of the states at the saved times and of the state at the end and, if
        `cotangents_of_inputs` is `None`, also those of the states in the record.

        - `primals`: the inputs of the run, of which its constants are the first.
        - `tangents`: the tangents of the inputs; a symbolic zero for an input without a tangent.
        - `cotangents_of_inputs`: the function that computes the cotangents of the inputs in reverse
          mode. If it is `None`, reverse mode raises an error.
        """
        # `there` says of each input whether it has a tangent. Derivatives with respect to the other
        # inputs are not computed.
        there = [not isinstance(t, SymbolicZero) for t in tangents]
        of_run = [t and i < SMOOTH for i, t in enumerate(there[number:])]
        has_tangent = [s and t for s, t in zip(smooth, there[:number], strict=True)], of_run
        along = [t for t, m in zip(tangents, [*has_tangent[0], *has_tangent[1]], strict=True) if m]
        found = recorded(*primals)
        push = partial(mapped, partial(_tangents_of_states, has_tangent), len(along))
        given = [*primals, *found[head:]]
        if cotangents_of_inputs is None:
            return found, linear_map(push, raise_for_missing_transpose, given, along)
        # Reverse mode takes only the first two results of `push`: the tangents of the states at the
        # saved times, and those of the state at the end.
        back = partial(mapped, partial(cotangents_of_inputs, has_tangent), 2)
        return found, linear_map(lambda *args: push(*args)[:2], back, given, along)

    def with_zeros(found: Arrays, moved: Arrays) -> tuple[Arrays, Arrays]:
        along = [zero_from_primal(a) for a in found]
        for i, tangent in zip(states, moved, strict=False):
            along[i] = tangent
        return found, along

    def of_answer(primals: Any, tangents: Any) -> Any:
        found, moved = results_and_tangents(primals, tangents, _cotangents_of_inputs)
        return with_zeros(found[:head], moved)

    def of_record(primals: Any, tangents: Any) -> Any:
        return with_zeros(*results_and_tangents(primals, tangents))

    answer.defjvp(of_answer, symbolic_zeros=True)
    recorded.defjvp(of_record, symbolic_zeros=True)
    between, *end = answer(*constants, *first, *arrays_of_bodies)
    return between, adaptive_loop.unpack_loop_state(end, like)


def _batch_method_over_bodies(
    method: Method,
    trees: tuple[Any, Any],
    layout: Layout,
    constants: Arrays,
    arrays_of_bodies: Arrays,
) -> tuple[Method, Run, Layout, Arrays]:
    """Convert a method for one body to a method for arrays whose last axis runs over the bodies.

    A method holds the functions of a run: the field, the condition that ends the run, and the step
    control. If there is only one body, the arrays have no axis for bodies.

    **Arguments:**

    - `method`: the method of one body. Two of its functions take the constants as an argument:
      `halt(constants, t, y)`, the condition that ends the run, and `control(again, constants, …)`,
      the step control, where `again` says whether a recorded step is repeated for a derivative.
    - `trees`: a pair of tree structures. The first makes a `Run` (the arrays with which a run
      starts) from a list of its arrays; the second makes the states of step controller and progress
      meter from theirs.
    - `layout`: which arrays have a last axis that runs over the bodies.
    - `constants`: the arrays that the functions of the method hold, then the states of controller
      and progress meter at the start.
    - `arrays_of_bodies`: the arrays of a `Run`, in which each body has values of its own.

    **Returns** four things: the method for bodies, whose `halt` and `control` already hold the
    constants; the run, which now holds the states of controller and progress meter; the layout of
    the remaining constants; and these constants, from which the states were removed.
    """
    run_tree, state_tree = trees
    run, count = run_tree.unflatten(arrays_of_bodies), len(constants) - state_tree.num_leaves
    state = layout.broadcast_to_bodies(
        constants, [i >= count for i in range(len(constants))], run.t0
    )
    run = run._replace(state=state_tree.unflatten(state[1][count:]))
    constants, layout = constants[:count], layout._replace(shared=layout.shared[:count])
    held, one = lax.stop_gradient(constants), method.control
    halt = None if method.halt is None else partial(layout.vmap_over_bodies(method.halt), held)

    def control(again: bool, *numbers: Any) -> Any:
        return layout.vmap_over_bodies(partial(one, again))(held, *numbers)

    project = jax.vmap(method.project, -1, -1) if layout.bodies else method.project
    field = layout.vmap_over_bodies(method.field)
    method = method._replace(field=field, project=project, halt=halt, control=control)
    return method, run, layout, constants


def _run_bodies(
    return_record: bool,
    method: Method,
    trees: tuple[Any, Any],
    layout: Layout,
    constants: Arrays,
    arrays_of_bodies: Arrays,
) -> Arrays:
    """Run all bodies, and return the arrays of the result as one list.

    **Arguments:**

    - `return_record`: whether the record of the steps is returned, too.
    - `method`: the explicit Runge–Kutta method, the field and the step control of the run of one
      body.
    - `trees`: a pair of tree structures. The first makes a `Run` (the arrays with which a run
      starts) from a list of its arrays; the second makes the states of step controller and progress
      meter from theirs.
    - `layout`: which arrays have a last axis that runs over the bodies.
    - `constants`: the arrays that the functions of the method hold, then the states of controller
      and progress meter at the start.
    - `arrays_of_bodies`: the arrays of a `Run`, in which each body has values of its own.

    **Returns** a list of arrays: the states at the saved times; the state of the loop over the
    steps at the end; and, if `return_record` is true, the record of the steps.
    """
    method, run, _, constants = _batch_method_over_bodies(
        method, trees, layout, constants, arrays_of_bodies
    )
    kept = None
    if return_record or (run.between.shape[0] and layout.bodies):
        between, end, kept = adaptive_loop.record_run(method, constants, run)
    elif run.between.shape[0]:
        between, end = adaptive_loop.run_one_body(method, constants, run)
    else:
        between, end = run.y0[None][:0], adaptive_loop.loop_state_at_end(method, constants, run)
    return [
        between,
        *adaptive_loop.pack_loop_state(end),
        *jax.tree.leaves(kept if return_record else None),
    ]


# A pair of lists of truth values. The first says of each constant whether it has a tangent; the
# second says the same of each array of a run.
HasTangent = tuple[list[bool], list[bool]]


def _unpack_recorded_run(
    has_tangent: HasTangent,
    method: Method,
    trees: tuple[Any, Any],
    layout: Layout,
    constants: Arrays,
    arrays_of_bodies: Arrays,
) -> tuple[Method, Arrays, Run, Record, Arrays]:
    """Return what is needed to differentiate the run of all bodies whose steps were recorded.

    **Arguments:**

    - `has_tangent`: which constants, and which arrays of the run, have a tangent.
    - `method`: the explicit Runge–Kutta method, the field and the step control of the run of one
      body.
    - `trees`: a pair of tree structures. The first makes a `Run` (the arrays with which a run
      starts) from a list of its arrays; the second makes the states of step controller and progress
      meter from theirs.
    - `layout`: which arrays have a last axis that runs over the bodies.
    - `constants`: the arrays that the functions of the method hold, then the states of controller
      and progress meter at the start.
    - `arrays_of_bodies`: a list of the arrays of the run, then those of its record, then, in
      forward mode, the tangents of the inputs or, in reverse mode, the cotangents of the results.

    **Returns** five things: the method for bodies; the constants; the run; its record; and the
    tangents or cotangents. Only the constants that have a tangent are returned, with one copy for
    each body; the field of the returned method takes only these constants.
    """
    whole = trees[0].num_leaves
    one = method.field
    method, run, layout, constants = _batch_method_over_bodies(
        method, trees, layout, constants, arrays_of_bodies[:whole]
    )
    starts = len(
        jax.eval_shape(adaptive_loop.pack_loop_state, adaptive_loop.initial_loop_state(run))
    )
    *kept, rows, counts = arrays_of_bodies[whole : whole + starts + 2]
    there = has_tangent[0][: len(constants)]
    layout, constants = layout.broadcast_to_bodies(constants, there, run.t0)
    field = layout.vmap_over_bodies(one)

    def of_moving(chosen: Arrays, t: Array, y: Array) -> Array:
        rest = iter(chosen)
        mixed = [next(rest) if m else c for c, m in zip(constants, there, strict=True)]
        return field(mixed, t, y)

    chosen = [c for c, m in zip(constants, there, strict=True) if m]
    record, bars = Record(kept, rows, counts), arrays_of_bodies[whole + starts + 2 :]
    return method._replace(field=of_moving), chosen, run, record, bars


def _tangents_of_states(
    has_tangent: HasTangent,
    method: Method,
    trees: tuple[Any, Any],
    layout: Layout,
    constants: Arrays,
    arrays_of_bodies: Arrays,
) -> Arrays:
    """Return the tangents of the states of a run whose steps were recorded, in forward mode.

    The states are those at the saved times, the one at the end of the run, and those in the record
    of the steps.

    - `has_tangent`: two lists of truth values: which constants, and which arrays of the run, have a
      tangent.
    - `method`: the explicit Runge–Kutta method, the field and the step control of the run of one
      body.
    - `trees`: a pair of tree structures. The first makes a `Run` (the arrays with which a run
      starts) from a list of its arrays; the second makes the states of step controller and progress
      meter from theirs.
    - `layout`: which arrays have a last axis that runs over the bodies.
    - `constants`: the arrays that the functions of the method hold, then the states of controller
      and progress meter at the start.
    - `arrays_of_bodies`: the arrays of the run, then those of its record, then the tangents of
      the constants and arrays that `has_tangent` selects.
    """
    method, chosen, run, record, along = _unpack_recorded_run(
        has_tangent, method, trees, layout, constants, arrays_of_bodies
    )
    rest = iter(along[len(chosen) :])
    smooth = adjoint.arrays_with_derivatives(run)
    still = zip(smooth, has_tangent[1], strict=False)
    of_run = Smooth(*(next(rest) if moves else jnp.zeros_like(a) for a, moves in still))

    def again(chosen: Arrays, smooth: Smooth) -> Any:
        now = run._replace(**smooth._asdict())
        return adjoint.replay_steps(method, chosen, now, record)

    return list(jax.jvp(again, (chosen, smooth), (along[: len(chosen)], of_run))[1])


def _cotangents_of_inputs(
    has_tangent: HasTangent,
    method: Method,
    trees: tuple[Any, Any],
    layout: Layout,
    constants: Arrays,
    arrays_of_bodies: Arrays,
) -> Arrays:
    """Return the cotangents of the inputs of a run whose steps were recorded, in reverse mode.

    The inputs are the constants and the arrays of the run.

    - `has_tangent`: two lists of truth values: which constants, and which arrays of the run, get a
      cotangent.
    - `method`: the explicit Runge–Kutta method, the field and the step control of the run of one
      body.
    - `trees`: a pair of tree structures. The first makes a `Run` (the arrays with which a run
      starts) from a list of its arrays; the second makes the states of step controller and progress
      meter from theirs.
    - `layout`: which arrays have a last axis that runs over the bodies.
    - `constants`: the arrays that the functions of the method hold, then the states of controller
      and progress meter at the start.
    - `arrays_of_bodies`: the arrays of the run, then those of its record, then two cotangents:
      that of the states at the saved times, and that of the state at the end of the run.
    """
    method, chosen, run, record, bars = _unpack_recorded_run(
        has_tangent, method, trees, layout, constants, arrays_of_bodies
    )
    total, of_run = adjoint.cotangents_of_run(
        method, chosen, run, record, bars, any(has_tangent[1][:3])
    )
    return [*total, *(a for a, moves in zip(of_run, has_tangent[1], strict=False) if moves)]
