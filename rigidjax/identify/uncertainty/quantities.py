"""Compute the values, standard deviations and intervals of the quantities that a fit reports."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax.identify.model.charts import AbstractBodyChart, Bodies, Ratios, body_list
from rigidjax.identify.model.model import Model, shortened, values_of
from rigidjax.identify.model.terms import value_and_jacfwd
from rigidjax.identify.uncertainty import flat_limit
from rigidjax.identify.uncertainty.degrees_of_freedom import two_sided_student_quantile

# If one end of the interval of a positive number differs from the value of the number by more than
# this factor, the interval goes from 0 to the largest possible value (often infinity).
FARTHEST = 1e3
# A correlation whose magnitude differs from one by less than this counts as ±1.
ROUND_OFF = 1e-13


class Quantity(eqx.Module):
    """Hold a reported quantity: a number with a name, a standard deviation and a unit.

    **Fields:**

    - `name`, `value`, `unit`: the name, the value and the unit of the number.
    - `deviation`: the standard deviation of the number, in its unit.
    - `positive`: whether the number is always positive. If it is, the errors of its logarithm are
      taken as normal: `deviation` is the value times the standard deviation of the logarithm, and
      an interval reaches farther up than down.
    - `cuts`: for each body two things: the correlation of the number with the flatness of the body,
      which is (I1 + I2 − I3) / I3; and the flatness divided by its standard deviation. Intervals
      end where a body would be flat.
    - `most`: the largest value of the number that a real body can have.
    - `freedom`: the degrees of freedom of the variance of the number; infinite if all noise is
      given.

    >>> mass = Quantity("mass", 2.0, 0.02, "kg", True)
    >>> low, high = mass.interval(0.95)
    >>> round(low, 3), round(high, 3)
    (1.961, 2.04)
    """

    name: str
    value: float
    deviation: float
    unit: str
    positive: bool
    cuts: tuple[tuple[float, float], ...] = ()
    most: float = np.inf
    freedom: float = np.inf

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Return the low and the high end of the interval of this quantity.

        The interval of a positive quantity is computed for its logarithm. An interval ends where a
        body would be flat (I1 + I2 = I3). If an end of the interval of a positive quantity differs
        from the value by more than a factor of 1e3, the ends are 0 and the field `most`, the
        largest value that a real body can have (infinity by default).

        **Arguments:** `level` the probability that the interval holds the true value. **Raises**
        `ValueError` for a level outside (0, 1).
        """
        reach = float(two_sided_student_quantile(level, self.freedom))
        wide = deviation_of_value_or_logarithm(self)
        low, high = (float(side) * wide for side in interval_cut_at_flat_bodies(reach, self.cuts))
        if not self.positive:
            return self.value + low, self.value + high
        if max(-low, high) > np.log(FARTHEST):
            return 0.0, self.most
        return float(self.value * np.exp(low)), min(float(self.value * np.exp(high)), self.most)


def deviation_of_value_or_logarithm(quantity: Quantity) -> float:
    """Return the standard deviation of a reported `quantity`, or the standard deviation of its
    logarithm if the quantity is always positive.
    """
    if not quantity.positive:
        return quantity.deviation
    return quantity.deviation / quantity.value if quantity.value else np.inf


def interval_cut_at_flat_bodies(
    half_width: np.ndarray | float, cuts: Sequence[tuple[np.ndarray | float, float]]
) -> tuple[np.ndarray | float, np.ndarray | float]:
    """Return the ends (low, high) of the interval of a quantity, cut where a body would be flat.

    The ends are differences from the best value, in standard deviations of the quantity. A body is
    flat if its principal moments are I1 + I2 = I3.

    **Arguments:**

    - `half_width`: the half-width of the interval if it is not cut, in standard deviations.
    - `cuts`: for each body two numbers: the correlation of the quantity with the flatness of the
      body, which is `(I1 + I2 − I3) / I3`; and the flatness divided by its standard deviation.
    """
    low: Any = -half_width
    high: Any = half_width
    for correlation, away in cuts:
        least, most = flat_limit.interval_ends_at_flat_body(half_width, correlation, away)
        low, high = np.maximum(low, least), np.minimum(high, most)
    return low, high


# The units of quantities of a body that are not in the unit of its moments.
_UNITS = {"mass": "kg", "com x": "m", "com y": "m", "com z": "m"}


