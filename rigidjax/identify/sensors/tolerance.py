"""Tolerances of a sensor: how far its scale, axes, bias and clock may be off."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from rigidjax import _checks
from rigidjax._types import Scalar


def _deviation(value: Any) -> Scalar | None:
    if value is None:
        return None
    wanted = "a positive standard deviation"
    return jnp.asarray(np.asarray(_checks.positive(value, "tolerance", wanted)))


class Tolerance(eqx.Module):
    """How far a sensor that reads a vector may be off, as its data sheet or a calibration says.

    No residual of a free motion shows such an error: it is the motion of another body. A fit does
    not estimate these numbers. It considers them: their effect on each fitted number is added to
    its covariance (Schmidt 1966; Bierman, Factorization Methods for Discrete Sequential Estimation
    (1977), ch. VIII). A `Free` that moves the same number estimates it; the tolerance is then its
    prior, unless it has one.

    **Arguments:** standard deviations, `None` for an error that is not considered: `scale` of each
    channel, relative; `cross_axis` the share of each channel that another one reads, rad for a
    small angle; `bias` of each channel, in the sensor's unit; `clock` s, the offset of its clock.
    **Raises** `ValueError` for a number that is not positive.

    >>> gyro = rj.identify.Gyro(0.02, tolerance=Tolerance(scale=0.01, cross_axis=0.01))
    >>> float(gyro.tolerance.scale), gyro.tolerance.bias
    (0.01, None)
    """

    scale: Scalar | None = eqx.field(converter=_deviation, default=None)
    cross_axis: Scalar | None = eqx.field(converter=_deviation, default=None)
    bias: Scalar | None = eqx.field(converter=_deviation, default=None)
    clock: Scalar | None = eqx.field(converter=_deviation, default=None)
