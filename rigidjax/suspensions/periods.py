"""Compute the period of a swing."""

import math

import numpy as np

from rigidjax import _checks
from rigidjax._types import Scalar, ScalarLike
from rigidjax.body.inertia import Inertia, MassProperties, tensor_of
from rigidjax.motion.suspension import AbstractSuspension
from rigidjax.motion.torques.base import in_precision


def period(
    body: Inertia | MassProperties, suspension: AbstractSuspension, amplitude: ScalarLike = 0.0
) -> Scalar:
    """Return the period of a free swing, s.

    **Arguments:** `body`, `suspension` as for `simulate`; `amplitude`, rad: the largest angle from
    the place of rest, less than π. 0 gives the period of small swings; it is an ordinary point. The
    friction and the law `torque` of the suspension are not counted. For an `Axle` the period is
    `4K/ω₀`, by the arithmetic–geometric mean; for `Strings` an integral, with the energy of the
    lift. First and second derivatives by all numbers are right. **Raises:** `ValueError` for an
    amplitude of π or more, and if the body cannot swing so far; `TypeError` if body and suspension
    do not fit together.

    >>> plate = rj.shapes.box(1.2, [0.3, 0.3, 0.02])
    >>> bifilar = rj.suspensions.Strings(2, 0.1, 0.1, 0.8)
    >>> [round(float(period(plate, bifilar, a)), 6) for a in (0.0, 0.5)]
    [2.197911, 2.232517]
    """
    _checks.require_instance(suspension, AbstractSuspension, "suspension")
    body = suspension.require_body(body)
    angle = _checks.finite_array(amplitude, (), "amplitude", unit="rad")
    if _checks.is_known(angle) and not abs(angle) < math.pi:
        raise ValueError(f"amplitude: wanted an angle below π, rad, got {float(angle):.6g}")
    dtype = tensor_of(body).dtype
    found = in_precision(suspension, dtype).period(body, angle.astype(dtype))
    if _checks.is_known(found) and np.isnan(found):
        raise ValueError(
            f"period: {suspension} does not swing this body by {float(angle):.4g} rad: are its "
            "axis, gravity and stiffness not zero, and its strings long enough?"
        )
    return found