def names_units_and_signs(model: Model) -> list[tuple[str, str, bool]]:
    """Return three things for each quantity that a fit of the `model` reports: its name; its unit;
    and whether it is always positive.

    The quantities are in the order of `quantity_vector`.
    """
    out = []
    for name, chart in name_suffixes_and_charts(model):
        for names, positive in ((chart.log_names, True), (chart.plain_names, False)):
            out += [(f"{n}{name}", _UNITS.get(n, chart.unit), positive) for n in names]
    names = recording_suffixes(model)
    for where in names if reports_initial_states(model) else ():
        out += [(f"Ω{axis}{where}", "rad/s", False) for axis in "xyz"]
    for slot in model.slots:
        shape = slot.shape
        parts = [""] if not shape else [f" {_component_name(i)}" for i in np.ndindex(shape)]
        ends = names if slot.each else [f" [{label}]" for label in slot.labels] or [""]
        ends = ends if slot.spread is None else [*ends, *(f", own{where}" for where in names)]
        called = [f"{slot.name}{part}{end}" for end in ends for part in parts]
        out += [(name, slot.unit, slot.positive) for name in called]
    return out


def reports_initial_states(model: Model) -> bool:
    """Return whether a fit of the `model` reports the initial states of its recordings.

    The initial states are not reported for a model of windows (short parts of a record), which has
    too many of them.
    """
    return model.clusters is None


def name_suffixes_and_charts(model: Model) -> list[tuple[str, AbstractBodyChart]]:
    """Return two things for each body of a `model`: the suffix of the names of its quantities; and
    its chart.

    A chart is the parametrisation of a body by free numbers. The suffix is empty for a single body;
    otherwise it is the name of the body in brackets.
    """
    if not isinstance(model.chart, Bodies):
        return [("", model.chart)]
    return [(f" [{n}]", c) for n, c in zip(model.chart.names, model.chart.charts, strict=True)]


def recording_suffixes(model: Model) -> list[str]:
    """Return for each recording the suffix of the names of its quantities.

    The suffix is empty for a single recording. Otherwise it has, in brackets, the name of the body,
    if it has one, and the number of the recording among the recordings of this body.
    """
    if model.count == 1:
        return [""]
    out: list[str] = []
    for index, name in enumerate(model.body_names):
        number = model.body_names[:index].count(name)
        out.append(f" [{name} {number}]" if name else f" [{number}]")
    return out


def _component_name(index: tuple[int, ...]) -> str:
    """Return the name of one component of an array: x, y or z for a vector, else its `index`."""
    return "xyz"[index[0]] if len(index) == 1 and index[0] < 3 else str(index)


def quantity_vector(model: Model, x: Float[Array, " n"]) -> Array:
    """Return the quantities (q,) that a fit reports, at the free numbers x (n,) of a `model`.

    They are, in the order of `names_units_and_signs`, the moments and other numbers of each body,
    the initial body rates (rad/s), and the values of each `Free` (a number of a torque or sensor
    that the fit may move). A positive quantity is given by its logarithm.
    """
    parts, bodies = [jnp.zeros(0, x.dtype)], body_list(model.bodies(x))
    for (_, chart), body in zip(name_suffixes_and_charts(model), bodies, strict=True):
        parts += [chart.logs(body), chart.plain(body)]
    if reports_initial_states(model):
        rates = x[model.index.start[:, -3:]] * model.reference.rate[:, None]
        parts.append(rates.reshape(-1))
    values = values_of(model, x)
    for slot in model.slots:
        for name in (slot.name, f"{slot.name}, own")[: 1 + (slot.spread is not None)]:
            value = values[name].reshape(-1)
            parts.append(jnp.log(value) if slot.positive else value)
    return jnp.concatenate([part.astype(x.dtype) for part in parts])


def quantities_and_derivatives(model: Model, x: Float[Array, " n"]) -> tuple[Array, Array]:
    """Return the reported quantities (q,) of a `model` at the free numbers x (n,), and their
    derivatives (q, n).

    Both arrays have further entries at the end for the flatness (I1 + I2 − I3) / I3 of each body. A
    positive quantity is given by its logarithm.
    """
    return _compiled_quantities_and_derivatives(shortened(model), x)


