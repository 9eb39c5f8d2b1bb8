"""Hold the parts of a fit: its best point, its uncertainty, and its answers."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from rigidjax.identify.answer.answers import Answer
from rigidjax.identify.model.model import Model
from rigidjax.identify.model.terms import Noise
from rigidjax.identify.uncertainty.considered import Consideration
from rigidjax.identify.uncertainty.degrees_of_freedom import Freedom
from rigidjax.identify.uncertainty.flat_limit import Limit


class BestPoint(eqx.Module):
    """Hold the best point of a fit.

    **Fields:**

    - `model`: the model that was fitted.
    - `x`: (n,) the parameters at the best point.
    - `noises`: for each sensor the standard deviations (R, k) of the k components of its errors in
      each of R recordings.
    - `near`: if a body is flat at x, the parameters (n,) of a slightly thicker body, at which
      derivatives are taken, because the derivative of the thickness is zero at a flat body; else
      `None`.
    """

    model: Model
    x: Float[Array, " n"]
    noises: Noise
    near: Float[Array, " n"] | None = None

    @property
    def derivative_point(self) -> Float[Array, " n"]:
        """Return the parameters at which derivatives are taken: x, or `near` at a flat body."""
        return self.x if self.near is None else self.near


class Uncertainty(eqx.Module):
    """Hold the covariance of the n parameters of a fit, and what its intervals are made of.

    **Fields:**

    - `covariance`: (n, n) the covariance; infinite for parameters that the data do not determine.
    - `determined`: (n, n) the covariance within the directions that the data determine.
    - `kind`: the method by which the covariance was computed, in words.
    - `null_directions`: (k, n) the directions of x that the data do not determine.
    - `hidden_directions`: (k, n) for a fit of windows the directions of x that only one stretch (a
      run of neighbouring windows) shows. The variance along these directions is infinite.
    - `limits`: for each body with free moments its distance from a flat body, whose principal
      moments are I1 + I2 = I3. No real body lies beyond this limit.
    - `freedom`: what gives the degrees of freedom of the variance of any quantity; `None` takes
      them as infinite.
    - `considered`: the sensor errors that the covariance allows for by a `Tolerance`.
    - `allowance`: the sentences on the sensor errors that the intervals allow for.
    - `condition`: the condition under which the intervals are right, such as "if the Gyro is right
      to 0.1 %": an error of this size would move a moment by half of its interval. It is empty if
      each sensor has a `Tolerance`, or if an error of 1 % moves less.
    """

    covariance: Float[Array, "n n"]
    determined: Float[Array, "n n"]
    kind: str
    null_directions: Float[Array, "unseen n"]
    hidden_directions: Float[Array, "hidden n"] | None = None
    limits: tuple[Limit, ...] = ()
    freedom: Freedom | None = None
    considered: tuple[Consideration, ...] = ()
    allowance: str = ""
    condition: str = ""

    def degrees_of_freedom(self, slope: np.ndarray) -> np.ndarray:
        """Return the degrees of freedom (…,) of variances of functions with slopes (…, n)."""
        if self.freedom is None:
            return np.full(slope.shape[:-1], np.inf)
        return self.freedom.of_variance(slope)


class Assessment(eqx.Module):
    """Hold the two answers of a fit, and the numbers that they rest on.

    **Fields:**

    - `search`: the answer on the search; its `word` is `found`, `not alone` or `not ended`.
    - `explanation`: the answer on the model; its `word` is `explains the readings`, `leaves a part`
      or `does not explain the readings`.
    - `left`: the indices of the sensors whose errors the model does not explain.
    - `chi2`: χ², summed over the sensors whose noise was given.
    - `dof`: the degrees of freedom of χ².
    - `correlation`: the number of samples over which the errors are autocorrelated; 1 for white
      errors.
    """

    search: Answer
    explanation: Answer
    left: tuple[int, ...]
    chi2: float
    dof: int
    correlation: float


class Pair(eqx.Module):
    """Hold the errors of a sensor's readings that were fitted, and of those held out.

    **Fields:**

    - `sensor`: the class of the sensor.
    - `unit`: the unit of the errors.
    - `fitted`: the root mean square length of the errors of the fitted readings.
    - `held_out`: that of the errors with which the fit of the rest predicts the held-out readings.
    - `before`: the same for the body that one had before, or `None`.
    """

    sensor: str
    unit: str
    fitted: float
    held_out: float
    before: float | None = None

    def __str__(self) -> str:
        before = "" if self.before is None else f", before {self.before:.3g}"
        size = f"{self.sensor} {self.held_out:.3g} {self.unit}".rstrip()
        return f"{size} (fitted {self.fitted:.3g}{before})"


class HeldOut(eqx.Module):
    """Hold how well a fit of a part of the readings predicts the rest, the part held out.

    **Fields:**

    - `part`: the part held out, in words.
    - `pairs`: a `Pair` for each sensor that reads something in this part.
    - `ratio`: the errors of the prediction divided by those that the noise and the uncertainty of
      the fit make: about 1 if the model is right.
    - `chance`: the probability of such errors if the model is right.
    """

    part: str
    pairs: tuple[Pair, ...]
    ratio: float
    chance: float

    def __str__(self) -> str:
        pairs = ", ".join(map(str, self.pairs))
        return f"{self.part}: {pairs}, {self.ratio:.3g} times what noise and uncertainty make"
