"""The same steps in the leanest loop: nothing carried but a time, a step and the state's numbers.

`diffrax.diffeqsolve` can do more, and pays for it at each step. Here the loop's state is a tuple of
scalars, a few hundred bytes, so that XLA on CPU compiles the whole loop as one kernel. There is no
interpolation: at saved times, too, the error is the method's own.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax.motion import Attitude, AttitudeEquations, on_the_group
from rigidjax.solve import splitting, travel
from rigidjax.solve.components import join, split
from rigidjax.solve.explicit import AbstractExplicit, Atoms, advance, error_estimate
from rigidjax.solve.method import flat, method_of, unflat
from rigidjax.solve.scalarise import scalarise
from rigidjax.solve.splitting import AbstractSplitting
from rigidjax.solve.watched import NONFINITE


class LeanSolution(NamedTuple):
    """What the lean loops return.

    **Fields:** `ys` the states, of the type of `y0`, with a leading time axis; `num_steps`,
    `num_rejected` of the whole run; `result` a `diffrax.RESULTS`.
    """

    ys: Any
    num_steps: Array
    num_rejected: Array
    result: dfx.RESULTS


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
    jumps: Array | None = None,
    way: Callable[..., travel.Answer] = travel.forward,
) -> LeanSolution:
    """Steps as long as the tolerances allow, whatever the times that are asked for.

    The norm, the control of the step (integral, safety 0.9) and the first step are those of
    `diffrax.PIDController`. How states between steps and derivatives come about: `solve/travel.py`.

    **Arguments:** as for `fixed`, a state of arrays of at most 32 numbers; `rtol`, `atol` scalars;
    `dt0` the first step, s, or `None`; `jumps` times, s, in any order, at which the field jumps:
    steps end there; `way` `travel.forward` (forward mode) or `travel.reverse` (`jax.grad`), which
    keeps 2048 steps and every 2048th start. Derivatives are by all numbers of the field, `ts`,
    `jumps` and `y0`, lengths of steps held; not by tolerances.

    **Returns** a `LeanSolution`. A run that needs more than `max_steps`, or meets a NaN that no
    shorter step avoids, ends early: its `result` says so, and the states not reached are NaN.

    **Raises:** `TypeError` for a state of several dtypes or of long arrays.
    """
    method, constants = method_of(solver, field, ts[0], y0)
    order = solver.order(None)
    h0, sound = _first_step(field, order, ts[0], y0, rtol, atol)
    # Where there is no slope to begin with, no step is short enough.
    h0 = jnp.where(sound, h0 if dt0 is None else jnp.asarray(dt0, h0.dtype), jnp.nan)
    smooth = [jnp.issubdtype(constant.dtype, jnp.inexact) for constant in constants]
    chosen, rest = eqx.partition(constants, smooth)
    chosen = jax.tree.map(jnp.asarray, chosen)
    stops = ts[-1:]
    if jumps is not None and jumps.size:
        inside = jnp.clip(jnp.sort(jumps.astype(ts.dtype)), ts[0], ts[-1])
        stops = jnp.concatenate([inside, stops])
    given = travel.Given(chosen, ts[0], stops, ts[1:-1], flat(y0))
    fixed = travel.Fixed(
        rest,
        lax.stop_gradient(jnp.asarray(h0, ts.dtype)),
        lax.stop_gradient(jnp.asarray(rtol, given.y0.dtype)),
        lax.stop_gradient(jnp.asarray(atol, given.y0.dtype)),
    )
    out = way(method, max_steps, given, fixed)
    result = dfx.RESULTS.where(
        out.t >= ts[-1],
        dfx.RESULTS.successful,
        dfx.RESULTS.where(
            out.h > 0,
            dfx.RESULTS.max_steps_reached,
            dfx.RESULTS.where(jnp.isnan(out.h), NONFINITE, dfx.RESULTS.dt_min_reached),
        ),
    )
    rows = jnp.concatenate([given.y0[None], out.between, out.end[None]])
    ys = jax.vmap(lambda row: unflat(row, y0))(rows)
    return LeanSolution(ys, out.steps, out.rejected, result)


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
        end, slopes, _ = advance(tableau, slope, t, h, y)
        end = project(*end)
        if max(tableau.errors[0]) > len(tableau.a):
            slopes = [*slopes, slope(t + h, end)]
        return end, lax.stop_gradient(error_estimate(tableau, h, slopes, y0))

    return step


def _first_step(
    field: Any, order: int, t0: Array, y0: Any, rtol: Any, atol: Any
) -> tuple[Array, Array]:
    """Hairer, Nørsett and Wanner (1993), II.4, algorithm for the starting step; is it one?"""

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
    h = jnp.minimum(100 * h, jnp.where(flat, jnp.maximum(1e-6, 1e-3 * h), guess))
    return h, jnp.isfinite(d1)


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
