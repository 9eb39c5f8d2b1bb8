"""The same steps in the leanest loop: nothing carried but a time, a step and the state's numbers.

`diffrax.diffeqsolve` can do more, and pays for it at each step. Here the loop's state is a tuple of
scalars, a few hundred bytes, so that XLA on CPU compiles the whole loop as one kernel. Saved times
are stepped on exactly: no interpolation, the error is the method's own.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax.motion import Attitude, AttitudeEquations, on_the_group
from rigidjax.solve import splitting
from rigidjax.solve.components import join, split
from rigidjax.solve.explicit import AbstractExplicit, Atoms, advance, error_estimate
from rigidjax.solve.scalarise import scalarise
from rigidjax.solve.splitting import AbstractSplitting

# What diffrax.PIDController does unless told: the same steps, so that figures can be compared.
_SAFETY, _SMALLEST, _LARGEST = 0.9, 0.2, 10.0


class LeanSolution(NamedTuple):
    """What the lean loops return.

    **Fields:** `ys` the states, of the type of `y0`, with a leading time axis; `num_steps`,
    `num_rejected` of the whole run; `result` a `diffrax.RESULTS`.
    """

    ys: Any
    num_steps: Array
    num_rejected: Array
    result: dfx.RESULTS


class _Span(NamedTuple):
    """The loop's state between two saved times."""

    t: Array
    h: Array
    y: Atoms
    steps: Array
    rejected: Array


def fixed(
    solver: AbstractExplicit, field: Callable[..., Any], ts: Array, y0: Any, substeps: Any
) -> Any:
    """`substeps` equal steps between each two times of `ts`.

    **Arguments:** `solver` an explicit method of this package; `field` a vector field
    `f(t, y, args)` such as `AttitudeEquations`; `ts` (T,) s; `y0` the state at `ts[0]`;
    `substeps` an integer; traced, it saves compiling again but has no reverse mode.
    **Returns** the states at `ts`, with a leading time axis. Differentiable in both modes.

    >>> import rigidjax as rj
    >>> field = rj.AttitudeEquations(rj.Inertia.from_principal(1.0, 2.0, 3.0))
    >>> start = rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 1])
    >>> ys = fixed(rj.solvers.DormandPrince8(), field, jnp.array([0.0, 1.0]), start, 8)
    >>> ys.q[1, 3]
    Array(0.47942554, dtype=float64)
    """
    step = _stepper(solver, field, ts[0], y0)

    def span(y: Atoms, ends: tuple[Array, Array]) -> tuple[Atoms, Atoms]:
        left, right = ends
        h = (right - left) / jnp.asarray(substeps, left.dtype)

        def one(i: Array, y: Atoms) -> Atoms:
            # Not t + h again and again: round-off would add up (a million steps, 1e-3 in float32).
            return step(left + i.astype(h.dtype) * h, h, y)[0]

        y = lax.fori_loop(0, substeps, one, y)
        return y, y

    start = split(y0)
    _, rest = lax.scan(span, start, (ts[:-1], ts[1:]))
    return _stacked(start, rest, y0)


def adaptive(
    solver: AbstractExplicit,
    field: Callable[..., Any],
    ts: Array,
    y0: Any,
    *,
    rtol: Any,
    atol: Any,
    dt0: Any = None,
    max_steps: int = 100_000,
) -> LeanSolution:
    """Steps as long as the tolerances allow, exactly onto each time of `ts`.

    The norm, the control of the step (integral, safety 0.9) and the first step are those of
    `diffrax.PIDController`. Forward mode only: a loop of unknown length has no transpose.

    **Arguments:** as for `fixed`; `rtol`, `atol` scalars; `dt0` the first step, s, or `None`.
    **Returns** a `LeanSolution`. A run that needs more than `max_steps`, or meets a NaN, ends
    early: its `result` says so, and the states not reached are NaN.
    """
    step = _stepper(solver, field, ts[0], y0)
    start = split(y0)
    order = solver.order(None)
    h0 = _first_step(field, order, ts[0], y0, rtol, atol) if dt0 is None else dt0
    h0 = jnp.asarray(lax.stop_gradient(h0), ts.dtype)

    def span(state: _Span, right: Array) -> tuple[_Span, Atoms]:
        def go_on(s: _Span) -> Array:
            return (s.t < right) & (s.steps < max_steps) & (s.h > 0)

        def one(s: _Span) -> _Span:
            left = right - s.t
            # The step kept is the controller's own, not the one cut short at a saved time.
            last = s.h >= left
            h = jnp.where(last, left, s.h)
            y, error = step(s.t, h, s.y)
            size = _size(error, s.y, y, rtol, atol)
            accept = size < 1
            factor = jnp.clip(_SAFETY * size ** (-1 / order), _SMALLEST, _LARGEST)
            # A NaN anywhere makes the step NaN, which ends the loop.
            following = lax.stop_gradient(h * factor.astype(h.dtype))
            following = jnp.where(last & accept, jnp.maximum(following, s.h), following)
            following = jnp.where(s.t + following > s.t, following, jnp.zeros_like(following))
            return _Span(
                jnp.where(accept, jnp.where(last, right, s.t + h), s.t),
                following,
                tuple(jnp.where(accept, b, a) for a, b in zip(s.y, y, strict=True)),
                s.steps + 1,
                s.rejected + jnp.where(accept, 0, 1),
            )

        state = lax.while_loop(go_on, one, state)
        reached = state.t >= right
        return state, tuple(jnp.where(reached, a, jnp.full_like(a, jnp.nan)) for a in state.y)

    zero = jnp.zeros((), jnp.int32)
    begin = _Span(ts[0], h0, start, zero, zero)
    end, rest = lax.scan(span, begin, ts[1:])
    result = dfx.RESULTS.where(
        end.t >= ts[-1],
        dfx.RESULTS.successful,
        dfx.RESULTS.where(end.h > 0, dfx.RESULTS.max_steps_reached, dfx.RESULTS.dt_min_reached),
    )
    return LeanSolution(_stacked(start, rest, y0), end.steps, end.rejected, result)


