"""Estimate the error of a run by a second, more accurate run and three slightly changed runs.

The error of the *steps* is the distance of the states from the states of a second run. The second
run has a fiftieth of the tolerance or, with equal steps, half of the step.

The error of *round-off* is three standard deviations over four runs: the run itself and three
neighbours. A neighbour is a run whose inputs (body, torque and initial state) differ from the
inputs of the run by about a unit in the last digit. The neighbours round differently, and the
differences between them grow as rounding errors do.
"""

import dataclasses
import inspect
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from rigidjax import _checks, _show
from rigidjax._types import ScalarLike
from rigidjax.motion.manifold import leaf_names, minus, parts_by_name
from rigidjax.solve.answer import difference, validation
from rigidjax.solve.answer.peaks import times_of_peaks
from rigidjax.solve.answer.run import AnyRun, DiffraxRun, solve
from rigidjax.solve.programs.linear_map import with_derivatives

# The error of a run is measured by a second, more accurate run. This number is the tolerance of the
# second run divided by the tolerance of the first. With this value the second run of a method of
# order 8 takes 1.6 times as many steps as the first.
_CLOSER = 2e-2
# No step of the second run is longer than this part of the run. A step is at most ten times as long
# as the step before it: in a run of a few steps this limit, and not the tolerance, sets the lengths
# of the steps, and the second run would otherwise take the same steps as the first.
_PARTS = 8
# The round-off of a run is measured by its neighbours: runs whose inputs differ from those of the
# run in the last digit. These two numbers are the number of neighbours, and the number of standard
# deviations that are reported as the error. Three standard deviations over four runs (the run and
# three neighbours) exceed half of the true error in all but a few of a thousand cases.
_NEIGHBOURS, _DEVIATIONS = 3, 3.0
# In float64 the neighbours (runs with inputs changed in the last digit, which show the round-off of
# a run) are run at a larger tolerance, so that they take fewer steps: at the square root of the
# tolerance of the run whose error is wanted, but at `_LOOSE` at most. If a run at the larger
# tolerance is farther than `_NEAR` from the run whose error is wanted, errors grow along the two
# runs in different ways. The larger tolerance is then multiplied by `_FARTHEST`, again if
# necessary.
_LOOSE, _NEAR, _FARTHEST = 1e-4, 0.03, 1e-3
# A state counts as lost if its error is above half a radian, or above half of the largest value in
# the run: an error so large no longer grows in proportion to the error before it.
_LOST = 0.5
# The smallest size, in SI units, to which the error of an array is compared: an array whose values
# are smaller need not be known to all digits. It is the ratio of the default `atol` to the default
# `rtol`.
_SMALL = 1e-3
# One "rounding" is the relative rounding error of the dtype. A "neighbour" is a run with inputs
# changed in the last digit, by which the round-off of a run is measured. Errors of steps and
# rounding errors grow alike along most motions. If the errors of the steps are much larger from the
# beginning, one neighbour is then enough to show that round-off can be neglected. Near an unstable
# rotation the two kinds of errors do not grow alike: the nearer the motion is to the rotation, the
# smaller are the errors of the steps, but the rounding errors stay as they are.
#
# After the first neighbour no other is run if two conditions hold: the tolerance is above `_COARSE`
# roundings; and the error of the steps is above `_CLEAR` times each of two bounds of round-off. The
# first bound is `_ABOVE` times the round-off of all steps as it would be without growth. The second
# bound is `_ABOVE_ONE` times `_DEVIATIONS` times the change that the first neighbour shows. The
# larger bound is then reported as the error of round-off.
#
# The steps of a function given to `error_of` are not known: there no neighbour is run at all if the
# tolerance is above `_COARSE` roundings and the error of the steps is above `_PLAIN` roundings of
# each result.
_ABOVE, _ABOVE_ONE, _CLEAR, _PLAIN, _COARSE = 100.0, 10.0, 3.0, 1e6, 1e5
# `simulate(…, accuracy=…)` searches for a tolerance at which a run is as accurate as wanted. The
# search starts with a run at the tolerance `_FIRST`, which takes n steps. In 500 motions the error
# at a tolerance was n^1.5 / 35 times the tolerance, within a factor of six. The second run aims at
# `_NEXT` times the wanted accuracy; if the first run is too far off to measure its error (more than
# `_FAR`), at `_SECOND` times, since the error of the second run is then measured by a third.
# Where the tolerance changes, the error changes in proportion within a factor of `_ALLOWED` (98 of
# 100 motions): a predicted error is multiplied by it. The search aims at the wanted accuracy
# divided by `_AIM`.
#
# In three cases the error is not proportional to the tolerance: if the error is above `_FORESEEN`
# (0.1 rad); if the run has fewer than `_FEW` steps; and if the number of steps grew from the run
# before by less than `_GROWTH` times the factor that the order of the method implies. The measured
# error is then not used, and the next run has a hundredth of the tolerance.
_FIRST, _NEXT, _FAR, _SECOND, _ALLOWED, _AIM = 3e-5, 0.1, 0.01, 20.0, 6.0, 1.25
_FORESEEN, _FEW, _GROWTH = 0.1, 8, 0.6
# The smallest tolerance, as a multiple of the relative rounding error of the dtype: `_FLOOR` in the
# search for a tolerance, and `_DEEPEST` for a run that serves for comparison only.
_FLOOR, _DEEPEST = 20.0, 4.0


