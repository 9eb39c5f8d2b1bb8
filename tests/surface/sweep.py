"""Derivatives of public functions at ordinary and degenerate points, by four ways that must agree.

For a function f of a vector x: the Jacobian forward, in reverse, and by central differences of
order eight; the Hessian of a weighted sum of f forward over reverse, and by the same differences of
the gradient. All points of a function go through one program.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

# Fornberg 1988, doi:10.1090/S0025-5718-1988-0935077-0, table 1.
STEPS = np.array([1, 2, 3, 4])
WEIGHTS = np.array([4 / 5, -1 / 5, 4 / 105, -1 / 280])


@dataclasses.dataclass(frozen=True)
class Case:
    """A function and where to look.

    **Fields:** `name`; `f` a function of one vector to anything of floats; `points` by name, all of
    one length; `step` of the differences, in units of x; `rtol` of the first derivative relative to
    the larger of it and the value, `rtol2` of the second; `atol` what the differences are off by
    where all of these are zero; `once` names of points where a second
    derivative does not exist (the documentation says so); `first` whether the second is only to be
    finite; `without_second` why it is not looked at (minutes to compile), and where it is instead;
    `covers` the public names that this stands for.
    """

    name: str
    f: Callable[[Any], Any]
    points: dict[str, Any]
    step: float = 0.02
    rtol: float = 1e-9
    rtol2: float = 1e-8
    atol: float = 0.0
    once: tuple[str, ...] = ()
    first: bool = False
    without_second: str = ""
    covers: tuple[str, ...] = ()


def problems(case: Case) -> list[str]:
    """What is wrong, in words; an empty list where all four agree."""
    points = np.stack([np.asarray(p, float) for p in case.points.values()])
    got = _derivatives(case, points)
    around = _around(points, case.step)
    values, slopes = _stencil(case, around)
    by_difference = _differences(values, case.step)
    second_by_difference = _differences(slopes, case.step)
    found = []
    for i, where in enumerate(case.points):
        size = np.abs(got["value"][i]).max(initial=0.0)
        right = by_difference[i]
        for way in ("forward", "reverse"):
            scale = max(size, case.atol / case.rtol)
            found += _apart(f"{where}: {way}", got[way][i], right, case.rtol, scale)
        found += _apart(
            f"{where}: reverse against forward",
            got["reverse"][i],
            got["forward"][i],
            1e-10,
            case.atol / 1e-10,
        )
        if case.without_second:
            continue
        if case.first or where in case.once:
            if not np.isfinite(got["second"][i]).all():
                found.append(f"{where}: the second derivative is not finite")
            continue
        found += _apart(
            f"{where}: forward over reverse",
            got["second"][i],
            second_by_difference[i],
            case.rtol2,
            max(size, np.abs(right).max(initial=0.0)),
        )
    return found


def _apart(name: str, got: np.ndarray, right: np.ndarray, rtol: float, size: float) -> list[str]:
    if not np.isfinite(right).all():
        return [f"{name}: the differences themselves are not finite"]
    if not np.isfinite(got).all():
        return [f"{name}: not finite: {got.tolist()}"]
    scale = max(np.abs(right).max(initial=0.0), size, 1e-300)
    error = np.abs(got - right).max(initial=0.0) / scale
    if error <= rtol:
        return []
    at = np.unravel_index(np.argmax(np.abs(got - right)), right.shape)
    return [f"{name}: off by {error:.1e} at {tuple(map(int, at))}: {got[at]:.9g}, {right[at]:.9g}"]


def _flat(case: Case) -> Callable[[Any], Any]:
    return lambda x: ravel_pytree(case.f(x))[0]


def _weighed(case: Case) -> Callable[[Any], Any]:
    def total(x: Any) -> Any:
        y = _flat(case)(x)
        return jnp.sum(y * jnp.cos(1.0 + jnp.arange(y.size)))

    return total


def _derivatives(case: Case, points: np.ndarray) -> dict[str, np.ndarray]:
    def all_of(x: Any) -> dict[str, Any]:
        found = {
            "value": _flat(case)(x),
            "forward": jax.jacfwd(_flat(case))(x),
            "reverse": jax.jacrev(_flat(case))(x),
        }
        if not case.without_second:
            found["second"] = jax.jacfwd(jax.grad(_weighed(case)))(x)
        return found

    # A loop, not a batch, over what has its own batching inside is no different to check.
    return jax.tree.map(np.asarray, _compiled(jax.vmap(all_of))(points))


def _stencil(case: Case, around: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    def both(x: Any) -> tuple[Any, Any]:
        value = _flat(case)(x)
        # What is not looked at is not compiled.
        first_only = case.first or case.without_second
        return value, value[:0] if first_only else jax.grad(_weighed(case))(x)

    flat = around.reshape(-1, around.shape[-1])
    values, slopes = _compiled(jax.vmap(both))(flat)
    shape = around.shape[:-1]
    return (
        np.asarray(values).reshape(*shape, values.shape[-1]),
        np.asarray(slopes).reshape(*shape, slopes.shape[-1]),
    )


def _compiled(f: Callable) -> Callable:
    # Compiling is what this costs.
    return jax.jit(f, compiler_options={"xla_backend_optimization_level": 0})


def _around(points: np.ndarray, step: float) -> np.ndarray:
    """(points, direction, step, side, n)."""
    n = points.shape[1]
    moves = step * STEPS[None, :, None, None] * np.array([1.0, -1.0])[None, None, :, None]
    return points[:, None, None, None, :] + moves[None] * np.eye(n)[None, :, None, None, :]


def _differences(values: np.ndarray, step: float) -> np.ndarray:
    """(points, m, n) of values (points, direction, step, side, m)."""
    apart = values[:, :, :, 0] - values[:, :, :, 1]
    return np.einsum("k,pnkm->pmn", WEIGHTS, apart) / step
