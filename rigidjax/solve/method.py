"""A step of an explicit method as a function of numbers alone: of the state and of the field's.

What a vector field depends on (moments of inertia, a torque's parameters) is taken out of it, so
that a loop over steps can have derivative rules of its own.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rigidjax.motion import on_the_group
from rigidjax.solve.components import FEW, join, split
from rigidjax.solve.explicit import AbstractExplicit, Atoms, advance, error_estimate
from rigidjax.solve.scalarise import opened, scalarise, spread
from rigidjax.solve.tableaus import Tableau


class Method(NamedTuple):
    """A tableau and a field, `field(values, t, *y)`, on the scalars of a state `like`."""

    tableau: Tableau
    field: Callable[..., Atoms]
    project: Callable[..., Atoms]
    like: Any

    def stages(
        self, values: Any, t: Any, end: Any, h: Any, y: Atoms
    ) -> tuple[Atoms, list[Atoms], list[Atoms]]:
        """The state at `end`, not projected, the slopes and the states at the stages."""
        return advance(self.tableau, lambda s, z: self.field(values, s, *z), t, h, y, end)

    def step(self, values: Any, t: Any, end: Any, h: Any, y: Atoms) -> Atoms:
        """The state at `end`, on the group."""
        return self.project(*self.stages(values, t, end, h, y)[0])

    def step_and_error(
        self, values: Any, t: Any, end: Any, h: Any, y: Atoms
    ) -> tuple[Atoms, Atoms]:
        """The state at `end` and the estimate of its error."""
        raw, slopes, _ = self.stages(values, t, end, h, y)
        return self.ended(values, end, h, raw, slopes)

    def ended(
        self, values: Any, end: Any, h: Any, raw: Atoms, slopes: list[Atoms]
    ) -> tuple[Atoms, Atoms]:
        """The state on the group and its error, of the state as it came and the slopes."""
        y = self.project(*raw)
        if max(self.tableau.errors[0]) > len(self.tableau.a):
            slopes = [*slopes, self.field(values, end, *y)]
        return y, lax.stop_gradient(error_estimate(self.tableau, h, slopes, self.like))


def method_of(
    solver: AbstractExplicit, field: Callable[..., Any], t0: Array, y0: Any
) -> tuple[Method, list[Any]]:
    """The method, and the arrays that the field depends on; `spread` makes its `values` of them.

    **Raises:** `TypeError` for a state of several dtypes, or with more numbers in one array than
    are written out one by one.
    """
    leaves = jax.tree.leaves(y0)
    kinds = {jnp.result_type(leaf) for leaf in leaves}
    if len(kinds) != 1 or any(jnp.size(leaf) > FEW for leaf in leaves):
        raise TypeError(
            f"lean: wanted a state of one dtype, in arrays of at most {FEW} numbers, got "
            f"{', '.join(str(jax.typeof(leaf)) for leaf in leaves)}; use diffrax.diffeqsolve"
        )
    numbers, constants = opened(lambda t, y: field(t, y, None), t0, y0)
    # Shapes, not numbers: rules of differentiation carry this along as it stands.
    like = jax.tree.map(lambda a: jax.ShapeDtypeStruct(jnp.shape(a), jnp.result_type(a)), y0)
    return Method(solver.tableau, numbers, scalarise(on_the_group, y0), like), constants


def flat(y: Any) -> Array:
    """The numbers of a small state as one vector."""
    return jnp.stack(split(y))


def unflat(vector: Array, like: Any) -> Any:
    """The state shaped as `like` of these numbers."""
    return join(tuple(vector[i] for i in range(vector.shape[0])), like)


__all__ = ["Method", "flat", "method_of", "spread", "unflat"]
