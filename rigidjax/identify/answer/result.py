"""Hold the result of a fit: the best point, its uncertainty, and the end of each start."""

import dataclasses
import html
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from rigidjax import _checks, _show
from rigidjax.body.draws import Draw, as_draw
from rigidjax.identify.answer import answers, undetermined
from rigidjax.identify.answer.answers import Answer, Cause
from rigidjax.identify.answer.causes import causes
from rigidjax.identify.answer.parts import Assessment, BestPoint, HeldOut, Pair, Uncertainty
from rigidjax.identify.answer.table import Row, html_rows, interval_text, numbers, table
from rigidjax.identify.answer.undetermined import Combination, undetermined_combinations
from rigidjax.identify.model.model import Model, Unpacked, shortened, unpack_jacobian
from rigidjax.identify.model.terms import Noise
from rigidjax.identify.uncertainty.covariance import Linearisation, residuals_by_name
from rigidjax.identify.uncertainty.degrees_of_freedom import student_quantile
from rigidjax.identify.uncertainty.quantities import Quantity, interval_about


class Start(eqx.Module):
    """Hold the end of the search from one start.

    **Fields:**

    - `x`: (n,) the parameters at the end.
    - `cost`: half of the sum of squared residuals at x.
    - `converged`: whether the search converged.
    - `fits`: whether x explains the data as well as the best point of all starts does.

    >>> record = rj.identify.Recording([0.0, 1.0], (rj.identify.Gyro(), [[1.0, 0, 0]] * 2))
    >>> model = rj.identify.Model(record, rj.identify.PrincipalRatios())
    >>> Start(model.start(), 0.0, True, True).fits
    True
    """

    x: Float[Array, " n"]
    cost: float
    converged: bool
    fits: bool