@eqx.filter_jit
def _compiled_quantities_and_derivatives(
    model: Model, x: Float[Array, " n"]
) -> tuple[Array, Array]:
    """Return the reported quantities (q,) of a `model` at the free numbers x (n,), and their
    derivatives (q, n).

    Both arrays, computed in one compiled program, have further entries at the end for the flatness
    (I1 + I2 − I3) / I3 of each body. A positive quantity is given by its logarithm.
    """

    def value(x: Array) -> Array:
        return jnp.concatenate([quantity_vector(model, x), flat_limit.flatness(model, x)])

    values, slope = value_and_jacfwd(value, x)
    return values, slope


def quantities_and_derivatives_in_numpy(
    model: Model, x: Float[Array, " n"], derivative_point: Float[Array, " n"] | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the reported quantities (q,) of a `model` at the free numbers x (n,), and their
    derivatives (q, n), in NumPy.

    Both arrays have further entries at the end for the flatness (I1 + I2 − I3) / I3 of each body.
    The derivatives are computed at x or, if a body is flat at x, at `derivative_point` (n,), the
    free numbers with a thicker body.
    """
    values, slopes = (np.asarray(part) for part in quantities_and_derivatives(model, x))
    if derivative_point is not None:
        slopes = np.asarray(quantities_and_derivatives(model, derivative_point)[1])
    return values, slopes


def reported_quantities(
    model: Model,
    values_and_slopes: tuple[np.ndarray, np.ndarray],
    covariance: np.ndarray,
    null_directions: np.ndarray,
    limits: tuple[flat_limit.Limit, ...] = (),
    degrees_of_freedom: np.ndarray | float = np.inf,
) -> tuple[Quantity, ...]:
    """Return every reported quantity with its standard deviation.

    **Arguments:**

    - `model`: the model.
    - `values_and_slopes`: the two arrays that `quantities_and_derivatives_in_numpy` returns: the
      values; and their derivatives.
    - `covariance`: (n, n) the covariance of the free numbers within the directions that the data
      determine.
    - `null_directions`: (k, n) the directions of the free numbers that the data do not determine.
    - `limits`: for each body with free moments its distance from a flat body; intervals end where
      the body would be flat.
    - `degrees_of_freedom`: the degrees of freedom of the variance of each quantity.
    """
    names = names_units_and_signs(model)
    values, slope = (part[: len(names)] for part in values_and_slopes)
    deviations = standard_deviations(slope, covariance, null_directions)
    cuts = correlations_with_flatness(slope, covariance, deviations, limits)
    freedom = np.broadcast_to(degrees_of_freedom, values_and_slopes[0].shape)
    # A quantity that does not depend on any free number, such as a known quantity, gets no
    # deviation (NaN).
    deviations = np.where(np.any(slope != 0, axis=-1), deviations, np.nan)
    out = []
    for index, (name, unit, positive) in enumerate(names):
        value, deviation = values[index], deviations[index]
        shown = float(np.exp(value)) if positive else float(value)
        # No number is known better than its round-off.
        least = np.finfo(float).eps * (1.0 if positive else abs(shown))
        most = 1.0 if name.startswith(Ratios.log_names) else np.inf
        mine = tuple((float(rho[index]), away) for rho, away in cuts)
        deviation = float(np.maximum(deviation, least)) * (shown if positive else 1.0)
        own = float(freedom[index])
        out.append(Quantity(name, shown, deviation, unit, positive, mine, most, own))
    return tuple(out)


def interval_about(
    value: np.ndarray,
    slope: np.ndarray,
    covariance: np.ndarray,
    null_directions: np.ndarray,
    half_width: np.ndarray | float,
    limits: tuple[flat_limit.Limit, ...] = (),
) -> tuple[np.ndarray, np.ndarray]:
    """Return the low and the high end of the interval of functions of the n free numbers of a fit.

    **Arguments:**

    - `value`: (…) the best values of the functions.
    - `slope`: (…, n) the derivatives of the functions with respect to the free numbers.
    - `covariance`: (n, n) the covariance of the free numbers within the directions that the data
      determine.
    - `null_directions`: (k, n) the directions that the data do not determine.
    - `half_width`: the half-width of the interval, in standard deviations, if no flat body cuts it.
    - `limits`: for each body with free moments its distance from a flat body; intervals end where
      the body would be flat.
    """
    wide = standard_deviations(slope, covariance, null_directions)
    low, high = interval_cut_at_flat_bodies(
        half_width, correlations_with_flatness(slope, covariance, wide, limits)
    )
    return np.asarray(value + low * wide), np.asarray(value + high * wide)


def correlations_with_flatness(
    slope: np.ndarray,
    covariance: np.ndarray,
    deviations: np.ndarray,
    limits: tuple[flat_limit.Limit, ...],
) -> list[tuple[np.ndarray, float]]:
    """Return the correlations of functions of the free numbers with the flatness of each body.

    The flatness (I1 + I2 − I3) / I3 of a body cannot be negative. This cuts the intervals of
    functions that are correlated with it.

    **Arguments:**

    - `slope`: (…, n) the derivatives of the functions with respect to the n free numbers.
    - `covariance`: (n, n) the covariance of the free numbers.
    - `deviations`: (…) the standard deviations of the functions.
    - `limits`: the distance of each body from a flat body.

    **Returns** two things for each body whose flatness has a finite standard deviation: the
    correlations (…) of the functions with the flatness; and the flatness divided by its standard
    deviation.
    """
    out = []
    for limit in limits:
        wide = limit.flatness_deviation(covariance)
        if np.isfinite(wide) and wide > 0:
            with np.errstate(invalid="ignore", divide="ignore"):
                rho = slope @ (covariance @ limit.slope) / (deviations * wide)
            # The correlation ρ of the flatness with itself differs from one by round-off, and the
            # square root √(1 − ρ²) would raise this round-off to 1e-8.
            rho = np.where(np.abs(rho) > 1.0 - ROUND_OFF, np.sign(rho), rho)
            out.append((np.where(np.isfinite(rho), rho, 0.0), limit.free / wide))
    return out


def standard_deviations(
    slope: np.ndarray, covariance: np.ndarray, null_directions: np.ndarray
) -> np.ndarray:
    """Return the standard deviations (…) of functions of the n free numbers of a fit.

    **Arguments:**

    - `slope`: (…, n) the derivatives of the functions with respect to the free numbers.
    - `covariance`: (n, n) the covariance of the free numbers within the directions that the data
      determine.
    - `null_directions`: (k, n) the directions that the data do not determine.

    A standard deviation is infinite if the function changes along a null direction. It is NaN if
    the variance is negative or no larger than round-off. It is NaN as well if the function depends
    on a free number whose correlation with another free number is larger than one in magnitude. All
    intervals use these standard deviations.
    """
    if not np.isfinite(covariance).all():
        return np.full(slope.shape[:-1], np.nan)
    size = np.abs(slope).max(axis=-1, initial=1e-300)
    undetermined = np.abs(slope @ null_directions.T).max(axis=-1, initial=0.0) > 1e-6 * size
    unit = np.sqrt(np.abs(np.diag(covariance)))
    unit = np.where(unit > 0, unit, 1.0)
    rows, scaled = (slope * unit).reshape(-1, unit.size), covariance / np.outer(unit, unit)
    beyond, out = np.abs(scaled).max(axis=0, initial=0.0) > 1.0 + 1e-6, np.zeros(len(rows))
    # Functions that depend on the same few numbers, such as the functions of one recording's state,
    # are computed together: an eigendecomposition of the whole covariance for each function would
    # be slow.
    alike: dict[bytes, list[int]] = {}
    for index, row in enumerate(rows):
        alike.setdefault((row != 0).tobytes(), []).append(index)
    for key, mine in alike.items():
        used = np.frombuffer(key, bool)
        deviations = _deviations_by_eigenvalues(rows[mine][:, used], scaled[np.ix_(used, used)])
        out[mine] = np.nan if beyond[used].any() else deviations
    return np.where(undetermined, np.inf, out.reshape(slope.shape[:-1]))


def _deviations_by_eigenvalues(slope: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the standard deviations (m,) of m linear functions of n numbers with the `covariance`
    (n, n).

    The argument `slope` (m, n) holds the derivatives of the functions. A deviation is NaN if its
    variance is negative or no larger than round-off.
    """
    values, axes = np.linalg.eigh(covariance)
    along = slope @ axes
    length = np.linalg.norm(along, axis=-1)
    least = 10 * values.size * np.finfo(float).eps * np.abs(values).max(initial=0.0)
    unreal = np.linalg.norm(along[..., values < -least], axis=-1) > 1e-6 * length
    variance = along**2 @ np.maximum(values, 0.0)
    lost = (length > 0) & (unreal | (variance <= least * length**2))
    return np.where(lost, np.nan, np.sqrt(variance))