class Error(eqx.Module):
    """Hold the distance of each array of a state from the exact motion: `Solution.error`.

    The exact motion is the solution without any error for the given body, torque and initial state.

    **Fields:**

    - `ts`: (T,) the times of the states, s.
    - `steps`: the error of the steps, one array (T,) for each name (`q`, `omega`, `x`, `v`,
      `own.0`, …). For a quaternion it is the angle of the turn, rad; for other arrays it is the
      length of the difference (rad/s, m, m/s). This error is accurate to some percent; after
      `simulate(…, accuracy=…)` it is too large by a factor of about six.
    - `round_off`: the error of rounding, three standard deviations, in arrays by name as in
      `steps`. It includes the effect of the last digits of body, torque and initial state (in
      closed form also of the times). If this error is far below `steps`, only an upper bound is
      given.
    - `sizes`: for each name the scale by which its error is divided to get a relative error: 1 rad
      for a quaternion, else the largest length of the array in the run, but at least 1e-3.

    `steps` and `round_off` are NaN at times that the run did not reach. They are inf at times that
    the run reached, but not the runs with which it is compared.

    >>> body, start = rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Spin([0.0, 1.0, 0.01])
    >>> error = rj.simulate(body, start, [0.0, 1.0, 20.0]).error
    >>> bool(error.total["omega"][-1] < 1e-13), float(error.known_until)
    (True, 20.0)
    """

    ts: Float[Array, " times"]
    steps: dict[str, Float[Array, " times"]]
    round_off: dict[str, Float[Array, " times"]]
    sizes: dict[str, Float[Array, ""]]

    def __repr__(self) -> str:
        if not _checks.is_known(self) or np.ndim(self.ts) != 1:
            return eqx.tree_pformat(self)
        last = ", ".join(f"{name} {float(part[-1]):.1e}" for name, part in self.total.items())
        times, t = (self.ts[-1], self.known_until), np.asarray(self.ts)
        end, until = (_show.time_as_text(one, abs(t[-1] - t[0])) for one in times)
        return f"Error(at {end} s: {last}; known until {until} s)"

    @property
    def total(self) -> dict[str, Float[Array, " times"]]:
        """Return the error of steps and round-off together, for each array of a state by its name.

        It is the root of the sum of the two squares, at each of the T times. From the first time on
        at which the relative error of the state is above one half, it is infinite (see `lost`).
        """
        both = jax.tree.map(jnp.hypot, self.steps, self.round_off)
        return jax.tree.map(lambda part: jnp.where(self.lost, jnp.inf, part), both)

    @property
    def relative(self) -> Float[Array, " times"]:
        """Return the largest relative error of the state at each time (T,).

        The largest is taken over the arrays of the state (`q`, `omega`, …). For a quaternion the
        relative error is an angle, rad; for another array it is the error divided by the largest
        length of this array in the run. The result is infinite from the first time on at which it
        would be above one half (see `lost`).
        """
        return jnp.where(self.lost, jnp.inf, self._largest_relative_error)

    @property
    def lost(self) -> Bool[Array, " times"]:
        """Return for each time (T,) whether the error is so large that the state is unknown.

        The state is unknown, as it is in chaos, from the first time on at which the largest
        relative error is above one half.
        """
        return lax.associative_scan(jnp.logical_or, self._largest_relative_error > _LOST)

    @property
    def known_until(self) -> Float[Array, ""]:
        """Return the last of the times `ts` of this error at which the state is still known, s.

        The state is known before its relative error is above one half for the first time.
        """
        return self.ts[jnp.sum(~self.lost) - 1]

    @property
    def _largest_relative_error(self) -> Array:
        """Return the largest relative error of the state at each time (T,), above one half, too."""
        return _largest_relative_distance(
            jax.tree.map(jnp.hypot, self.steps, self.round_off), self.sizes
        )


