"""Describe how far the scale, axes, bias and clock of a sensor may be off."""

from types import NoneType
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from rigidjax import _checks, _show
from rigidjax._types import NumbersLike, Scalar


def _deviation_field(name: str) -> Any:
    """Return a field of `Tolerance`: a positive standard deviation, or `None`."""

    def convert(value: NumbersLike | None) -> Scalar | None:
        if value is None:
            return None
        wanted = f"a positive standard deviation; leave {name} out for no error"
        return jnp.asarray(np.asarray(_checks.positive_float(value, f"Tolerance: {name}", wanted)))

    return eqx.field(converter=convert, default=None)


class Tolerance(eqx.Module):
    """Hold the standard deviations of the constant errors that a sensor of vectors may have.

    The numbers come from the data sheet of the sensor or from a calibration.

    The residuals of a fit to a free motion do not show such an error: readings with the error look
    like the motion of another body. A fit does not estimate these errors but considers them: it
    adds their effect on each fitted number to the covariance of the number (Schmidt 1966; Bierman,
    Factorization Methods for Discrete Sequential Estimation (1977), ch. VIII). If the scale, skew,
    bias or clock offset of the sensor is a `Free`, the fit estimates this error; the tolerance is
    then the prior of the `Free`, unless the `Free` has its own prior.

    Instead of a `Tolerance` a sensor takes a word: "phone" or "consumer" (scale 2 %, cross-axis
    0.012), "industrial" (0.3 %, 0.0017) or "calibrated" (0.1 %, 0.0009).

    **Arguments**, each a standard deviation, or `None` for an error that is not considered:

    - `scale`: the relative error of the scale of each channel.
    - `cross_axis`: the fraction of the quantity along one axis that the channel of another axis
      reads. For an axis that is turned by a small angle this fraction is the angle, rad.
    - `bias`: the bias of each channel, in the sensor's unit.
    - `clock`: the offset of the sensor's clock, s.

    **Raises** `ValueError` for a number that is not positive.

    >>> gyro = rj.identify.Gyro(0.02, tolerance=Tolerance(scale=0.01, cross_axis=0.01))
    >>> float(gyro.tolerance.scale), gyro.tolerance.bias
    (0.01, None)
    """

    scale: Scalar | None = _deviation_field("scale")
    cross_axis: Scalar | None = _deviation_field("cross_axis")
    bias: Scalar | None = _deviation_field("bias")
    clock: Scalar | None = _deviation_field("clock")

    __repr__ = _show.fields_as_text


# These words stand for the tolerances of sensors of one class, rounded from data sheets. Phone and
# consumer: the MPU-6050 has ±3 % of scale, ±2 % more by temperature, and ±2 % across axes.
# Industrial: the ADIS16475 has ±0.1° between axes. Calibrated: the ADIS16495 has ±0.05°.
_WORDS = {
    "phone": (0.02, 0.012),
    "consumer": (0.02, 0.012),
    "industrial": (0.003, 0.0017),
    "calibrated": (0.001, 0.0009),
}


def tolerance_of(tolerance: object) -> Tolerance | None:
    """Return `tolerance` if it is a `Tolerance` or `None`, or the `Tolerance` of a word."""
    if isinstance(tolerance, str):
        deviations: Any = _WORDS[_checks.require_option(tolerance, tuple(_WORDS), "tolerance")]
        return Tolerance(*deviations)
    wanted = "Tolerance(scale=…, cross_axis=…, bias=…, clock=…), a word such as 'phone', or None"
    return _checks.require_instance(
        tolerance, (Tolerance, NoneType), "tolerance", requirement=wanted
    )
