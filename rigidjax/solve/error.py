"""How far a run is from the exact motion of its numbers: a second run and three neighbours say.

The error of the *steps* is the distance to a run at a fiftieth of the tolerance, or of equal steps
half as long. The part of *round-off* is how far runs lie apart whose numbers differ by a unit in
the last digit: these round differently, and their differences grow as rounding errors do.
"""

import dataclasses
import inspect
from collections.abc import Callable
from typing import Any

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
from rigidjax.motion.manifold import minus, names, parts_by_name
from rigidjax.solve import difference, validation
from rigidjax.solve.linear_map import as_known
from rigidjax.solve.run import ClosedFormRun, DiffraxRun, equations_of_motion, solve

# Order 8 makes that 1.6 times the steps.
_CLOSER = 2e-2
# The second run of a few steps would take the same ones: no step grows beyond ten times the last.
_CUTS = 8
# Between its steps a run sees nothing: the law is looked at so many times, in so many parts of the
# run. A change within a sample is so many times the median change of its part, or of the roundings.
_PARTS, _SAMPLES_OF_PART, _SUDDEN, _ROUGH = 32, 512, 20.0, 1e3
# Three deviations of four runs hold half of the true error in all but few of a thousand runs.
_NEIGHBOURS, _DEVIATIONS = 3, 3.0
# In float64 neighbours take at least this tolerance, for fewer steps.
_LOOSE = 1.5e-8
# Half a radian, or half of the largest rate: errors do not add up any more.
_LOST = 0.5
# The size below which a number does not matter, as the defaults of `rtol` and `atol` have it.
_SMALL = 1e-3
# Local errors and roundings grow alike. Round-off does not count where steps leave so many times
# what roundings add up to without growth (of a function: nothing is known of its steps), at a
# tolerance so far above a rounding.
_ABOVE, _PLAIN, _COARSE = 300.0, 1e6, 1e5
# A search for a tolerance decreases it by so much at a time, and aims at so small a part of the
# accuracy: errors follow the tolerance to a factor of eight. One above 0.1 rad does not.
_FARTHEST, _AIM, _ALLOWED, _FORESEEN, _FEW = 1e-3, 20.0, 8.0, 0.1, 8
# The least tolerances of a run, and of one to compare with, in roundings.
_FLOOR, _DEEPEST = 20.0, 4.0


