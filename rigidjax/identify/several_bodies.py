"""Several bodies in one problem, each with its chart."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.identify.body_charts import AbstractBodyChart


class Bodies(eqx.Module):
    """The charts of several bodies, by name; their numbers follow one another.

    Charts of the same kind are kept stacked, so that one program serves all recordings.

    **Arguments:** `charts` name → chart. **Raises** `ValueError` if some bodies have a mass and
    some have none.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    charts: tuple[AbstractBodyChart, ...]
    kinds: tuple[AbstractBodyChart, ...]
    kind_of: tuple[int, ...] = eqx.field(static=True)
    row_of: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, charts: Mapping[str, AbstractBodyChart]):
        self.names, self.charts = tuple(charts), tuple(charts.values())
        members: dict[Any, list[AbstractBodyChart]] = {}
        kind_of, row_of = [], []
        for chart in self.charts:
            leaves, structure = jax.tree.flatten(chart)
            form = structure, tuple(np.shape(leaf) for leaf in leaves)
            alike = members.setdefault(form, [])
            kind_of.append(list(members).index(form))
            row_of.append(len(alike))
            alike.append(chart)
        self.kind_of, self.row_of = tuple(kind_of), tuple(row_of)
        self.kinds = tuple(
            jax.tree.map(lambda *x: jnp.stack(x), *alike) for alike in members.values()
        )
        if len({has_mass(chart) for chart in self.charts}) > 1:
            raise ValueError(
                "body: wanted a mass for all bodies or for none, got "
                + ", ".join(f"{n}: {type(c).__name__}" for n, c in charts.items())
            )

    @property
    def size(self) -> int:
        """The number of free numbers of all bodies."""
        return sum(chart.size for chart in self.charts)

    @property
    def widest(self) -> int:
        """The number of free numbers of the largest chart."""
        return max(chart.size for chart in self.charts)

    @property
    def in_words(self) -> str:
        """The free parts of the bodies, in words."""
        parts = (f"{c.in_words} ({n})" for n, c in zip(self.names, self.charts, strict=True))
        return ", ".join(parts)

    def parts(self, vector: Array) -> dict[str, Array]:
        """The numbers of each body."""
        out, first = {}, 0
        for name, chart in zip(self.names, self.charts, strict=True):
            out[name] = vector[first : first + chart.size]
            first += chart.size
        return out

    def all(self, vector: Float[Array, " numbers"]) -> dict[str, Any]:
        """Every body by its name."""
        parts = self.parts(vector)
        return {n: c.body(parts[n]) for n, c in zip(self.names, self.charts, strict=True)}

    def body(self, vector: Float[Array, " chart"], which: Int[Array, ""]) -> Any:
        """The body at the index `which`, from its numbers, padded with zeros."""
        kind, row = jnp.asarray(self.kind_of)[which], jnp.asarray(self.row_of)[which]
        found: Any = None
        for index, charts in enumerate(self.kinds):
            here = jnp.where(kind == index, row, 0)
            chart = jax.tree.map(lambda leaf, at=here: leaf[at], charts)
            body = chart.body(vector[: chart.size])
            if found is not None:
                mine = kind == index
                body = jax.tree.map(lambda a, b, mine=mine: jnp.where(mine, a, b), body, found)
            found = body
        return found


def spread(
    body: AbstractBodyChart | Bodies,
    vector: Array,
    which: Int[Array, " records"] | None,
    count: int,
    fill: int = 0,
) -> Array:
    """The numbers of each recording's body, (R, K), padded with `fill`."""
    if not isinstance(body, Bodies):
        return jnp.broadcast_to(vector, (count, body.size))
    widest = body.widest
    rows = [
        jnp.concatenate([part, jnp.full(widest - part.shape[0], fill, part.dtype)])
        for part in body.parts(vector).values()
    ]
    return jnp.stack(rows)[which]


def matter(
    body: AbstractBodyChart | Bodies, vector: Float[Array, " chart"], which: Int[Array, ""] | None
) -> Inertia | MassProperties:
    """The body of one recording."""
    if not isinstance(body, Bodies):
        return body.body(vector)
    assert which is not None
    return body.body(vector, which)


def charts_of(body: Any) -> tuple[Any, ...]:
    """The charts of a problem's body or bodies."""
    return body.charts if isinstance(body, Bodies) else (body,)


def in_a_row(bodies: Any) -> list[Any]:
    """The bodies of `Problem.bodies`, of one or of several."""
    return list(bodies.values()) if isinstance(bodies, dict) else [bodies]


def tensor_of(body: Inertia | MassProperties) -> Float[Array, "3 3"]:
    """The inertia tensor of a body, about its centre of mass if it has one, kg m²."""
    return (body.inertia if isinstance(body, MassProperties) else body).tensor


def has_mass(chart: AbstractBodyChart) -> bool:
    """Whether the chart's bodies have a mass."""
    sample: Any = eqx.filter_eval_shape(chart.body, jnp.zeros(chart.size))
    return isinstance(sample, MassProperties)
