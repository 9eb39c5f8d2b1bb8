"""Compute the uncertainty to expect from a planned recording."""

from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax.identify.model.model import (
    Model,
    checked_x,
    error_jacobians,
    error_slopes_by_delay,
)
from rigidjax.identify.model.normal import normal_matrix
from rigidjax.identify.model.terms import measured_residuals, scaled_slopes
from rigidjax.identify.sensors.base import extras
from rigidjax.identify.uncertainty import flat_limit
from rigidjax.identify.uncertainty.covariance import Linearisation, white_covariance
from rigidjax.identify.uncertainty.quantities import (
    Quantity,
    quantities_on_host,
    reported_quantities,
)


def expected_quantities(model: Model, x: Float[Array, " n"]) -> tuple[Quantity, ...]:
    """Return the quantities that a fit of planned recordings would report, with their standard
    deviations.

    **Arguments:**

    - `model`: a model whose recordings hold the planned times and the sensors, with known noise;
      the values of the readings do not matter. Numbers that are `measured` beside them count as
      readings, such as the period of a swing; priors do not count.
    - `x`: (n,) the parameters of the planned motion, such as `Model.start` returns.

    **Returns** the same quantities as `Fit.quantities` (`name`, `value`, and `deviation` in the
    same `unit`). The standard deviations are the least that an unbiased estimate can have (the
    Cramér–Rao bound), and infinite for a quantity that the motion does not determine. Their
    `freedom` is infinite, also for windows, where a fit has C − 1 degrees of freedom for C
    stretches of neighbouring windows: with few stretches its intervals are wider. **Raises:**
    `ValueError` for a sensor whose noise is not given, or numbers that are not finite.

    >>> model = rj.datasets.toutatis.model()
    >>> plan = model.start(rj.Inertia.from_principal(3.1, 3.2, 1.0))
    >>> bool(expected_quantities(model, plan)[0].deviation < 1.0)
    True
    """
    if not _checks.is_known((model, x)):
        raise TypeError(
            "model, x: wanted known numbers, got traced ones; call it outside of jax.jit, jax.grad "
            "and jax.vmap, or differentiate identify.fisher"
        )
    _require_known_noise(model, x)
    near = flat_limit.thicken(model, x)
    rows, extra = jax.tree.map(np.asarray, _rows(model, x if near is None else near))
    if not all(np.isfinite(block).all() for block in (*rows, extra)):
        raise ValueError(
            "expected_quantities: wanted a finite Fisher information, got NaN or infinity; the "
            "recordings of model hold NaN, or the motion of x overflows"
        )
    # The readings are planned: their residuals are zero.
    zeros, none = tuple(block[..., 0] * 0.0 for block in rows), np.zeros(model.size)
    weights = tuple(np.ones(block.shape[:2]) for block in rows)
    mask = tuple(np.ones(block.shape, bool) for block in zeros)
    places = np.asarray(model.index.places)
    linear = Linearisation(
        zeros, rows, zeros, rows, weights, mask, places, none, none, 0.0 * extra[:, 0], extra
    )
    white = white_covariance(linear)
    numbers = quantities_on_host(model, x, near)
    return reported_quantities(model, numbers, white.determined, white.null_directions)


def fisher(model: Model, x: Float[Array, " n"]) -> Float[Array, "n n"]:
    """Return Fisher's information matrix `Jᵀ Σ⁻¹ J` (n, n) of the parameters x.

    J holds the derivatives of all predictions and `Measured` numbers with respect to x, and Σ is
    the covariance of the noise. The result is differentiable with respect to x, for a design by
    gradients.

    **Arguments:** `model` is a model whose sensors have known noise; `x` (n,) holds the
    parameters of the motion. **Raises** `ValueError` for a sensor without noise.

    >>> model = rj.datasets.toutatis.model()
    >>> fisher(model, model.start()).shape
    (8, 8)
    """
    _require_known_noise(model, x)
    return _fisher(model, x)


@eqx.filter_jit
def _fisher(model: Model, x: Float[Array, " n"]) -> Float[Array, "n n"]:
    rows, extra = _rows(model, x)
    return normal_matrix(rows, model.index.places, model.size).add_rows(extra).core


@eqx.filter_jit
def _rows(
    model: Model, x: Float[Array, " n"]
) -> tuple[tuple[Float[Array, "records times k m"], ...], Float[Array, "j n"]]:
    """Return the derivatives of the readings of each sensor and of each `Measured`, in standard
    deviations.
    """
    sensors = model.records.sensors
    noises: list[Any] = [sensor.noise for sensor in sensors]
    _, slopes = error_jacobians(model, x)
    rows = []
    for index, (sensor, noise, block) in enumerate(zip(sensors, noises, slopes, strict=True)):
        jitter, late = extras(sensor).jitter, None
        if jitter is not None:
            late = jitter[:, None, None] * error_slopes_by_delay(model, x)[index]
        rows.append(scaled_slopes(block, noise, late))
    return tuple(rows), jax.jacfwd(lambda x: measured_residuals(model, x))(x)


def _require_known_noise(model: Model, x: Float[Array, " n"]) -> None:
    """Raise an error for unknown noise, or if x are no parameters of the `model`."""
    checked_x(model, x)
    for sensor in model.records.sensors:
        if sensor.noise is None:
            raise ValueError(
                f"design: wanted a {type(sensor).__name__} with known noise, got noise=None"
            )