def _stepper(
    solver: AbstractExplicit, field: Callable[..., Any], t0: Array, y0: Any
) -> Callable[[Any, Any, Atoms], tuple[Atoms, Atoms]]:
    """One step and its error on scalars, of a field that is traced here and only here."""
    numbers = scalarise(lambda t, y: field(t, y, None), t0, y0)
    project = scalarise(on_the_group, y0)
    tableau = solver.tableau

    def slope(t: Any, y: Atoms) -> Atoms:
        return numbers(t, *y)

    def step(t: Any, h: Any, y: Atoms) -> tuple[Atoms, Atoms]:
        end, slopes = advance(tableau, slope, t, h, y)
        end = project(*end)
        if max(tableau.errors[0]) > len(tableau.a):
            slopes = [*slopes, slope(t + h, end)]
        return end, lax.stop_gradient(error_estimate(tableau, h, slopes, y0))

    return step


def _size(error: Atoms, left: Atoms, right: Atoms, rtol: Any, atol: Any) -> Array:
    """Root mean square of error over tolerance, as `diffrax.PIDController` takes it."""
    total, count = jnp.zeros((), error[0].dtype), 0
    for e, a, b in zip(error, left, right, strict=True):
        scale = jnp.asarray(atol, e.dtype) + jnp.asarray(rtol, e.dtype) * jnp.maximum(
            jnp.abs(a), jnp.abs(b)
        )
        total, count = total + jnp.sum((e / scale) ** 2), count + e.size
    tiny = float(jnp.finfo(total.dtype).tiny)
    return lax.stop_gradient(jnp.sqrt(total / count + tiny))


def _first_step(field: Any, order: int, t0: Array, y0: Any, rtol: Any, atol: Any) -> Array:
    """Hairer, Nørsett and Wanner (1993), II.4, algorithm for the starting step."""

    def norm(tree: Any) -> Array:
        parts = [
            (jnp.abs(a) / (jnp.asarray(atol, a.dtype) + jnp.asarray(rtol, a.dtype) * jnp.abs(y)))
            for a, y in zip(jax.tree.leaves(tree), jax.tree.leaves(y0), strict=True)
        ]
        flat = jnp.concatenate([part.reshape(-1) for part in parts])
        return jnp.sqrt(jnp.mean(flat**2))

    slope = field(t0, y0, None)
    d0, d1 = norm(y0), norm(slope)
    small = (d0 < 1e-5) | (d1 < 1e-5)
    h = jnp.where(small, 1e-6, 0.01 * d0 / jnp.where(small, 1.0, d1)).astype(d0.dtype)
    moved = jax.tree.map(lambda y, k: y + h.astype(y.dtype) * k, y0, slope)
    turned = field(t0 + h.astype(t0.dtype), moved, None)
    d2 = norm(jax.tree.map(lambda a, b: a - b, turned, slope)) / h
    largest = jnp.maximum(d1, d2)
    flat = largest <= 1e-15
    guess = (0.01 / jnp.where(flat, 1.0, largest)) ** (1 / order)
    return jnp.minimum(100 * h, jnp.where(flat, jnp.maximum(1e-6, 1e-3 * h), guess))


def split_fixed(
    solver: AbstractSplitting, field: AttitudeEquations, ts: Array, y0: Attitude, substeps: Any
) -> Attitude:
    """As `fixed`, with a splitting; the loop carries the momentum in principal axes.

    No step goes through Ω = I⁻¹Π and back, so that |Π| drifts by round-off of the flow alone.
    **Raises** as the splitting.

    >>> import rigidjax as rj
    >>> field = rj.AttitudeEquations(rj.Inertia.from_principal(1.0, 2.0, 3.0))
    >>> start = rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 1])
    >>> split_fixed(rj.solvers.Splitting4(), field, jnp.array([0.0, 1.0]), start, 8).q[1, 3]
    Array(0.47942554, dtype=float64)
    """
    frame = splitting.frame_of(field, ts[0], y0)

    def span(state: Any, ends: tuple[Array, Array]) -> tuple[Any, Attitude]:
        left, right = ends
        h = (right - left) / jnp.asarray(substeps, left.dtype)

        def one(i: Array, state: Any) -> Any:
            t = left + i.astype(h.dtype) * h
            return splitting.compose(solver.composition, field, frame, t, h, state)

        q, momentum = state = lax.fori_loop(0, substeps, one, state)
        return state, Attitude(q, splitting.leave(frame, momentum))

    start = (y0.q, splitting.enter(frame, y0.omega))
    _, rest = lax.scan(span, start, (ts[:-1], ts[1:]))
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), y0, rest)


def _stacked(start: Atoms, rest: Atoms, like: Any) -> Any:
    columns = [
        jnp.concatenate([first[None], later]) for first, later in zip(start, rest, strict=True)
    ]
    return jax.vmap(lambda *parts: join(parts, like))(*columns)