class TriedRun(NamedTuple):
    """Hold one run of a search for a tolerance, which tries smaller and smaller ones."""

    rtol: Array  # (), the relative tolerance of the run
    ys: Any  # the states at the T saved times, with a leading time axis
    stats: dict[str, Array]  # the numbers of steps, as in `Solution.stats`
    result: dfx.RESULTS  # whether the run reached the end, or why not

    @property
    def accepted_steps(self) -> Array:
        """Return the number of accepted steps."""
        return self.stats["num_accepted_steps"]


class ToleranceSearch(NamedTuple):
    """Hold two of the runs that `simulate(…, accuracy=…)` tried."""

    first: TriedRun
    before_last: TriedRun


@eqx.filter_jit
def estimate_error_of_run(
    setup: Any,
    ts: Array,
    ys: PyTree,
    num_steps: Array,
    search: ToleranceSearch | None = None,
) -> Error:
    """Return an estimate of the error of a known run, at each of its saved times.

    If the run ended a `search`, the error of its steps is measured by the run before it, not by a
    more accurate run, and is too large by a factor of about six.
    """
    setup, ts, ys, num_steps, search = _without_derivatives((setup, ts, ys, num_steps, search))
    rtol, factor, others = jnp.zeros((), ts.dtype), 1.0, ys
    if search is not None:
        before = search.before_last
        rtol, others = setup.rtol, before.ys
        far = _relative_distance(others, ys) > _FORESEEN
        factor = jnp.where(far, jnp.inf, _ALLOWED * rtol / before.rtol)
    elif setup.solver is None:
        # The distance of a state from itself may be a rounding error; at times that the run did not
        # reach it stays NaN.
        factor = 0.0
    else:
        closer = _more_accurate(setup, ts, times_of_peaks(setup, ts, ys, num_steps))
        rtol, factor = closer.rtol, closer.factor
        others, *_ = solve(closer.setup, jax.tree.map(lambda leaf: leaf[0], ys), ts)
    steps = jax.tree.map(lambda part: factor * part, _distances(others, ys))
    return _error_with_round_off(setup, ts, ys, num_steps, steps, rtol, search)


def _without_derivatives(tree: PyTree) -> PyTree:
    """Return `tree`, whose arrays are constants for derivatives."""
    return jax.tree.map(lambda a: lax.stop_gradient(a) if eqx.is_array(a) else a, tree)


def _error_with_round_off(
    setup: AnyRun,
    ts: Array,
    ys: PyTree,
    num_steps: Array,
    step_errors: dict[str, Array],
    rtol: Array,
    search: ToleranceSearch | None,
) -> Error:
    """Return the error of the steps together with that of round-off, measured by neighbours.

    A neighbour is a run whose body, torque and start differ by about a unit in the last digit. With
    a `search` neighbours of one of its two runs are taken, so that no run at a larger tolerance has
    to be made.
    """
    sizes, start = _error_scales_by_name(ys), jax.tree.map(lambda leaf: leaf[0], ys)
    reached = jnp.isfinite(_relative_distance(ys, ys))
    # `plain` is `_ABOVE` times the sum of the rounding errors of n = `num_steps` steps in a motion
    # without growth of errors. In the body rate the sum is about n^0.5 relative rounding errors.
    # The angle is the sum of the body rate over n steps, and has an error of about n^1.5 of them.
    eps = float(jnp.finfo(ts.dtype).eps)
    plain = {name: _ABOVE * eps * num_steps.astype(ts.dtype) ** 1.5 * sizes[name] for name in sizes}
    coarse = rtol > _COARSE * eps
    known = _largest_relative_distance(step_errors, sizes)
    numbers, rest = eqx.partition((setup.body, setup.torque, start), eqx.is_inexact_array)
    setup, ys, more = _at_larger_tolerance(setup, start, ts, ys, num_steps, search)
    free = setup.solver is None

    def changes_of_neighbour(numbers: Any, times: Array) -> Array:
        body, torque, y0 = eqx.combine(numbers, rest)
        run = dataclasses.replace(setup, body=body, torque=torque, throw=False)
        return more * jax.vmap(minus)(solve(run, y0, times)[0], ys)

    def neighbour(clear: Array, inputs: Any) -> tuple[Array, tuple[Array, dict[str, Array]]]:
        number, near, later = inputs
        # A neighbour is a run with inputs changed in the last digit. If the first neighbour has
        # shown that the round-off is small (`clear`), all times of the next ones are set to the
        # first time, so that they take no step.
        changes = changes_of_neighbour(near, jnp.where(clear, ts[0], ts * later))
        shown = _lengths_of_changes_by_name(start, _DEVIATIONS * _ABOVE_ONE * changes)
        bounds = {name: jnp.maximum(plain[name], shown[name]) for name in sizes}
        above = known > _CLEAR * _largest_relative_distance(bounds, sizes)
        small = coarse & jnp.all((above | ~reached)[1:])
        return jnp.where(number == 0, small, clear), (changes, shown)

    rng = np.random.default_rng(0)
    near = jax.tree.map(
        lambda leaf: _copies_changed_in_last_digit(leaf, rng, jnp.abs(leaf)), numbers
    )
    # The closed form computes the angle of rotation without steps and rounds it only once, so that
    # the runs with changed inputs may get the same rounded angle. In closed form their times are
    # therefore changed, too.
    later = jnp.asarray(1.0 + eps * free * np.array([1.0, -1.0, 1.0]), ts.dtype)
    inputs = jnp.arange(_NEIGHBOURS), near, later
    # The neighbours (runs with changed inputs) are run one after another: a batch of them would
    # take no less time, and the first neighbour may show that the others are not needed.
    clear, (changes, shown) = lax.scan(neighbour, jnp.asarray(False), inputs)
    off = _lengths_of_changes_by_name(
        start, _DEVIATIONS * jnp.sqrt(_variance_over_neighbours(changes))
    )
    off = {name: jnp.where(clear, shown[name][0], off[name]) for name in off}

    step_errors, off = jax.tree.map(
        lambda part: jnp.where(reached, jnp.where(jnp.isnan(part), jnp.inf, part), jnp.nan),
        (step_errors, off),
    )
    return Error(ts, step_errors, off, sizes)


