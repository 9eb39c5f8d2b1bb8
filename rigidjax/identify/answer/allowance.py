"""Words for the errors, besides random ones, that the intervals of a fit allow for."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from rigidjax.identify.model.model import Model
from rigidjax.identify.uncertainty.considered import Consideration, describe_considered
from rigidjax.identify.uncertainty.degrees_of_freedom import quantile
from rigidjax.identify.uncertainty.quantities import Quantity

# The largest number of quantities named in one sentence.
MOST = 3
_WAYS = {
    "scale": "an error of 1 % in the scale of one axis",
    "cross_axis": "an axis that leans by 1°",
}

Moves = Sequence[tuple[int, dict[str, Float[np.ndarray, " quantities"]]]]


def allowance(
    model: Model,
    parts: tuple[Consideration, ...],
    moves: Moves,
    named: Sequence[Quantity],
) -> str:
    """Return sentences on the sensor errors that the intervals allow for, and that they do not.

    **Arguments:**

    - `model`: the fitted model.
    - `parts`: the considered errors, those of sensors with a `Tolerance`.
    - `moves`: for each sensor without a tolerance, how far its usual errors would move the
      quantities `named` (`considered.unit_moves`).
    - `named`: the quantities.
    """
    out = []
    sensors = model.records.sensors
    if parts:
        out.append(f"They allow for {describe_considered(parts, sensors)}.")
    for index, by_kind in moves:
        clauses = [
            f"{_WAYS[kind]} would move {_listed(named, sizes)}" for kind, sizes in by_kind.items()
        ]
        name = type(sensors[index]).__name__
        out.append(
            f"They do not allow for a {name} that is off: {'; '.join(clauses)}. Give its "
            f"tolerance, such as {name}(…, tolerance=Tolerance(scale=0.01, cross_axis=0.01))."
        )
    if not out:
        out.append("They do not allow for a sensor that is off.")
    return " ".join(out)


def _listed(named: Sequence[Quantity], sizes: Float[np.ndarray, " quantities"]) -> str:
    """List by how much each quantity would move, with the half-width of its interval."""
    words = []
    for quantity, size in list(zip(named, sizes, strict=True))[:MOST]:
        unit = quantity.value if quantity.positive else 1.0
        half = float(quantile(0.95, quantity.freedom)) * quantity.deviation
        shown = f"{quantity.name} by {abs(unit) * size:.2g}"
        words.append(f"{shown} (interval ±{half:.2g})" if np.isfinite(half) else shown)
    return ", ".join(words)
