"""Equal steps in the leanest loop: nothing carried but a time, a step and the state's numbers.

`diffrax.diffeqsolve` can do more, and pays for it at each step. Here the loop's state is a tuple of
scalars, a few hundred bytes, so that XLA on CPU compiles the whole loop as one kernel. There is no
interpolation: at saved times, too, the error is the method's own.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax._names import own_names
from rigidjax.motion import Attitude, AttitudeEquations, on_the_group
from rigidjax.solve import splitting
from rigidjax.solve.adaptive import adaptive as adaptive
from rigidjax.solve.components import join, split
from rigidjax.solve.explicit import AbstractExplicit, Atoms, advance
from rigidjax.solve.scalarise import scalarise
from rigidjax.solve.splitting import AbstractSplitting


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
            return step(left + i.astype(h.dtype) * h, h, y)

        y = lax.fori_loop(0, substeps, one, y)
        return y, y

    start = split(y0)
    _, rest = lax.scan(span, start, (ts[:-1], ts[1:]))
    return _stacked(start, rest, y0)


def _stepper(
    solver: AbstractExplicit, field: Callable[..., Any], t0: Array, y0: Any
) -> Callable[[Any, Any, Atoms], Atoms]:
    """One step on scalars, of a field that is traced here and only here."""
    numbers = scalarise(lambda t, y: field(t, y, None), t0, y0)
    project = scalarise(on_the_group, y0)

    def step(t: Any, h: Any, y: Atoms) -> Atoms:
        return project(*advance(solver.tableau, lambda t, y: numbers(t, *y), t, h, y)[0])

    return step


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


__dir__ = own_names(__name__)