class Fit(eqx.Module):
    """Hold the result of `fit`: the best point and its uncertainty.

    **Fields:**

    - `point`: the best point, a `BestPoint`. Of its fields `fit.model`, `fit.x` and
      `fit.noises` are short forms.
    - `uncertainty`: the `Uncertainty` of x. Of its fields `fit.covariance`,
      `fit.determined_covariance`, `fit.covariance_kind` and others are short forms.
    - `assessment`: the answers on the search and on the model, an `Assessment`. Of its fields
      `fit.search`, `fit.explanation`, `fit.chi2` and others are short forms.
    - `quantities`: all reported quantities.
    - `starts`: a `Start` for each starting point.
    - `linear`: the residuals and their derivatives at the best point, from which the covariance and
      the answers are computed.
    - `place`: where the fit was computed, in words, if that is not JAX's default device.
    - `held_out`: how well a fit of a part of the readings predicts the rest, a `HeldOut`, or
      `None` if nothing was held out.

    >>> result = rj.identify.fit(rj.datasets.toutatis.model())
    >>> [quantity.name for quantity in result.quantities[:2]], result.covariance.shape
    (['Ix/Iz', 'Iy/Iz'], (8, 8))
    """

    point: BestPoint
    uncertainty: Uncertainty
    assessment: Assessment
    quantities: tuple[Quantity, ...]
    starts: tuple[Start, ...]
    linear: Linearisation | None = None
    place: str = ""
    held_out: HeldOut | None = None

    @property
    def model(self) -> Model:
        """Return the model that was fitted."""
        return self.point.model

    @property
    def x(self) -> Float[Array, " n"]:
        """Return the parameters (n,) at the best point."""
        return self.point.x

    @property
    def noises(self) -> Noise:
        """Return the deviations (R, k) of the errors of each sensor in R recordings."""
        return self.point.noises

    @property
    def covariance(self) -> Float[Array, "n n"]:
        """Return the covariance (n, n) of x, infinite where the data do not determine x."""
        return self.uncertainty.covariance

    @property
    def determined_covariance(self) -> Float[Array, "n n"]:
        """Return the covariance (n, n) of x within the directions that the data determine."""
        return self.uncertainty.determined

    @property
    def covariance_kind(self) -> str:
        """Return the method by which the covariance was computed, in words."""
        return self.uncertainty.kind

    @property
    def null_directions(self) -> Float[Array, "unseen n"]:
        """Return the directions (k, n) of x that the data do not determine."""
        return self.uncertainty.null_directions

    @property
    def search(self) -> Answer:
        """Return the answer about the search: `found`, `not alone` (another motion fits as well),
        or `not ended`.
        """
        return self.assessment.search

    @property
    def explanation(self) -> Answer:
        """Return the answer on the model, such as `explains the readings`."""
        return self.assessment.explanation

    @property
    def chi2(self) -> float:
        """Return χ², summed over the sensors whose noise was given."""
        return self.assessment.chi2

    @property
    def dof(self) -> int:
        """Return the degrees of freedom of χ²."""
        return self.assessment.dof

    @property
    def correlation(self) -> float:
        """Return the number of samples over which the errors are autocorrelated."""
        return self.assessment.correlation

    @property
    def status(self) -> str:
        """Return the two answers of this fit in one line: `search` (did the search find the best
        point?) and `explanation` (does the model explain the readings?).

        The line is `ok` if the search found the best point, the model explains the readings, and
        neither answer has a reason. It is, for example, `ok, if the Gyro is right to 0.1 %` if
        no `Tolerance` says how far the sensor may be off, and an error of 0.1 % in the scale of an
        axis, which no residual shows, would move a moment by half of its interval.
        """
        line = answers.joined_status(self.search, self.explanation)
        condition = self.uncertainty.condition
        return f"{line}, {condition}" if line == "ok" and condition else line

    @property
    def ok(self) -> bool:
        """Return whether the `status` of this fit is `ok`, perhaps with a condition on a sensor.

        If it is, the search has converged, the model explains the readings, and no other motion
        fits as well.
        """
        return answers.joined_status(self.search, self.explanation) == "ok"

    @property
    def causes(self) -> tuple[Cause, ...]:
        """Return the most likely causes of the errors of this fit that the model does not explain.

        The tuple is empty if the readings show no cause. Each cause has the fields `name`,
        `sensor`, `share`, `words` and `remedy`.
        """
        if not self.assessment.left or self.linear is None:
            return ()
        # Each refit of a cause takes time, and a report asks several times: the causes of the fit
        # that was asked for last are kept, but not its arrays.
        if _last_causes[0]() is not self.linear:
            parts = self.model, self.x, self.noises, self.linear, self.assessment.left
            _last_causes[:] = weakref.ref(self.linear), causes(*parts)
        return _last_causes[1]

    @property
    def advice(self) -> str:
        """Return words that say whether the intervals of this fit can be trusted, and what to
        try.
        """
        # Do not use χ² under a robust loss: outliers would dominate χ².
        error_ratio = np.sqrt(self.chi2 / self.dof) if self.model.loss is None else 1.0
        words = answers.advice(
            self.search,
            self.explanation,
            self.causes,
            self.covariance_kind,
            error_ratio,
            self.uncertainty.allowance,
        )
        lost = ["the unknown torque as zero"] if self.model.process is not None else []
        lost += ["the walks as constant"] if self.model.walks else []
        if not lost:
            return words
        return (
            f"A fit takes {' and '.join(lost)}: for the motion use identify.filter or smooth, for "
            f"the numbers identify.refit(identify.LogDensity(fit)). {words}"
        )

    def __str__(self) -> str:
        return f"{table(rows(self))}\n\n{verdict(self)}"

    def _repr_html_(self) -> str:
        """Return HTML that a notebook shows for this fit: the status, a table of the quantities,
        and the verdict, which says in words whether the fit can be trusted, and what to try.
        """
        return as_html(self)

    @property
    def body(self) -> Any:
        """Return the fitted body, or a dict of name → body for several bodies.

        The field `scale` of a body is "arbitrary" if the fit finds its inertia only up to a factor.
        This happens if the chart, which maps parameters to the body, describes ratios of moments.
        """
        return self.model.unpack(self.x).body

    @property
    def state0(self) -> Any:
        """Return the fitted state of the body at the first time of the recording.

        For several recordings the state has a leading axis; of several kinds of recordings it is a
        dict by kind.
        """
        return self.model.unpack(self.x).state0

    @property
    def values(self) -> dict[str, Array]:
        """Return a dict of name → fitted value with one entry for each `Free` (a number of a torque
        or sensor that the fit may move), in the unit of this number.
        """
        return self.model.unpack(self.x).values

    @property
    def spreads(self) -> dict[str, Array]:
        """Return a dict of name → spread for each `Free` (a number that the fit may move) that has
        a spread, given or estimated.

        A `Free` with a spread has another value in each recording. The spread is the standard
        deviation of these values about the value that the recordings share, in the unit of the
        `Free`.
        """
        slots = self.model.slots
        return {s.name: s.spread * s.scale for s in slots if s.spread is not None}

    @property
    def noise(self) -> tuple[Float[Array, "*records _"], ...]:
        """Return the standard deviations (k,) of the noise of each sensor, given or estimated.

        Here k is the number of components of an error. For R > 1 recordings the shape is (R, k).
        """
        return tuple(n[0] for n in self.noises) if self.model.count == 1 else self.noises

    @property
    def residuals(self) -> tuple[Float[Array, "*records times _"], ...]:
        """Return the residuals of each sensor, reading minus prediction, in the unit of the sensor.

        The residual of a masked reading is zero. For several recordings the residuals have a
        leading axis.
        """
        errors = self._unpadded_errors
        return tuple(e[0] for e in errors) if self.model.count == 1 else errors

    @property
    def _unpadded_errors(self) -> tuple[Float[Array, "records times _"], ...]:
        """Return the residuals (R, T, k) of each sensor, reading minus prediction, in the sensor's
        unit.

        R is the number of recordings, T the number of samples in time and k the number of
        components of an error. The masked readings that a fit adds at the end of recordings are
        left out. **Raises** `ValueError` for a fit that does not hold its errors (`linear` is
        `None`).
        """
        if self.linear is None:
            raise ValueError(
                "Fit: wanted one with its errors, as identify.fit returns it, got linear = None"
            )
        counts = self.model.records.t.shape[1]
        return tuple(jnp.asarray(error[:, :counts]) for error in self.linear.raw)

    @property
    def rms(self) -> tuple[float, ...]:
        """Return the root mean square length of the errors of each sensor, in the sensor's unit.

        Readings at full scale are left out.
        """
        out = []
        errors = self._unpadded_errors
        for error, reading in zip(errors, self.model.records.readings, strict=True):
            mask = reading.usable.all(axis=-1)
            lengths = np.sum(np.asarray(error) ** 2, axis=-1)[
                mask if mask.any() else reading.host_mask
            ]
            out.append(float(np.sqrt(lengths.mean())))
        return tuple(out)

    def interval(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Return the intervals of all reported quantities, as a dict of name → (low, high).

        The interval of a positive quantity is computed for its logarithm, and then transformed
        back. **Arguments:** `level` is the probability that an interval holds the true value.
        **Raises** `ValueError` for a level outside (0, 1).
        """
        return {quantity.name: quantity.interval(level) for quantity in self.quantities}

    def interval_of(
        self, function: Callable[[Unpacked], Any], level: float = 0.95
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the interval (low, high) of a differentiable function of the fitted numbers.

        The interval is computed from the covariance and the derivative of the function.

        **Arguments:**

        - `function`: a function of an `Unpacked`, which holds the body, the initial states and the
          values of all `Free`s. It returns an array.
        - `level`: the probability that the interval holds the true value.

        **Raises** as `interval`, and `TypeError` for a function that returns whole numbers.
        """
        _, low, high = value_and_interval_of(self, function, level)
        return low, high

    def to_frame(self, rate_unit: str = "rad/s") -> Any:
        """Return the reported quantities of this fit as a `DataFrame` of pandas.

        A row has the name of a quantity as its index, the value, the ends `low` and `high` of the
        95 % interval, and the unit. The unit of rates is `rate_unit`: `rad/s`, `deg/s` or
        `deg/day`. **Raises** `ModuleNotFoundError` without pandas.
        """
        pandas = _checks.import_library("pandas", "frames", "to_frame")
        columns = ["name", "value", "low", "high", "unit"]
        return pandas.DataFrame(rows(self, rate_unit), columns=columns).set_index("name")

    def bodies(self, key: PRNGKeyArray, count: int = 1000) -> Draw | dict[str, Draw]:
        """Return random bodies that agree with the readings, for simulations with many bodies.

        The numbers that describe the body (`Model` says which) are drawn from the normal
        distribution about the fitted ones with the covariance of this fit. Any such numbers
        describe a possible body. If there are more draws than numbers, their mean and covariance
        are those of the fit without the scatter of random draws.

        **Arguments:**

        - `key`: a key of `jax.random`.
        - `count`: the number of draws.

        **Returns** a `rj.body.Draw` with a leading axis of draws; of several bodies a dict of name
        → `Draw`. The bodies of a fit that shows only ratios have an arbitrary scale. **Raises**
        `ValueError` if the readings do not determine the whole body.

        >>> import jax
        >>> result = rj.identify.fit(rj.datasets.toutatis.model())
        >>> result.bodies(jax.random.key(0), 100).moments.shape
        (100, 3)
        """
        key, count = _checks.random_key(key), _checks.integer(count, "count", 1)
        size = self.model.index.bodies
        if not np.isfinite(np.asarray(self.covariance)[:size, :size]).all():
            raise ValueError(
                "bodies: the readings do not determine the whole body; fit.identifiability says "
                "what is missing: record more motion, give a prior, or fit fewer numbers"
            )
        covariance = np.asarray(self.determined_covariance)[:size, :size]
        deviation = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
        square, axes = np.linalg.eigh(covariance / np.outer(deviation, deviation))
        root = deviation[:, None] * axes * np.sqrt(np.maximum(square, 0.0))
        z = jax.random.normal(key, (count, size), self.x.dtype)
        return _draw_bodies(shortened(self.model), self.x[:size], jnp.asarray(root, z.dtype), z)

    @property
    def undetermined_combinations(self) -> tuple[Combination, ...]:
        """Return the combinations of numbers that the data of this fit do not determine at all.

        A combination is a set of numbers that may change together without changing a reading. The
        tuple is empty if the data determine all numbers. Each combination has the members
        `names`, `changes` and `in_words`.
        """
        return undetermined_combinations(self.point, self.null_directions)

    @property
    def identifiability(self) -> tuple[str, ...]:
        """Describe what the data of this fit do not determine, and what they cannot show."""
        return undetermined.describe_identifiability(
            self.point, self.uncertainty, self.assessment, self.quantities
        )


@eqx.filter_jit
def _draw_bodies(model: Model, x: Array, root: Array, z: Array) -> Draw | dict[str, Draw]:
    """Return the bodies at the parameters `x + root z` for each row z of normal numbers."""
    if len(z) > x.size:
        z = z - z.mean(axis=0, keepdims=True)
        own = jnp.linalg.cholesky(z.T @ z / (len(z) - 1))
        z = solve_triangular(own, z.T, lower=True).T

    def draws(row: Array) -> Draw | dict[str, Draw]:
        bodies = model.bodies(x + jnp.sum(root * row[None], 1))
        if isinstance(bodies, dict):
            return {name: as_draw(body) for name, body in bodies.items()}
        return as_draw(bodies)

    return jax.vmap(draws)(z)


# A weak reference to the `linear` of a fit, and its causes.
_last_causes: list[Any] = [lambda: None, ()]


def value_and_interval_of(
    fit: Fit, function: Callable[[Unpacked], Any], level: float = 0.95
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the value of a differentiable function of the fitted numbers, and its interval as two
    arrays, the low ends and the high ends.

    Value and derivative come from one evaluation, so that JAX compiles one program for both. The
    arguments and errors are those of `Fit.interval_of`, with the `fit` in front.
    """
    _checks.require_function(function, "function", "of `Unpacked` to an array")
    if not _checks.is_known(fit.x):
        raise TypeError(
            "Fit: wanted known numbers, got traced ones; intervals are made on the host: call "
            "interval_of outside of jax.jit, jax.grad and jax.vmap"
        )

    def value(point: Unpacked) -> Array:
        point = dataclasses.replace(point, noise=fit.noises)
        return _checks.differentiable_array(function(point), "function(point)")

    point, slopes = unpack_jacobian(shortened(fit.model), fit.point.derivative_point)
    both = lambda step: jax.jvp(value, (point,), (step,))  # noqa: E731
    # Under `vmap` the value may come once for each of the n derivatives; all of these are equal.
    values, slope = jax.vmap(both, in_axes=-1, out_axes=(0, -1))(slopes)
    best = values[0] if fit.point.near is None else value(fit.model.unpack(fit.x))
    middle, slope = np.asarray(_checks.require_finite(best, "function(point)")), np.asarray(slope)
    determined, null = np.asarray(fit.determined_covariance), np.asarray(fit.null_directions)
    uncertainty = fit.uncertainty
    if uncertainty.hidden_directions is not None:
        null = np.concatenate([null, np.asarray(uncertainty.hidden_directions)])
    reach = student_quantile(level, uncertainty.degrees_of_freedom(slope))
    return middle, *interval_about(middle, slope, determined, null, reach, uncertainty.limits)


def require_one_fit(fit: PyTree, name: str = "fit") -> Fit:
    """Return the `fit`, or raise an error that calls it `name`.

    A `TypeError` is raised unless `fit` is a `Fit`, and a `ValueError` if it is a batch of fits.
    """
    _checks.require_instance(fit, Fit, name)
    if np.shape(fit.chi2) != ():
        raise ValueError(
            f"{name}: wanted one Fit, as identify.fit returns it, got a batch with a chi2 of shape "
            f"{np.shape(fit.chi2)}; give its fits one by one"
        )
    return fit


def rows(fit: Fit, rate_unit: str = "rad/s") -> list[Row]:
    """Return all results of a fit as rows (name, value, low, high, unit), where low and high are
    the ends of the 95 % interval.

    **Arguments:**

    - `fit`: a result of `rigidjax.identify.fit`.
    - `rate_unit`: the unit of all angular rates, such as initial rates and biases of gyros:
      `rad/s`, `deg/s` or `deg/day`.

    >>> result = rj.identify.fit(rj.datasets.toutatis.model())
    >>> name, value, low, high, unit = rows(result)[0]
    >>> name, round(value, 1), low < value < high
    ('Ix/Iz', 3.1, True)
    """
    require_one_fit(fit)
    bounds = fit.interval(0.95)
    out: list[Row] = []
    for quantity in fit.quantities:
        low, high = bounds[quantity.name]
        scale, unit = _show.shown_unit(quantity.unit, rate_unit)
        name = quantity.name
        if name.startswith("Ω") or name.split(" [")[0] in ("angle", "rate"):
            axis, *where = name.split(" ", 1)
            name = " ".join([axis, "at the start", *where])
        out.append((name, quantity.value * scale, low * scale, high * scale, unit))
    return out


def verdict(fit: Fit, rate_unit: str = "rad/s") -> str:
    """Return in words whether the search of a fit found the best point, whether the model explains
    the readings, what to try, and what the data do not determine.

    **Arguments:** `fit` a result of `rigidjax.identify.fit`; `rate_unit` the unit of the errors of
    rates that were held out, as for `rows`.

    >>> result = rj.identify.fit(rj.datasets.toutatis.model())
    >>> verdict(result).splitlines()[0]
    'status: ok'
    """
    require_one_fit(fit)
    good = [start for start in fit.starts if start.fits]
    both = [f"search: {fit.search}", f"model: {fit.explanation}"]
    lines = [f"status: {fit.status}"] if fit.ok else both
    lines += [str(cause) for cause in fit.causes] + [fit.advice]
    words = "reached a motion that fits as well as the best"
    if not fit.explanation.word == answers.FAILS:
        words += ", all the same one" if fit.ok and len(good) > 1 else ""
    else:
        lowest = min(start.cost for start in fit.starts)
        good = [start for start in fit.starts if start.cost <= 1.01 * lowest]
        words = "ended within 1 % of the least misfit, which does not explain the readings"
    lines.append(f"starts: {len(good)} of {len(fit.starts)} {words}")
    if fit.held_out is not None:
        pairs = []
        for pair in fit.held_out.pairs:
            scale, unit = _show.shown_unit(pair.unit, rate_unit)
            before = None if pair.before is None else scale * pair.before
            sizes = scale * pair.fitted, scale * pair.held_out, before
            pairs.append(Pair(pair.sensor, unit, *sizes))
        lines.append(f"held out: {dataclasses.replace(fit.held_out, pairs=tuple(pairs))}")
    for name, off in residuals_by_name(fit.model, fit.linear) if fit.linear is not None else ():
        lines.append(f"measured {name}: {off:+.2g} standard deviations from the fit")
    lines += [f"- {line}" for line in fit.identifiability]
    lines += [fit.place] if fit.place else []
    if fit.x.dtype == np.float32:
        lines.append(
            "A fit is better in float64: this one was computed in float32, with seven digits. "
            "jax.config.update('jax_enable_x64', True) at the start of the program, before any "
            "array is made, gives float64."
        )
    return "\n".join(lines)


def as_html(fit: Fit, rate_unit: str = "rad/s", more: Sequence[Row] = ()) -> str:
    """Return a fit as HTML, for a page or a notebook: its status, a table of its quantities, and
    the verdict, which says in words whether the fit can be trusted, and what to try.

    **Arguments:**

    - `fit`: a result of `rigidjax.identify.fit`.
    - `rate_unit`: the unit of all angular rates: `rad/s`, `deg/s` or `deg/day`.
    - `more`: rows (name, value, low, high, unit) of further quantities.

    >>> result = rj.identify.fit(rj.datasets.toutatis.model())
    >>> as_html(result).startswith("<p") and "Ix/Iz" in as_html(result)
    True
    """
    lines = html_rows(
        (name, (shown := numbers(*three))[0], interval_text(shown), unit)
        for name, *three, unit in (*rows(fit, rate_unit), *more)
    )
    head, *words = verdict(fit, rate_unit).splitlines()
    said = "".join(f"<li>{html.escape(line.removeprefix('- '))}</li>" for line in words)
    colour = "#009E73" if fit.ok else "#D55E00"
    return f"""<p style="color: {colour}; font-weight: 600">{html.escape(head)}</p>
<table><tr><th></th><th>value</th><th>95 % interval</th><th>unit</th></tr>{lines}</table>
<p>Covariance: {html.escape(fit.covariance_kind)}.</p>
<ul>{said}</ul>"""
