"""The result of a fit: the best point, its uncertainty, and the end of each start."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax.identify.answer import answers, undetermined as identifiability
from rigidjax.identify.answer.answers import Answer, Cause
from rigidjax.identify.answer.causes import causes
from rigidjax.identify.answer.undetermined import Combination, undetermined
from rigidjax.identify.model.model import Model, Unpacked, unpacked
from rigidjax.identify.model.terms import Noise
from rigidjax.identify.uncertainty.considered import Consideration
from rigidjax.identify.uncertainty.covariance import Linearised
from rigidjax.identify.uncertainty.degrees_of_freedom import Freedom, quantile
from rigidjax.identify.uncertainty.flat_limit import Limit
from rigidjax.identify.uncertainty.quantities import Quantity, around


class Start(eqx.Module):
    """The result of one start: the end of the search, and whether it explains the data.

    **Fields:** `x` (n,) the free numbers at its end; `cost` half of the sum of squares at x;
    `converged` whether the search converged; `fits` whether it explains the data as well as the
    best point does.

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
    """The result of `fit`: the best point and its uncertainty.

    **Fields:** `model` that was fitted; `x` (n,) the free numbers at the best point; `covariance`
    (n, n) of them, infinite for undetermined numbers, `seen` the
    same within the determined directions, `covariance_kind` its method; `noises` (R, k) for each
    sensor; `starts` a `Start` each; `chi2` and `dof` of the whitened errors of the sensors whose
    noise was given; `correlation` the number of samples over which the errors are autocorrelated, 1
    for white ones, and `independent` the number of independent errors; `singular_values` (n,) of
    the whitened Jacobian, its columns of length one, with the numbers of one recording alone apart;
    `null_directions` (k, n) that the data do not determine; `quantities` all reported quantities,
    by name; `search` the first answer, whose `word` is `found`, `not alone` or `not ended`;
    `explanation` the second one: `explains the readings`, `leaves a part`, `does not explain the
    readings`; `left` the indices of the sensors whose errors it does not explain; `limits` the
    distance of each body from a flat one; `near` the point of the derivatives beside a flat body,
    else `None`; `freedom` what the degrees of freedom of variances follow from;
    `linear` errors and derivatives there, which all of these come from; `considered` the errors of
    sensors that the covariance allows for by their `Tolerance`; `allowance` says so in words, or
    what a sensor that is off would do to the result; `hidden` (k, n) of a fit of windows the
    directions that one stretch of them alone shows, whose variance is infinite.

    >>> found = rj.identify.fit(rj.datasets.toutatis.model())
    >>> [quantity.name for quantity in found.quantities[:2]], found.covariance.shape
    (['Ix/Iz', 'Iy/Iz'], (8, 8))
    """

    model: Model
    x: Float[Array, " n"]
    covariance: Float[Array, "n n"]
    seen: Float[Array, "n n"]
    covariance_kind: str
    noises: Noise
    starts: tuple[Start, ...]
    chi2: float
    dof: int
    correlation: float
    independent: float
    singular_values: Float[Array, " n"]
    null_directions: Float[Array, "unseen n"]
    quantities: tuple[Quantity, ...]
    search: Answer
    explanation: Answer
    left: tuple[int, ...]
    limits: tuple[Limit, ...] = ()
    near: Float[Array, " n"] | None = None
    freedom: Freedom | None = None
    linear: Linearised | None = None
    considered: tuple[Consideration, ...] = ()
    allowance: str = ""
    hidden: Float[Array, "hidden n"] | None = None

    @property
    def status(self) -> str:
        """Both answers in one line; `ok` if both are good and have no reasons."""
        return answers.status(self.search, self.explanation)

    @property
    def ok(self) -> bool:
        """Whether the fit converged, explains the data, and is unique."""
        return self.status == "ok"

    @property
    def derivative_point(self) -> Float[Array, " n"]:
        """The free numbers where derivatives are taken: x, with a flat body made thicker."""
        return self.x if self.near is None else self.near

    @property
    def causes(self) -> tuple[Cause, ...]:
        """What most likely makes the errors that are left, where that shows.

        Each has `name`, `sensor`, `share`, `words` and `remedy`.
        """
        if not self.left or self.linear is None:
            return ()
        return causes(self.model, self.x, self.noises, self.linear, self.left)

    @property
    def advice(self) -> str:
        """Advice: whether the intervals can be trusted, and what to try."""
        # Outliers dominate χ² under a robust loss.
        above = np.sqrt(self.chi2 / self.dof) if self.model.loss is None else 1.0
        return answers.advice(
            self.search,
            self.explanation,
            self.causes,
            self.covariance_kind,
            above,
            self.allowance,
        )

    def __str__(self) -> str:
        from rigidjax.identify import report

        return f"{report.table(report.rows(self))}\n\n{report.verdict(self)}"

    def _repr_html_(self) -> str:
        from rigidjax.identify import report

        return report.as_html(self)

    @property
    def body(self) -> Any:
        """The body, of `scale` "arbitrary" if its chart has none; for several a dict by name."""
        return self.model.bodies(self.x)

    @property
    def state0(self) -> Any:
        """The state at the first time; with several recordings, one for each (leading axis)."""
        return self.model.unpack(self.x).state0

    @property
    def values(self) -> dict[str, Array]:
        """The value of each `Free` by name, in its unit."""
        return self.model.values(self.x)

    @property
    def spreads(self) -> dict[str, Array]:
        """The spread of each `Free` that has one, by name, in its unit: given or estimated."""
        slots = self.model.slots
        return {s.name: s.spread * s.scale for s in slots if s.spread is not None}

    @property
    def noise(self) -> tuple[Float[Array, "*records _"], ...]:
        """One (k,) standard deviation per sensor, given or estimated; (R, k) of R recordings."""
        return tuple(n[0] for n in self.noises) if self.model.count == 1 else self.noises

    @property
    def jitter(self) -> tuple[Float[Array, "*records"] | None, ...]:
        """The deviation of each sensor's time stamps, s, given or estimated; `None` without jitter.

        With several recordings (R,).
        """
        first: Any = 0 if self.model.count == 1 else slice(None)
        sensors = self.model.records.sensors
        found = (getattr(sensor, "jitter", None) for sensor in sensors)
        return tuple(None if one is None else one.deviation[first] for one in found)

    @property
    def residuals(self) -> tuple[Float[Array, "*records times _"], ...]:
        """Reading minus prediction for each sensor, in its unit; zero where masked.

        With several recordings a leading axis.
        """
        errors = self._errors
        return tuple(e[0] for e in errors) if self.model.count == 1 else errors

    @property
    def _errors(self) -> tuple[Float[Array, "records times _"], ...]:
        if self.linear is None:
            raise ValueError("Fit: it holds no errors; identify.fit makes one that does")
        counts = self.model.records.t.shape[1]
        return tuple(jnp.asarray(error[:, :counts]) for error in self.linear.raw)

    @property
    def rms(self) -> tuple[float, ...]:
        """Root mean square length of each sensor's error, in its unit; without full scale."""
        out = []
        errors = self._errors
        for error, reading in zip(errors, self.model.records.readings, strict=True):
            kept = reading.kept.all(axis=-1)
            lengths = np.sum(np.asarray(error) ** 2, axis=-1)[kept if kept.any() else reading.seen]
            out.append(float(np.sqrt(lengths.mean())))
        return tuple(out)

    def interval(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Intervals of all reported quantities, name → (low, high).

        The interval of a positive quantity goes through its logarithm. **Arguments:** `level` the
        probability that an interval holds the true value. **Raises** `ValueError` outside (0, 1).
        """
        return {quantity.name: quantity.interval(level) for quantity in self.quantities}

    def interval_of(
        self, of: Callable[[Unpacked], Any], level: float = 0.95
    ) -> tuple[np.ndarray, np.ndarray]:
        """Interval (low, high) of any differentiable function of `Unpacked` to an array.

        It comes from the covariance and the function's derivative. **Raises** as `interval`.
        """
        _checks.function(of, "of", "of `Unpacked` to an array")
        if not _checks.known(self.x):
            raise TypeError(
                "Fit: wanted known numbers, got traced ones; intervals are made on the host: call "
                "interval_of outside of jax.jit, jax.grad and jax.vmap"
            )

        def value(x: Array) -> Array:
            point = unpacked(self.model, x)
            point = dataclasses.replace(point, noise=self.noises)
            return _checks.numbers(of(point), "of(point)")

        middle = np.asarray(_checks.finite(value(self.x), "of(point)"))
        slope = np.asarray(jax.jacfwd(value)(self.derivative_point))
        seen, null = np.asarray(self.seen), np.asarray(self.null_directions)
        if self.hidden is not None:
            null = np.concatenate([null, np.asarray(self.hidden)])
        reach = quantile(level, self.degrees(slope))
        return around(middle, slope, seen, null, reach, self.limits)

    def degrees(self, slope: np.ndarray) -> np.ndarray:
        """Degrees of freedom of the variances of functions with derivative `slope` (…, n)."""
        return np.full(slope.shape[:-1], np.inf) if self.freedom is None else self.freedom.of(slope)

    @property
    def undetermined(self) -> tuple[Combination, ...]:
        """The combinations of numbers that the data do not determine at all, by name.

        The list is empty if they determine all. Each combination has `names`, `changes` and
        `in_words`.
        """
        return undetermined(self)

    @property
    def identifiability(self) -> tuple[str, ...]:
        """In words: the quantities that the data determine well, weakly, and not at all."""
        return identifiability.identifiability(self)


def one_fit(found: Any, name: str = "fit") -> Fit:
    """`found`, if it is one `Fit`, not many in one container; else `TypeError`, `ValueError`."""
    _checks.instance(found, Fit, name)
    if np.shape(found.chi2) != ():
        raise ValueError(
            f"{name}: wanted one Fit, as identify.fit returns it, got one with a chi2 of shape "
            f"{np.shape(found.chi2)}; take many one by one"
        )
    return found