class _RunForRoundOff(NamedTuple):
    """Hold a run by which the round-off of a given run is measured."""

    setup: Any
    ys: PyTree
    factor: float | Array  # the round-off of the given run over that of this run


def _at_larger_tolerance(
    setup: Any,
    start: PyTree,
    ts: Array,
    ys: PyTree,
    num_steps: Array,
    search: ToleranceSearch | None,
) -> _RunForRoundOff:
    """Return a run with a larger tolerance and fewer steps, whose states are still near `ys`.

    If the given run takes k times as many steps, its round-off would be √k times as large if all
    came from the steps, and the same if all came from the last digits of the inputs; the fourth
    root of k is between the two. While the states stay near `ys`, both grow in the same way.

    The given run itself is returned in float32, where it takes few steps anyway, in closed form,
    and if it does not record its steps.
    """
    if not setup.replays or ts.dtype == jnp.float32:
        return _RunForRoundOff(setup, ys, 1.0)

    def is_near(run: TriedRun) -> Array:
        unreached = jnp.isnan(_relative_distance(ys, ys))
        return jnp.all((_relative_distance(run.ys, ys) <= _NEAR) | unreached)

    def closer(run: TriedRun) -> TriedRun:
        return _run_at_tolerance(setup, start, ts, jnp.maximum(_FARTHEST * run.rtol, setup.rtol))

    if search is None:
        loosest = jnp.maximum(setup.rtol, jnp.minimum(jnp.sqrt(setup.rtol), _LOOSE)) / _FARTHEST
        run = lax.while_loop(
            lambda run: ~(is_near(run) | (run.rtol <= setup.rtol)),
            closer,
            _placeholder_run(setup, start, ts, loosest),
        )
    else:
        near = is_near(search.first)
        run = jax.tree.map(lambda first, last: jnp.where(near, first, last), *search)
        if setup.cuts is not None:  # the first run was made before the peaks were known
            setup = dataclasses.replace(setup, cuts=jnp.where(near, ts[0], setup.cuts))
    fewer = jnp.maximum(run.accepted_steps, 1)
    setup = _with_tolerance(setup, run.rtol)
    factor = (jnp.maximum(num_steps / fewer, 1.0) ** 0.25).astype(ts.dtype)
    return _RunForRoundOff(setup, run.ys, factor)


def _run_at_tolerance(setup: DiffraxRun, state0: PyTree, ts: Array, rtol: Array) -> TriedRun:
    """Return the run of a set-up at the relative tolerance `rtol`."""
    rtol = jnp.asarray(rtol, ts.dtype)
    return TriedRun(rtol, *solve(_with_tolerance(setup, rtol), state0, ts))


def _placeholder_run(setup: DiffraxRun, state0: PyTree, ts: Array, rtol: Array) -> TriedRun:
    """Return a run of no steps with states NaN, with which a loop over runs begins."""
    run = eqx.filter_eval_shape(_run_at_tolerance, setup, state0, ts, rtol)

    def empty(leaf: Any) -> Array:
        inexact = jnp.issubdtype(leaf.dtype, jnp.inexact)
        return jnp.full(leaf.shape, jnp.nan if inexact else 0, leaf.dtype)

    return jax.tree.map(empty, run)._replace(rtol=jnp.asarray(rtol, ts.dtype))