class Error(eqx.Module):
    """How far each part of a state is from the exact motion of the given numbers: `Solution.error`.

    **Fields:** `ts` (T,) s; `steps`, `round_off` an array (T,) by name (`q`, `omega`, `x`, `v`,
    `own.0`, …): of a quaternion the angle of the turn, rad, of others the length of the difference
    (rad/s, m, m/s). `steps` is known to some percent (of `accuracy=`: too large by up to ten).
    `round_off` is three standard deviations, and includes the effect of the last digits of body,
    torque and start (in closed form also of the times); it is a bound if it is far below `steps`.
    Both are NaN at times that the run did not reach, inf if a run for comparison did not. `sizes`
    has the scale of each name: 1 rad, or the largest value in the run.

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
        """Both parts together (T,), by name; inf where the state is `lost`."""
        both = jax.tree.map(jnp.hypot, self.steps, self.round_off)
        return jax.tree.map(lambda part: jnp.where(self.lost, jnp.inf, part), both)

    @property
    def relative(self) -> Float[Array, " times"]:
        """The largest part (T,), rad, or relative to the largest value in the run."""
        return jnp.where(self.lost, jnp.inf, self._relative)

    @property
    def lost(self) -> Bool[Array, " times"]:
        """Where nothing is known (T,): `relative` was above one half by then, as in chaos."""
        return lax.associative_scan(jnp.logical_or, self._relative > _LOST)

    @property
    def known_until(self) -> Float[Array, ""]:
        """The last of `ts` at which the state is not lost, s."""
        return self.ts[jnp.sum(~self.lost) - 1]

    @property
    def _relative(self) -> Array:
        return _largest(jax.tree.map(jnp.hypot, self.steps, self.round_off), self.sizes)


@eqx.filter_jit
def error_of_run(setup: Any, ts: Array, ys: Any, count: Array, tried: Any = None) -> Error:
    """The error of the states `ys` that `setup` gave at `ts` in `count` steps.

    By another run `tried`, its tolerance and states, it is too large by up to ten.
    """
    setup, ts, ys, count, tried = _still((setup, ts, ys, count, tried))
    rtol, factor, others = jnp.zeros((), ts.dtype), 1.0, ys
    if tried is not None:
        rtol, (before, others) = setup.rtol, tried
        far = _largest(_apart(others, ys), _sizes(ys)) > _FORESEEN
        factor = jnp.where(far, jnp.inf, _ALLOWED * rtol / before)
    elif not isinstance(setup, ClosedFormRun):
        second, rtol, factor = _closer(setup, ts, _sudden_times(setup, ts, ys))
        others, *_ = solve(second, jax.tree.map(lambda leaf: leaf[0], ys), ts)
    steps = jax.tree.map(lambda part: factor * part, _apart(others, ys))
    return _with_round_off(setup, ts, ys, count, steps, rtol)


def _still(tree: Any) -> Any:
    return jax.tree.map(lambda a: lax.stop_gradient(a) if eqx.is_array(a) else a, tree)


def _with_round_off(
    setup: Any, ts: Array, ys: Any, count: Array, steps: dict[str, Array], rtol: Array
) -> Error:
    sizes, start = _sizes(ys), jax.tree.map(lambda leaf: leaf[0], ys)
    reached = jnp.isfinite(_largest(_apart(ys, ys), sizes))
    # What rounding adds up to where nothing grows but the angle turned.
    eps = float(jnp.finfo(ts.dtype).eps)
    plain = {name: _ABOVE * eps * count.astype(ts.dtype) ** 1.5 * sizes[name] for name in sizes}
    above = jnp.stack([(steps[name] > plain[name])[1:] for name in sizes])
    clear = jnp.all(above | ~reached[None, 1:]) & (rtol > _COARSE * eps)
    # Then the neighbours take no step.
    times = jnp.where(clear, ts[0], ts)
    numbers, rest = eqx.partition((setup.body, setup.torque, start), eqx.is_inexact_array)
    setup, ys, more = _cheaper(setup, start, times, ys, count)

    free = isinstance(setup, ClosedFormRun)

    def neighbour(numbers: Any, later: Array) -> Array:
        body, torque, y0 = eqx.combine(numbers, rest)
        new = dict(body=body, throw=False) | ({} if free else dict(torque=torque))
        return jax.vmap(minus)(solve(dataclasses.replace(setup, **new), y0, times * later)[0], ys)

    rng = np.random.default_rng(0)
    near = jax.tree.map(lambda leaf: _nudged(leaf, rng, jnp.abs(leaf)), numbers)
    # The closed form rounds its angle once, and numbers that differ may round to the same one.
    later = jnp.asarray(1.0 + eps * free * np.array([1.0, -1.0, 1.0]), ts.dtype)
    changes = more * jax.vmap(neighbour)(near, later)
    off = _lengths(start, _DEVIATIONS * jnp.sqrt(_spread(changes)))
    off = {name: jnp.where(clear, plain[name], off[name]) for name in off}

    def known(part: Array) -> Array:
        return jnp.where(reached, jnp.where(jnp.isnan(part), jnp.inf, part), jnp.nan)

    steps, off = jax.tree.map(known, (steps, off))
    return Error(ts, steps, off, sizes)


def _cheaper(setup: Any, start: Any, ts: Array, ys: Any, count: Array) -> tuple[Any, Any, Any]:
    """A set-up of fewer steps, its run, and what to multiply its round-off by.

    Roundings grow alike at any tolerance; n of them add up to √n. float32 takes few steps anyway.
    """
    replayed = isinstance(setup, DiffraxRun) and setup.is_replayed
    if not replayed or ts.dtype == jnp.float32:
        return setup, ys, 1.0
    setup = _with_tolerance(setup, jnp.maximum(setup.rtol, _LOOSE).astype(ts.dtype))
    ys, stats, _ = solve(setup, start, ts)
    fewer = jnp.maximum(stats["num_accepted_steps"], 1)
    return setup, ys, jnp.sqrt(jnp.maximum(count / fewer, 1.0)).astype(ts.dtype)


def _apart(others: Any, ys: Any) -> dict[str, Array]:
    """How far states are from others, part by part (T,)."""
    return _lengths(jax.tree.map(lambda leaf: leaf[0], ys), jax.vmap(minus)(others, ys))


def _lengths(state: Any, changes: Array) -> dict[str, Array]:
    named = parts_by_name(state, changes).items()
    return {name.removeprefix("motion."): jnp.linalg.norm(part, axis=-1) for name, part in named}


def largest_in_run(leaf: Array) -> Array:
    """The largest length of an array of the states in the part of a run that it reached."""
    return jnp.nanmax(jnp.linalg.norm(leaf.reshape(leaf.shape[0], -1), axis=-1))


def _sizes(ys: Any) -> dict[str, Array]:
    sizes = {}
    for name, leaf in zip(names(ys), jax.tree.leaves(ys), strict=True):
        name = name.removeprefix("motion.")
        most = largest_in_run(leaf)
        sizes[name] = jnp.ones_like(most) if name == "q" else jnp.maximum(most, _SMALL)
    return sizes


def _largest(apart: dict[str, Array], sizes: dict[str, Array]) -> Array:
    return jnp.max(jnp.stack([apart[name] / sizes[name] for name in apart]), 0)


@eqx.filter_jit
def solve_to(
    setup: DiffraxRun, state0: Any, ts: Array, accuracy: Array
) -> tuple[DiffraxRun, Any, Any]:
    """Return a run with a global error of `accuracy`, if there is one.

    The error of each run is its distance to the next, and decreases as the tolerance does.
    **Returns** the set-up at its tolerance, its result, tolerance and states of the run before.
    """
    still = _still((setup, state0, ts, accuracy))
    floor = _FLOOR * float(jnp.finfo(ts.dtype).eps)

    sudden = _sudden_times(still[0], ts, jax.tree.map(lambda leaf: leaf[None], still[1]))

    def run(rtol: Array, times: Array) -> Any:
        at_rtol = dataclasses.replace(_with_tolerance(still[0], rtol), cuts=sudden)
        return solve(at_rtol, still[1], times)

    def closer(carry: Any) -> Any:
        (others, stats, _), _, before, rtol, ended = carry
        # In a batch a body that is ready takes no step.
        new = run(rtol, jnp.where(ended, ts[0], ts))
        off = jnp.nanmax(_largest(_apart(others, new[0]), _sizes(new[0]))[1:])
        wanted = before * still[3] / (_AIM * off)
        least = jnp.maximum(_FARTHEST * rtol, floor)
        # A run that is lost foresees nothing, nor does one whose steps are not those of its
        # tolerance: short runs end before their steps have grown so long.
        count, counted = (a["num_accepted_steps"].astype(ts.dtype) for a in (new[1], stats))
        more = (before / rtol) ** (1 / setup.solver.tableau.order)
        sound = (off < _FORESEEN) & (count >= _FEW) & (count >= 0.75 * more * counted)
        good = sound & (_ALLOWED * off * rtol <= before * still[3])
        following = jnp.where(sound, jnp.clip(wanted, least, jnp.maximum(rtol / 3, floor)), least)
        # One that got nowhere will get nowhere.
        return new, (before, others), rtol, following, good | (rtol <= floor) | jnp.isnan(off)

    first = jnp.clip(jnp.sqrt(still[3]), 1e-6, 1e-4).astype(ts.dtype)
    first = jnp.maximum(first, 100 * floor)
    begun = run(first, ts)
    carry = (begun, (first, begun[0]), first, 0.03 * first, jnp.asarray(False))
    new, tried, rtol, *_ = lax.while_loop(lambda carry: ~carry[-1], closer, carry)
    setup = dataclasses.replace(_with_tolerance(setup, lax.stop_gradient(rtol)), cuts=sudden)
    return setup, (_as_solved(setup, state0, ts, new[0]), *new[1:]), tried


@eqx.filter_custom_jvp
def _as_solved(setup: DiffraxRun, state0: Any, ts: Array, ys: Any) -> Any:
    """The states, which `solve` has given: only derivatives run it once more."""
    return ys


@_as_solved.def_jvp
def _(primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> Any:
    states = lambda *args: solve(*args)[0]  # noqa: E731
    ys, along = eqx.filter_jvp(states, primals[:3], tangents[:3])
    return as_known(primals[3], ys), along


def _with_tolerance(setup: DiffraxRun, rtol: Any) -> DiffraxRun:
    """Return the set-up at another tolerance, `atol` as the defaults have it."""
    return dataclasses.replace(setup, rtol=rtol, atol=_SMALL * rtol, throw=False)


def _sudden_times(setup: Any, ts: Array, ys: Any) -> Array:
    """Return a time in each part of a run at which the law changes at once, else the start.

    A pulse shorter than a step is passed over by every run in which no step ends within it. The law
    is sampled in time, at one saved state for each part of the run; a sample is sudden where the
    chord of its neighbours misses it far more than elsewhere in the part.
    """
    state0 = jax.tree.map(lambda leaf: leaf[0], ys)
    field = equations_of_motion(setup.body, state0, setup.torque)
    traced = jax.make_jaxpr(lambda t: field(t, state0, None))(ts[0]).jaxpr
    if not any(var is traced.invars[0] for equation in traced.eqns for var in equation.invars):
        return ts[:0]
    # Uneven times: a pulse in every second of an even grid could fall between the samples.
    uneven = np.random.default_rng(1).uniform(-0.25, 0.25, (_PARTS, _SAMPLES_OF_PART + 2))
    # The first and last sample of a part are only neighbours: they are those of the next part.
    uneven[1:, :2] = uneven[:-1, -2:]
    number = _SAMPLES_OF_PART * np.arange(_PARTS)[:, None] + np.arange(_SAMPLES_OF_PART + 2) - 0.5
    share = np.clip((number + uneven) / (_PARTS * _SAMPLES_OF_PART), 0.0, 1.0)
    times = ts[0] + (ts[-1] - ts[0]) * jnp.asarray(share, ts.dtype)
    way = jnp.sign(ts[-1] - ts[0])
    saved = jnp.searchsorted(way * ts, way * times[:, _SAMPLES_OF_PART // 2], side="right") - 1

    def sudden(part: tuple[Array, Array]) -> Array:
        t, index = part
        y = jax.tree.map(lambda leaf: leaf[index], ys)
        f = jax.vmap(lambda t: ravel_pytree(field(t, y, None))[0])(t)
        left, here, right = t[:-2, None], t[1:-1, None], t[2:, None]
        chord = (f[:-2] * (right - here) + f[2:] * (here - left)) / (right - left)
        size = jnp.max(jnp.abs(f), 0)
        missed = jnp.abs(f[1:-1] - chord) / jnp.where(size > 0, size, 1)[None]
        missed = jnp.max(jnp.where(jnp.isfinite(missed), missed, 0), 1)
        usual = _SUDDEN * jnp.median(missed) + _ROUGH * float(jnp.finfo(t.dtype).eps)
        most = jnp.argmax(missed)
        return jnp.where(missed[most] > usual, t[1 + most], ts[0])

    return lax.stop_gradient(lax.map(sudden, (times, saved)))


def _closer(setup: Any, ts: Array, sudden: Array) -> tuple[Any, Any, float]:
    """Return the set-up of a closer run, the tolerance of the given one, their distance's factor.

    Steps of the closer run end at the `sudden` times, too.
    """
    eps = float(jnp.finfo(ts.dtype).eps)
    most = None if setup.max_steps is None else 4 * setup.max_steps
    setup = dataclasses.replace(setup, max_steps=most, throw=False)
    if setup.controller is None:
        rtol = jnp.asarray(setup.rtol, ts.dtype)
        less = jnp.maximum(_CLOSER * rtol, _DEEPEST * eps)
        cuts = sudden
        if setup.seeks_stops:
            parts = jnp.arange(1, _CUTS).astype(ts.dtype) / _CUTS
            cuts = jnp.concatenate([ts[0] + (ts[-1] - ts[0]) * parts, sudden])
        new = dict(rtol=less, atol=setup.atol * (less / rtol), cuts=cuts if cuts.size else None)
        return dataclasses.replace(setup, **new), rtol, 1.0
    pid = lambda node: isinstance(node, dfx.PIDController)  # noqa: E731
    inside: Any = lambda c: [n for n in jax.tree.leaves(c, is_leaf=pid) if pid(n)]  # noqa: E731
    if found := inside(setup.controller):
        less = jnp.maximum(_CLOSER * found[0].rtol, _DEEPEST * eps)
        both = less, found[0].atol * (less / found[0].rtol)
        where = lambda s: (inside(s.controller)[0].rtol, inside(s.controller)[0].atol)  # noqa: E731
        setup = eqx.tree_at(where, setup, both)
        setup = dataclasses.replace(setup, cuts=sudden) if sudden.size else setup
        return setup, jnp.asarray(found[0].rtol, ts.dtype), 1.0
    if not isinstance(setup.controller, dfx.ConstantStepSize):
        raise TypeError(
            "error: a second run needs a diffrax.PIDController or ConstantStepSize, got "
            f"{type(setup.controller).__name__}"
        )
    # Of order 2; of a higher one it is a third too much at most.
    return dataclasses.replace(setup, dt0=0.5 * setup.dt0), jnp.zeros(()), 4 / 3


class FunctionError(eqx.Module):
    """A value and its derivative, with the error of each number: see `error_of`.

    **Fields:** `value`, and `derivative` by x, as `jax.grad` or `jax.jacfwd` have it;
    `value_error` and `derivative_error` of their shapes, absolute. The latter holds what the
    derivative misses of a difference of values.

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
        """Whether the error of the derivative is below half of its length.

        Where it is not, as in chaos, the derivative means nothing, finite or not.
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
    """Value and derivative of a function that runs through `simulate`, with their errors.

    **Arguments:**

    - `f`: `f(x, rtol=…, atol=…) → array`, which hands both to every `simulate` in it (as
      `**tolerances`). What does not depend on them, such as a closed form, has round-off alone.
    - `x`: numbers, or a tree of them, all of one dtype. The derivative is taken in reverse mode
      where the value is a scalar, else in forward mode.
    - `rtol`, `atol`: those of the answer, by default those of `simulate`.

    The second run has a fiftieth of them; where its distance is not far above round-off, three
    more have the last digits of `x` changed (in a `vmap` always; zeros alone by those of 1). See
    `Solution.error`. Each call compiles anew: put it into a `jax.jit` of your own to call it often.

    Two more values lie beside `x` in a random direction, 5e-7 of each number away (5e-4 in
    float32). Where their difference and the derivative do not agree, by more than the values are
    unsure of, the derivative has this error, and a `UserWarning` says so: it misses what a switch
    of a torque by time or state adds (`jnp.where`, `jnp.sign`), or a `stop_gradient`. Where `f`
    refuses the numbers on one side (a flat body), the other side is taken, where on both, none.
    Under `jit` it must take both. A pulse that all runs pass over is not seen here, see
    `Solution.error`.

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
    first = jnp.asarray(validation.tolerances(rtol, atol, dtype), dtype)
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
            near = jax.tree.map(lambda leaf: _nudged(leaf, rng, difference.size_of(leaf)), x)
            others = jax.vmap(both, (0, None))(near, first)
            changes = jax.tree.map(lambda a, b: a - b[None], others, answer)
            return jax.tree.map(lambda a: _DEVIATIONS * jnp.sqrt(_spread(a)), changes)

        off = lax.cond(clear, lambda: jax.tree.map(jnp.zeros_like, answer), neighbours)
        (value, derivative), whole = answer, jax.tree.map(jnp.hypot, steps, off)
        return FunctionError(value, whole[0], derivative, whole[1]), two[0][1]

    error, closer = stated(x, first, second)
    step, sides = difference.sides_of(x, error.value, error.value_error, error.derivative)
    values = difference.values_at(eqx.filter_jit(value), sides, second)
    slopes = difference.slopes_of(x, closer, step, sides, values, error)
    difference.warn_of_slopes(slopes)
    missed = difference.errors_of_numbers(slopes)
    derivative_error = jax.tree.map(jnp.hypot, error.derivative_error, missed)
    return dataclasses.replace(error, derivative_error=derivative_error)


def _spread(changes: Array) -> Array:
    """The variance of runs that differ by so much from one more."""
    mean = jnp.sum(changes, 0, keepdims=True) / (_NEIGHBOURS + 1)
    return (jnp.sum((changes - mean) ** 2, 0) + mean[0] ** 2) / _NEIGHBOURS


def _nudged(leaf: Array, rng: np.random.Generator, size: Array) -> Array:
    """Numbers changed by up to a unit in the last digit of `size`; what is symmetric stays so."""
    shape = (_NEIGHBOURS + 1) // 2, *leaf.shape
    # Half a unit at least, and to both sides: a smaller change would often be rounded away, and a
    # motion of many turns is a staircase of the last digits, which one side may not show.
    noise = rng.uniform(0.5, 1.0, shape) * rng.choice([-1.0, 1.0], shape)
    noise = np.concatenate([noise, -noise])[:_NEIGHBOURS]
    if leaf.ndim > 1 and leaf.shape[-1] == leaf.shape[-2]:
        noise = 0.5 * (noise + np.swapaxes(noise, -1, -2))
    return leaf[None] + size[None] * jnp.asarray(np.finfo(leaf.dtype).eps * noise, leaf.dtype)
