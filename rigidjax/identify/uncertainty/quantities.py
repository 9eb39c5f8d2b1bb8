"""Compute the values, standard deviations and intervals of the quantities that a fit reports."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax.identify.model.charts import BASIS, AbstractBodyChart, Ratios, Tensor, body_list
from rigidjax.identify.model.first_order import FirstOrder, value_and_jacfwd
from rigidjax.identify.model.model import Model, parts_of, shortened, values_of
from rigidjax.identify.uncertainty import flat_limit
from rigidjax.identify.uncertainty.degrees_of_freedom import student_quantile
from rigidjax.motion import Turn

# If one end of the interval of a positive number differs from the value of the number by more than
# this factor, the interval goes from 0 to the largest possible value (often infinity).
FARTHEST = 1e3
# A correlation whose magnitude differs from one by less than this counts as ±1.
ROUND_OFF = 1e-13
# Two moments count as close if they differ by less than this multiple of the 95 % quantile of the
# spectral norm of the noise of the tensor.
_CLOSE = 2.0


class Quantity(eqx.Module):
    """Hold a reported quantity: a number with a name, a standard deviation and a unit.

    **Fields:**

    - `name`, `value`, `unit`: the name, the value and the unit of the number.
    - `deviation`: the standard deviation of the number, in its unit.
    - `positive`: whether the number is always positive. If it is, the errors of its logarithm are
      taken as normal: `deviation` is the value times the standard deviation of the logarithm, and
      an interval reaches farther up than down.
    - `cuts`: for each body the correlation of the number with the flatness of the body, which is
      (I1 + I2 − I3) / I3, and the flatness divided by its standard deviation. Intervals end where a
      body would be flat.
    - `most`: the largest value of the number that a real body can have.
    - `freedom`: the degrees of freedom of the variance of the number; infinite if all noise is
      given.
    - `least`: the smallest value of the number that a real body can have.

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
    least: float = -np.inf

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Return the low and the high end of the interval of this quantity.

        The interval of a positive quantity is computed for its logarithm. An interval ends where a
        body would be flat (I1 + I2 = I3). If an end of the interval of a positive quantity differs
        from the value by more than a factor of 1e3, the ends are 0 and the field `most`, the
        largest value that a real body can have (infinity by default).

        **Arguments:** `level` the probability that the interval holds the true value. **Raises**
        `ValueError` for a level outside (0, 1).
        """
        reach = float(student_quantile(level, self.freedom))
        wide = log_deviation(self)
        low, high = (float(side) * wide for side in interval_ends(reach, self.cuts))
        if not self.positive:
            return max(self.value + low, self.least), min(self.value + high, self.most)
        if max(-low, high) > np.log(FARTHEST):
            return 0.0, self.most
        return float(self.value * np.exp(low)), min(float(self.value * np.exp(high)), self.most)


def log_deviation(quantity: Quantity) -> float:
    """Return the standard deviation of the logarithm of a positive quantity, else of its value."""
    if not quantity.positive:
        return quantity.deviation
    return quantity.deviation / quantity.value if quantity.value else np.inf


def interval_ends(
    half_width: np.ndarray | float, cuts: Sequence[tuple[np.ndarray | float, float]]
) -> tuple[np.ndarray | float, np.ndarray | float]:
    """Return the ends (low, high) of an interval as differences from the best value, in standard
    deviations; `half_width` is that without the `cuts` of `Quantity`.
    """
    low: Any = -half_width
    high: Any = half_width
    for correlation, away in cuts:
        least, most = flat_limit.cut_interval(half_width, correlation, away)
        low, high = np.maximum(low, least), np.minimum(high, most)
    return low, high


# The units of quantities of a body that are not in the unit of its moments.
_UNITS = {"mass": "kg", "com x": "m", "com y": "m", "com z": "m"}


class Label(NamedTuple):
    name: str
    unit: str
    positive: bool  # whether the quantity is always positive


def labels(model: Model) -> list[Label]:
    """Return a `Label` for each reported quantity, in the order of `quantity_vector`."""
    out = []
    for name, chart in named_charts(model):
        for names, positive in ((chart.log_names, True), (chart.plain_names, False)):
            out += [Label(f"{n}{name}", _UNITS.get(n, chart.unit), positive) for n in names]
    out += starting_labels(model)
    every = zip(parts_of(model), recording_suffixes(model), strict=True)
    suffixes = {slot.name: names for part, names in every for slot in part.model.slots}
    for slot in model.slots:
        names = suffixes[slot.name]
        parts = [""]
        if slot.shape:
            channels = ("fx", "fy", "fz", "tx", "ty", "tz") if slot.shape == (6,) else "xyz"
            axes = dict(enumerate(channels)) if slot.shape in ((3,), (6,)) else {}
            row, places = len(slot.shape) == 1, np.ndindex(slot.shape)
            parts = [f" {axes.get(i[0], i[0] if row else i)}" for i in places]
        ends = names if slot.each else [f" [{label}]" for label in slot.labels] or [""]
        ends = ends if slot.spread is None else [*ends, *(f", own{where}" for where in names)]
        called = [f"{slot.name}{part}{end}" for end in ends for part in parts]
        out += [Label(name, slot.unit, slot.positive) for name in called]
    return out


def reports_starts(model: Model) -> bool:
    """Return whether a fit reports initial states: those that are free and have no prior."""
    return model.index.start.size > 0 and model.start_weight is None


class NamedChart(NamedTuple):
    suffix: str  # of the names of the body's quantities; empty for a single body
    chart: AbstractBodyChart


def named_charts(model: Model) -> list[NamedChart]:
    """Return the chart of each body of a `model`."""
    named = zip(dict.fromkeys(model.body_names), model.charts, strict=True)
    return [NamedChart(f" [{name}]" if name else "", chart) for name, chart in named]


def recording_suffixes(model: Model) -> list[list[str]]:
    """Return for each recording of each kind the suffix of the names of its quantities.

    It has, in brackets, the names of the kind and of the body, if they have one, and the number of
    the recording among those of both; it is empty for a single recording.
    """
    out = []
    for part in parts_of(model):
        bodies, kind = part.model.body_names, []
        for index, name in enumerate(bodies):
            number = [] if len(bodies) == 1 else [str(bodies[:index].count(name))]
            words = " ".join([*filter(None, (part.name, name)), *number])
            kind.append(f" [{words}]" if words and model.count > 1 else "")
        out.append(kind)
    return out


def starting_labels(model: Model) -> list[Label]:
    """Return what the reported numbers of each initial state are called."""
    out = []
    for part, suffixes in zip(parts_of(model), recording_suffixes(model), strict=True):
        names = {"Ωx": "rad/s", "Ωy": "rad/s", "Ωz": "rad/s"}
        if part.model.state_kind is Turn:
            names = {"angle": "rad", "rate": "rad/s"}
        for where in suffixes if reports_starts(part.model) else ():
            out += [Label(f"{name}{where}", unit, False) for name, unit in names.items()]
    return out


def quantity_vector(model: Model, x: Float[Array, " n"]) -> Array:
    """Return the quantities that a fit reports, in the order of `labels`: numbers of each body,
    initial body rates or angles and their rates, and the values of each `Free`; positive ones as
    logarithms.
    """
    parts, bodies = [jnp.zeros(0, x.dtype)], body_list(model.bodies(x))
    for (_, chart), body in zip(named_charts(model), bodies, strict=True):
        parts += [chart.logs(body), chart.plain(body)]
    for part in parts_of(model):
        if reports_starts(one := part.model):
            last = part.take(x)[one.index.start[:, -3:]] * one.reference.units[:, -3:]
            parts.append(last.reshape(-1))
    values = values_of(model, x)
    for slot in model.slots:
        for name in (slot.name, f"{slot.name}, own")[: 1 + (slot.spread is not None)]:
            value = values[name].reshape(-1)
            parts.append(jnp.log(value) if slot.positive else value)
    return jnp.concatenate([part.astype(x.dtype) for part in parts])


@eqx.filter_jit
def _quantities_at(model: Model, x: Float[Array, " n"]) -> FirstOrder:
    """Return the reported quantities (q,) of a `model`, positive ones as logarithms.

    The last entries are the flatness (I1 + I2 − I3) / I3 of each body.
    """
    return value_and_jacfwd(
        lambda x: jnp.concatenate([quantity_vector(model, x), flat_limit.flatness(model, x)]), x
    )


def quantities_on_host(
    model: Model, x: Float[Array, " n"], derivative_point: Float[Array, " n"] | None
) -> FirstOrder:
    """Return the reported quantities at the parameters x in NumPy, with the derivatives at a
    thicker body, the `derivative_point`, if a body is flat at x.
    """
    model = shortened(model)
    values, slopes = map(np.asarray, _quantities_at(model, x))
    if derivative_point is not None:
        slopes = np.asarray(_quantities_at(model, derivative_point).jacobian)
    return FirstOrder(values, slopes)


def reported_quantities(
    model: Model,
    quantities: FirstOrder,
    covariance: np.ndarray,
    null_directions: np.ndarray,
    limits: tuple[flat_limit.Limit, ...] = (),
    degrees_of_freedom: np.ndarray | float = np.inf,
) -> tuple[Quantity, ...]:
    """Return every reported quantity of `quantities_on_host` with its standard deviation.

    The `covariance` (n, n) is that within the directions that the data determine, and
    `null_directions` (k, n) are the others. Intervals end at the `limits`.
    """
    names = labels(model)
    values, slope = (part[: len(names)] for part in quantities)
    deviations = standard_deviations(slope, covariance, null_directions)
    cuts = flatness_cuts(slope, covariance, deviations, limits)
    freedom = np.broadcast_to(degrees_of_freedom, quantities[0].shape)
    # A quantity that does not depend on any parameter, such as a known quantity, gets no
    # deviation (NaN).
    deviations = np.where(np.any(slope != 0, axis=-1), deviations, np.nan)
    close = _deviations_of_close_moments(model, names, values, slope, covariance)
    out = []
    for index, (name, unit, positive) in enumerate(names):
        value, deviation = values[index], deviations[index]
        shown = float(np.exp(value)) if positive else float(value)
        least, most = -np.inf, 1.0 if name.startswith(Ratios.log_names) else np.inf
        mine = tuple((float(rho[index]), away) for rho, away in cuts)
        if close[index] and close[index] > abs(deviation * shown):
            deviation, positive, least, mine = close[index], False, 0.0, ()
        # No number is known better than its round-off.
        smallest = np.finfo(float).eps * (1.0 if positive else abs(shown))
        deviation = float(np.maximum(deviation, smallest)) * (shown if positive else 1.0)
        own = float(freedom[index])
        out.append(Quantity(name, shown, deviation, unit, positive, mine, most, own, least))
    return tuple(out)


def _deviations_of_close_moments(
    model: Model,
    names: list[Label],
    values: np.ndarray,
    slope: np.ndarray,
    covariance: np.ndarray,
) -> Float[np.ndarray, " quantities"]:
    """Return the standard deviations, kg m², of sorted moments whose distance to each other or to
    zero is not large against the noise of the tensor; zero for all other quantities.

    With deviations from first derivatives, 95 % intervals contained only 78 to 89 % of such moments
    (twelve tools). A sorted moment moves by no more than the spectral norm of the noise (Weyl 1912,
    doi:10.1007/BF01456804), whose 95 % quantile is estimated from random draws.
    """
    out, places = np.zeros(len(names)), {name: index for index, (name, *_) in enumerate(names)}
    for suffix, chart in named_charts(model):
        if not {"I1", "Ixx"} <= {*chart.log_names, *chart.plain_names}:
            continue
        moments = [places[f"{name}{suffix}"] for name in ("I1", "I2", "I3")]
        six = slope[[places[f"{name}{suffix}"] for name in Tensor.plain_names]]
        spread = six @ covariance @ six.T
        sizes = np.exp(values[moments])
        if not np.isfinite(spread).all():
            continue
        axes = np.linalg.eigh(spread)
        root = axes[1] * np.sqrt(np.maximum(axes[0], 0.0))
        draws = np.random.default_rng(0).normal(size=(2000, 6)) @ root.T
        norms = np.abs(np.linalg.eigvalsh(np.einsum("dk,kij->dij", draws, BASIS))).max(axis=1)
        wide = float(np.quantile(norms, 0.95))
        close = np.diff([0.0, *sizes, np.inf]) < _CLOSE * wide
        out[moments] = np.where(
            close[1:] | close[:-1], wide / float(student_quantile(0.95, np.inf)), 0.0
        )
    return out


def interval_about(
    value: np.ndarray,
    slope: np.ndarray,
    covariance: np.ndarray,
    null_directions: np.ndarray,
    half_width: np.ndarray | float,
    limits: tuple[flat_limit.Limit, ...] = (),
) -> tuple[np.ndarray, np.ndarray]:
    """Return the low and the high end of the interval of functions of the parameters.

    They have the best values `value` (…) and the derivatives `slope` (…, n). The `half_width` is in
    standard deviations, and without the `limits`, where a body would be flat.
    """
    wide = standard_deviations(slope, covariance, null_directions)
    low, high = interval_ends(half_width, flatness_cuts(slope, covariance, wide, limits))
    return np.asarray(value + low * wide), np.asarray(value + high * wide)


def flatness_cuts(
    slope: np.ndarray,
    covariance: np.ndarray,
    deviations: np.ndarray,
    limits: tuple[flat_limit.Limit, ...],
) -> list[tuple[np.ndarray, float]]:
    """Return the `cuts` of `Quantity` for functions with the derivatives `slope` (…, n), for each
    body whose flatness has a finite standard deviation.
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
    """Return the standard deviations (…) of functions with the derivatives `slope` (…, n).

    A standard deviation is infinite if the function changes along a null direction (k, n). It is
    NaN if the variance is negative or no larger than round-off, or if the function depends on a
    parameter whose correlation with another one is larger than one in magnitude.
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
        values, axes = np.linalg.eigh(scaled[np.ix_(used, used)])
        along = rows[mine][:, used] @ axes
        length = np.linalg.norm(along, axis=-1)
        least = 10 * values.size * np.finfo(float).eps * np.abs(values).max(initial=0.0)
        unreal = np.linalg.norm(along[..., values < -least], axis=-1) > 1e-6 * length
        variance = along**2 @ np.maximum(values, 0.0)
        lost = (length > 0) & (unreal | (variance <= least * length**2))
        deviations = np.where(lost, np.nan, np.sqrt(variance))
        out[mine] = np.nan if beyond[used].any() else deviations
    return np.where(undetermined, np.inf, out.reshape(slope.shape[:-1]))