def _distances(others: PyTree, ys: PyTree) -> dict[str, Array]:
    """Return how far the states of two runs are apart, (T,) by the name of each array.

    For a quaternion it is the angle of the turn from one to the other, rad.
    """
    return _lengths_of_changes_by_name(
        jax.tree.map(lambda leaf: leaf[0], ys), jax.vmap(minus)(others, ys)
    )


def _lengths_of_changes_by_name(state: PyTree, changes: Array) -> dict[str, Array]:
    """Return the lengths (…,) of changes (…, n) of a state, by the name of each array.

    The change of a quaternion has three numbers, a rotation vector in radians.
    """
    named = parts_by_name(state, changes).items()
    return {name.removeprefix("motion."): jnp.linalg.norm(part, axis=-1) for name, part in named}


def largest_length_in_run(array: Array) -> Array:
    """Return the largest length of an array (T, …) of states, without times that are NaN."""
    return jnp.nanmax(jnp.linalg.norm(array.reshape(array.shape[0], -1), axis=-1))


def _error_scales_by_name(ys: PyTree) -> dict[str, Array]:
    """Return the scale by which the error of each array is divided, by its name.

    It is 1 rad for a quaternion, else the largest length in the run, but at least 1e-3.
    """
    sizes = {}
    for name, leaf in zip(leaf_names(ys), jax.tree.leaves(ys), strict=True):
        name = name.removeprefix("motion.")
        most = largest_length_in_run(leaf)
        sizes[name] = jnp.ones_like(most) if name == "q" else jnp.maximum(most, _SMALL)
    return sizes


def _largest_relative_distance(distances: dict[str, Array], sizes: dict[str, Array]) -> Array:
    """Return (T,) the largest of the `distances` (T,) of all arrays, each divided by its scale."""
    return jnp.max(jnp.stack([distances[name] / sizes[name] for name in distances]), 0)


def _relative_distance(others: PyTree, ys: PyTree) -> Array:
    """Return the largest relative distance (T,) of the states of two runs; NaN if not reached."""
    return _largest_relative_distance(_distances(others, ys), _error_scales_by_name(ys))


class AccurateRun(NamedTuple):
    """Hold the run in which a search for a tolerance ended."""

    setup: DiffraxRun
    solved: Any  # what `solve` returns for it
    search: ToleranceSearch


@eqx.filter_jit
def solve_to_accuracy(setup: DiffraxRun, state0: PyTree, ts: Array, accuracy: Array) -> AccurateRun:
    """Solve a run at a tolerance at which its global error is below `accuracy`, if there is one.

    The distance of each run from the run before, at a larger tolerance, is about the error of the
    run before; the error of the new run is estimated from it, in proportion to the two tolerances.
    If even the smallest tolerance is not enough, its run is returned.
    """
    still = _without_derivatives((setup, state0, ts, accuracy))
    floor = _FLOOR * float(jnp.finfo(ts.dtype).eps)
    quiet = dataclasses.replace(still[0], throw=False)
    first_rtol = jnp.asarray(max(_FIRST, 100 * floor), ts.dtype)
    begun = _placeholder_run(quiet, still[1], ts, first_rtol)
    peaks = lambda run: times_of_peaks(quiet, ts, run.ys, run.accepted_steps)  # noqa: E731
    cuts = jnp.full(jax.eval_shape(peaks, begun).shape, ts[0])

    def closer(carry: Any) -> Any:
        number, first, _, before, rtol, cuts, ended = carry
        # In a batch, the loop goes on until the searches of all bodies have ended. A body whose
        # search has ended is run with all times equal to the first time, and takes no step.
        run = dataclasses.replace(quiet, cuts=cuts)
        new = _run_at_tolerance(run, still[1], jnp.where(ended, ts[0], ts), rtol)
        is_first = number == 0
        if cuts.size:
            cuts = lax.cond(is_first, peaks, lambda _: cuts, new)
        count, counted = new.accepted_steps.astype(ts.dtype), before.accepted_steps.astype(ts.dtype)
        off = jnp.nanmax(_relative_distance(before.ys, new.ys)[1:])
        foreseen = off < _FORESEEN
        off = _ALLOWED * off * rtol / before.rtol
        # In two cases the error of a run does not predict the error of the next run: if the error
        # is so large that it is not proportional to the tolerance; and if the tolerance does not
        # set the lengths of the steps, as in a run that ends before the steps have grown to their
        # full length.
        more = (before.rtol / rtol) ** (1 / setup.solver.tableau.order)
        sound = foreseen & (count >= _FEW) & (count >= _GROWTH * more * counted)
        # The first run may be so far off that its distance tells nothing of the second run.
        less = jnp.where((number == 1) & ~foreseen, 0.1, 0.01)
        wanted = jnp.minimum(rtol * still[3] / (_AIM * off), rtol / 3)
        wanted = jnp.where(sound, wanted, less * rtol)
        usual = count**1.5 / 35  # the error of a run, divided by its tolerance
        share = jnp.where(usual * rtol < _FAR, _NEXT, _SECOND)
        second = jnp.minimum(share * still[3] / usual, rtol / 30)
        following = jnp.maximum(jnp.where(is_first, second, wanted), floor)
        # A run that reached none of the times will reach none at a smaller tolerance either.
        none_reached = ~jnp.any(jnp.isfinite(_relative_distance(new.ys, new.ys))[1:])
        found = ~is_first & ((sound & (off <= still[3])) | (rtol <= floor))
        first = jax.tree.map(lambda a, b: jnp.where(is_first, a, b), new, first)
        return number + 1, first, before, new, following, cuts, found | none_reached

    carry = (0, begun, begun, begun, first_rtol, cuts, jnp.asarray(False))
    _, first, before, new, _, cuts, _ = lax.while_loop(lambda carry: ~carry[-1], closer, carry)
    setup = dataclasses.replace(_with_tolerance(setup, lax.stop_gradient(new.rtol)), cuts=cuts)
    run = _with_derivatives_of_solve(setup, state0, ts, new.ys), new.stats, new.result
    return AccurateRun(setup, run, ToleranceSearch(first, before))


