"""Uncertain starts of windows: found window by window, and eliminated from the fit.

The remaining problem has the free numbers alone, the same size as with known starts (variable
projection: Golub and Pereyra 2003, doi:10.1088/0266-5611/19/2/201).
"""

from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax.identify.jacobian import with_jacobian

# Steps of Gauss and Newton's for each start; residuals of a short run are nearly linear in it.
_STEPS = 3


def precisions(
    starts: Any, kinds: tuple[str, ...], noise: Mapping[str, float] | None
) -> Float[Array, " m"] | None:
    """The precision of each number of the starts, (noise/deviation)²; `None` for exact starts.

    **Raises:** `TypeError`, `ValueError` for unknown kinds, deviations that are not positive, or a
    missing noise.
    """
    if starts is None:
        return None
    require_kinds(starts, kinds, "starts")
    if noise is None:
        raise ValueError(
            "starts: deviations of the starts need the noise of the readings: give noise={…}, too"
        )
    found = []
    for kind in kinds:
        deviation = _checks.number(starts[kind], f"starts[{kind!r}]")
        if not deviation > 0:
            raise ValueError(
                f"starts[{kind!r}]: wanted a positive deviation, or infinity for a start that is "
                f"free, got {deviation}"
            )
        found += 3 * [(np.float64(noise[kind]) / deviation) ** 2]
    return jnp.asarray(np.array(found))


def require_kinds(given: Any, kinds: tuple[str, ...], name: str) -> None:
    """Raise `TypeError`, `ValueError` for anything but a mapping with these keys."""
    _checks.instance(given, Mapping, name, wanted="numbers by kind")
    if set(given) != set(kinds):
        raise ValueError(f"{name}: wanted a number for each of {kinds}, got {tuple(given)}")


def eliminated(
    residual: Callable[[Array, Array], Array], x: Array, firm: Float[Array, " m"]
) -> tuple[Array, Array, Array]:
    """Cost, normal matrix (n, n) and gradient (n,) of one window, the best start put in.

    **Arguments:** `residual(x, step)`; `x` (n,); `firm` (m,) precisions of the start's numbers. The
    cost is `½ |r|² + ½ Σ firm step²` at its least in `step`.
    """
    number = x.size

    def better(_: Any, step: Array) -> Array:
        jacobian, found = with_jacobian(lambda s: residual(x, s), step)
        normal = jacobian.T @ jacobian + jnp.diag(firm)
        return step - jnp.linalg.solve(normal, jacobian.T @ found + firm * step)

    step = lax.fori_loop(0, _STEPS, better, jnp.zeros_like(firm))
    both = jnp.concatenate([x, step])
    jacobian, found = with_jacobian(lambda z: residual(z[:number], z[number:]), both)
    gram, slope = jacobian.T @ jacobian, jacobian.T @ found
    beside = gram[number:, number:] + jnp.diag(firm)
    # The part of each number's effect that the start absorbs, and the remaining gradient.
    sides = jnp.concatenate(
        [gram[number:, :number], (slope[number:] + firm * step)[:, None]], axis=1
    )
    taken = gram[:number, number:] @ jnp.linalg.solve(beside, sides)
    cost = 0.5 * (found @ found + jnp.sum(firm * step * step))
    return cost, gram[:number, :number] - taken[:, :number], slope[:number] - taken[:, number]