@eqx.filter_custom_jvp
def _with_derivatives_of_solve(setup: DiffraxRun, state0: PyTree, ts: Array, ys: PyTree) -> PyTree:
    """Return the known states `ys`, with the derivatives that `solve` would give them.

    The motion is solved once more only if a derivative is taken.
    """
    return ys


@_with_derivatives_of_solve.def_jvp
def _(primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> Any:
    states = lambda *args: solve(*args)[0]  # noqa: E731
    ys, along = eqx.filter_jvp(states, primals[:3], tangents[:3])
    return with_derivatives(primals[3], ys), along


def _with_tolerance(setup: DiffraxRun, rtol: Array) -> DiffraxRun:
    """Return `setup` with the relative tolerance `rtol`, and without errors raised."""
    return dataclasses.replace(setup, rtol=rtol, atol=_SMALL * rtol, throw=False)


class _MoreAccurate(NamedTuple):
    """Hold the set-up of a run that is more accurate than a given run."""

    setup: DiffraxRun
    rtol: Array  # the relative tolerance of the given run; 0 under fixed steps
    factor: float  # the error of the given run over its distance to this one


def _more_accurate(setup: Any, ts: Array, peaks: Array) -> _MoreAccurate:
    """Return the set-up of a more accurate run, in which steps end at the `peaks` (m,) of the
    torque, s, unless they are fixed.
    """
    eps = float(jnp.finfo(ts.dtype).eps)
    most = None if setup.max_steps is None else 4 * setup.max_steps
    cuts = peaks if peaks.size else None
    setup = dataclasses.replace(setup, max_steps=most, throw=False)
    if setup.controller is None:
        rtol = jnp.asarray(setup.rtol, ts.dtype)
        less = jnp.maximum(_CLOSER * rtol, _DEEPEST * eps)
        longest = jnp.abs(ts[-1] - ts[0]) / _PARTS
        longest = longest if setup.max_step is None else jnp.minimum(longest, setup.max_step)
        new = dict(rtol=less, atol=setup.atol * (less / rtol), max_step=longest)
        return _MoreAccurate(dataclasses.replace(setup, cuts=cuts, **new), rtol, 1.0)
    pid = lambda node: isinstance(node, dfx.PIDController)  # noqa: E731
    inside: Any = lambda c: [n for n in jax.tree.leaves(c, is_leaf=pid) if pid(n)]  # noqa: E731
    if found := inside(setup.controller):
        less = jnp.maximum(_CLOSER * found[0].rtol, _DEEPEST * eps)
        both = less, found[0].atol * (less / found[0].rtol)
        where = lambda s: (inside(s.controller)[0].rtol, inside(s.controller)[0].atol)  # noqa: E731
        setup = eqx.tree_at(where, setup, both)
        setup, rtol = dataclasses.replace(setup, cuts=cuts), jnp.asarray(found[0].rtol, ts.dtype)
        return _MoreAccurate(setup, rtol, 1.0)
    if not isinstance(setup.controller, dfx.ConstantStepSize):
        raise TypeError(
            "error: a second run needs a diffrax.PIDController or ConstantStepSize, got "
            f"{type(setup.controller).__name__}"
        )
    # In a method of order 2 the run with half of the step has a quarter of the error of the given
    # run. The distance between the two runs is then 3/4 of the error of the given run. For a method
    # of higher order the factor 4/3 makes the error too large, by at most a third.
    return _MoreAccurate(dataclasses.replace(setup, dt0=0.5 * setup.dt0), jnp.zeros(()), 4 / 3)


class FunctionError(eqx.Module):
    """Hold the value and derivative of a function at x, and their errors: the result of `error_of`.

    **Fields:**

    - `value`: the value of the function at x.
    - `value_error`: the absolute error of the value, in its shape.
    - `derivative`: the derivative with respect to x, as `jax.grad` or `jax.jacfwd` returns it.
    - `derivative_error`: the absolute error of the derivative, in its shape. It includes the
      difference between the derivative and a finite difference, if that difference is significant
      (see `error_of`).

    >>> rj.error_of(lambda x, **tolerances: x * x, 3.0).known
    Array(True, dtype=bool)
    """

    value: Array
    value_error: Array
    derivative: Any
    derivative_error: Any

    def __repr__(self) -> str:
        return _show.fields_as_text(self)

    @property
    def known(self) -> Bool[Array, ""]:
        """Return whether the derivative is known: its error is shorter than half of the derivative.

        The lengths are Euclidean norms over all numbers of the error and of the derivative. If the
        derivative is not known, as in chaos, it means nothing, even if it is finite.
        """
        size = jnp.linalg.norm(ravel_pytree(self.derivative)[0])
        return jnp.linalg.norm(ravel_pytree(self.derivative_error)[0]) < _LOST * size


def error_of(
    f: Callable[..., Array],
    x: Any,
    *,
    rtol: ScalarLike | None = None,
    atol: ScalarLike | None = None,
) -> FunctionError:
    """Return the value and the derivative of a function that uses `simulate`, with their errors.

    **Arguments:**

    - `f`: a function `f(x, rtol=…, atol=…) → array`, which hands both tolerances to every
      `simulate` in it (as `**tolerances`). A value that does not depend on them, such as that of a
      closed form, has only the error of round-off.
    - `x`: numbers, or a tree of numbers, all of one dtype. The derivative is taken in reverse mode
      if the value is a scalar, else in forward mode.
    - `rtol`, `atol`: the tolerances of the value and derivative that are returned; by default those
      of `simulate`.

    The error of the steps is the distance to a second run, which has a fiftieth of these
    tolerances. If this distance is not far above round-off, and always in a `vmap`, the error of
    round-off is measured by three more runs, in which the last digits of `x` are changed. (If all
    numbers of an array are zero, they are changed by the last digit of 1.) See `Solution.error`.
    Each call compiles again: to call `error_of` often, put the call into a `jax.jit` of your own.

    Two more values are computed, one on each side of `x` in a random direction, at most 5e-7 of
    each number away (5e-4 in float32). If their difference and the derivative disagree by more than
    the uncertainty of the values, this is an error of the derivative, and a `UserWarning` says so.
    The derivative then misses the effect of a torque that switches by time or state (`jnp.where`,
    `jnp.sign`), or of a `stop_gradient`. If `f` refuses the numbers on one side of `x`, as it may
    for a flat body, only the value on the other side is used; if it refuses both sides, neither is
    used. Under `jit`, `f` has to accept both. A pulse that all runs pass over is not noticed here:
    see `Solution.error`.

    **Returns** a `FunctionError`.

    >>> body, law = rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.torques.Damping([0.1, 0.1, 0.1])
    >>> def last(omega, **tolerances):
    ...     return rj.simulate(body, rj.Spin(omega), [0.0, 5.0], law, **tolerances).ys.omega[-1, 0]
    >>> found = error_of(last, jnp.array([0.0, 0.5, 1.0]))
    >>> bool(found.value_error < 1e-8), bool(found.derivative_error.max() < 1e-7)
    (True, True)
    """
    _checks.require_function(f, "f", "f(x) that takes rtol= and atol=")
    try:
        inspect.signature(f).bind(x, rtol=rtol, atol=atol)
    except TypeError as error:
        raise TypeError(f"f: wanted f(x, rtol=…, atol=…), got one where {error}") from None
    x = jax.tree.map(lambda leaf: _checks.numeric_array(leaf, "x"), x)
    dtype = ravel_pytree(x)[0].dtype
    first = jnp.asarray(validation.checked_tolerances(rtol, atol, dtype), dtype)
    eps = float(jnp.finfo(dtype).eps)
    second = first * jnp.maximum(_CLOSER, _DEEPEST * eps / first[0])

    def value(x: Any, tolerances: Array) -> Array:
        return _checks.numeric_array(f(x, rtol=tolerances[0], atol=tolerances[1]), "f(x, …)")

    scalar = jax.eval_shape(value, x, first).shape == ()

    def both(x: Any, tolerances: Array) -> tuple[Array, Any]:
        def twice(x: Any) -> tuple[Array, Array]:
            one = value(x, tolerances)
            return one, one

        derivative, one = (jax.grad if scalar else jax.jacfwd)(twice, has_aux=True)(x)
        return one, derivative

    @jax.jit
    def stated(x: Any, first: Array, second: Array) -> tuple[FunctionError, Array]:
        two = lax.map(lambda tolerances: both(x, tolerances), jnp.stack([first, second]))
        answer = jax.tree.map(lambda a: a[0], two)
        steps = jax.tree.map(lambda a: jnp.abs(a[0] - a[1]), two)
        sizes = jax.tree.map(lambda a: _PLAIN * eps * jnp.max(jnp.abs(a)), answer)
        above = jax.tree.map(lambda a, size: jnp.max(a) > size, steps, sizes)
        clear = jnp.all(jnp.stack(jax.tree.leaves(above))) & (first[0] > _COARSE * eps)

        def neighbours() -> Any:
            rng = np.random.default_rng(0)
            near = jax.tree.map(
                lambda leaf: _copies_changed_in_last_digit(
                    leaf, rng, difference.absolute_or_one_if_all_zero(leaf)
                ),
                x,
            )
            others = jax.vmap(both, (0, None))(near, first)
            changes = jax.tree.map(lambda a, b: a - b[None], others, answer)
            return jax.tree.map(
                lambda a: _DEVIATIONS * jnp.sqrt(_variance_over_neighbours(a)), changes
            )

        off = lax.cond(clear, lambda: jax.tree.map(jnp.zeros_like, answer), neighbours)
        (value, derivative), whole = answer, jax.tree.map(jnp.hypot, steps, off)
        return FunctionError(value, whole[0], derivative, whole[1]), two[0][1]

    error, closer = stated(x, first, second)
    step, sides = difference.step_and_two_points(
        x, error.value, error.value_error, error.derivative
    )
    values = difference.values_at_two_points(eqx.filter_jit(value), sides, second)
    slopes = difference.derivative_and_difference(x, closer, step, sides, values, error)
    difference.warn_if_slopes_differ(slopes)
    missed = difference.derivative_error_from_slopes(slopes)
    derivative_error = jax.tree.map(jnp.hypot, error.derivative_error, missed)
    return dataclasses.replace(error, derivative_error=derivative_error)


def _variance_over_neighbours(changes: Array) -> Array:
    """Return the variance over a run and m neighbours, whose differences are `changes` (m, …).

    It is the variance of m + 1 results, because the run itself is one, with the difference 0.
    """
    mean = jnp.sum(changes, 0, keepdims=True) / (_NEIGHBOURS + 1)
    return (jnp.sum((changes - mean) ** 2, 0) + mean[0] ** 2) / _NEIGHBOURS


def _copies_changed_in_last_digit(leaf: Array, rng: np.random.Generator, size: Array) -> Array:
    """Return three copies (3, …) of an array, each changed at random in the last digit of `size`.

    Each number is changed, up or down, by half to one unit. The change of a square matrix is
    symmetric, so that a symmetric matrix stays symmetric.
    """
    shape = (_NEIGHBOURS + 1) // 2, *leaf.shape
    # The change is at least half a unit, because a smaller change would often be rounded away. As a
    # function of the last digits of its inputs, the result of a long motion is constant over short
    # pieces. A change to one side may stay on the same piece and show nothing. Numbers are
    # therefore changed up in one copy and down in another.
    noise = rng.uniform(0.5, 1.0, shape) * rng.choice([-1.0, 1.0], shape)
    noise = np.concatenate([noise, -noise])[:_NEIGHBOURS]
    if leaf.ndim > 1 and leaf.shape[-1] == leaf.shape[-2]:
        noise = 0.5 * (noise + np.swapaxes(noise, -1, -2))
    return leaf[None] + size[None] * jnp.asarray(np.finfo(leaf.dtype).eps * noise, leaf.dtype)
