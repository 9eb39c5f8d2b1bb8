"""Compute the uncertainty to expect from a planned recording, and find the best initial rate."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, PyTree

from rigidjax import _checks
from rigidjax._types import Scalar, Vec3, Vector
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.identify.model.model import (
    Model,
    checked_x,
    delay_slopes,
    error_jacobians,
    require_single,
)
from rigidjax.identify.model.normal import normal_matrix
from rigidjax.identify.model.terms import scaled_slopes
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
      the values of the readings do not matter.
    - `x`: (n,) the free numbers of the planned motion, such as `Model.start` returns.

    **Returns** the same quantities as `Fit.quantities` (`name`, `value`, and `deviation` in the
    same `unit`). The standard deviations are the least that an unbiased estimate can have (the
    Cramér–Rao bound), and infinite for a quantity that the motion does not determine. **Raises:**
    `ValueError` for a sensor whose noise is not given, or numbers that are not finite.

    >>> model = rj.datasets.toutatis.model()
    >>> plan = model.start(rj.Inertia.from_principal(3.1, 3.2, 1.0))
    >>> bool(expected_quantities(model, plan)[0].deviation < 1.0)
    True
    """
    _require_not_traced(model, x)
    _require_known_noise(model, x)
    near = flat_limit.thicken(model, x)
    rows = tuple(map(np.asarray, _rows(model, x if near is None else near)))
    if not all(np.isfinite(block).all() for block in rows):
        raise ValueError(
            "expected_quantities: wanted a finite Fisher information, got NaN or infinity; the "
            "recordings of model hold NaN, or the motion of x overflows"
        )
    # The readings are planned: their residuals are zero, and priors do not count.
    zeros, none = tuple(block[..., 0] * 0.0 for block in rows), np.zeros(model.size)
    weights = tuple(np.ones(block.shape[:2]) for block in rows)
    mask = tuple(np.ones(block.shape, bool) for block in zeros)
    places, extra = np.asarray(model.index.places), np.zeros((0, model.size))
    linear = Linearisation(
        zeros, rows, zeros, rows, weights, mask, places, none, none, extra[:, 0], extra
    )
    white = white_covariance(linear)
    numbers = quantities_on_host(model, x, near)
    return reported_quantities(model, numbers, white.determined, white.null_directions)


def fisher(model: Model, x: Float[Array, " n"]) -> Float[Array, "n n"]:
    """Return Fisher's information matrix `Jᵀ Σ⁻¹ J` (n, n) of the free numbers x.

    J holds the derivatives of all predictions with respect to x, and Σ is the covariance of the
    noise. The result is differentiable with respect to x, for a design by gradients.

    **Arguments:** `model` is a model whose sensors have known noise; `x` (n,) holds the free
    numbers of the motion. **Raises** `ValueError` for a sensor without noise.

    >>> model = rj.datasets.toutatis.model()
    >>> fisher(model, model.start()).shape
    (8, 8)
    """
    _require_known_noise(model, x)
    return _fisher(model, x)


@eqx.filter_jit
def _fisher(model: Model, x: Float[Array, " n"]) -> Float[Array, "n n"]:
    return normal_matrix(_rows(model, x), model.index.places, model.size).core


@eqx.filter_jit
def _rows(model: Model, x: Float[Array, " n"]) -> tuple[Float[Array, "records times k m"], ...]:
    """Return the derivatives of the readings of each sensor, in standard deviations."""
    sensors = model.records.sensors
    noises: list[Any] = [sensor.noise for sensor in sensors]
    _, slopes = error_jacobians(model, x)
    rows = []
    for index, (sensor, noise, block) in enumerate(zip(sensors, noises, slopes, strict=True)):
        jitter, late = extras(sensor).jitter, None
        if jitter is not None:
            late = jitter.deviation[:, None, None] * delay_slopes(model, x)[index]
        rows.append(scaled_slopes(block, noise, late))
    return tuple(rows)


def _require_known_noise(model: Model, x: Float[Array, " n"]) -> None:
    """Raise an error for unknown noise or jitter, or if x are no parameters of the `model`."""
    checked_x(model, x)
    for sensor in model.records.sensors:
        if sensor.noise is None:
            raise ValueError(
                f"design: wanted a {type(sensor).__name__} with known noise, got noise=None"
            )
        if (jitter := extras(sensor).jitter) is not None and jitter.estimated:
            raise ValueError(
                f"design: wanted a {type(sensor).__name__} with known jitter, in s, got one "
                "that is to be estimated"
            )


def _require_not_traced(model: Model, motion: PyTree) -> None:
    if not _checks.is_known((model, motion)):
        raise TypeError(
            "model, x, body, omega: wanted known numbers, got traced ones; call it outside of "
            "jax.jit, jax.grad and jax.vmap, or differentiate identify.fisher"
        )


def best_first_rate(
    model: Model,
    body: Inertia | MassProperties | Mapping[str, Inertia | MassProperties] | None,
    omega: Vector,
    *,
    max_steps: int = 60,
) -> tuple[Vec3, tuple[Quantity, ...]]:
    """Return the initial body rate, of the same length as `omega`, that determines the body best.

    The direction of the rate minimises the determinant of the covariance of the free numbers of the
    body (D-optimality), where all other numbers are free as well. The BFGS method of optimistix
    finds a minimum near the direction of `omega`: try several directions.

    **Arguments:**

    - `model`, `body`: a model with the planned recordings, and the expected body; several bodies as
      a dict by name, as for `Model.start`.
    - `omega`: (3,) rad/s, body frame. Its direction is the start of the search, and its length is
      the length of the result: how fast the body can be thrown.
    - `max_steps`: the largest number of steps of the search.

    **Returns** the rate (3,), and the result of `expected_quantities` for this rate. **Raises** the
    errors of `fisher`.
    """
    require_single(model)
    max_steps = _checks.integer(max_steps, "max_steps", 1)
    _require_not_traced(model, (body, omega))
    _require_known_noise(model, model.start(body, omega))
    start = _checks.array_of_shape(omega, (3,), "omega").astype(model.records.t.dtype)
    size = jnp.sqrt(jnp.sum(start**2))
    best = _best_direction(model, body, start / size, size, max_steps)
    rate = size * best / jnp.sqrt(jnp.sum(best**2))
    return rate, expected_quantities(model, model.start(body, rate))


@eqx.filter_jit
def _best_direction(
    model: Model, body: PyTree, initial_direction: Array, rate_size: Array, max_steps: int
) -> Vec3:
    """Return the direction of the initial rate that determines the body best; its length is only
    near 1.
    """

    def uncertainty(direction: Array, args: tuple[Model, PyTree, Array]) -> Scalar:
        """Return ½ log det C / n for the covariance C of the body's n parameters, with a penalty
        that keeps the length near 1.
        """
        model, body, size = args
        length = jnp.sqrt(jnp.sum(direction**2))
        information = fisher(model, model.start(body, size * direction / length))
        n = model.index.bodies
        # The information on the body, if the other parameters are free as well, is the Schur
        # complement of their block in the information matrix.
        mine, across, rest = information[:n, :n], information[:n, n:], information[n:, n:]
        scale = jnp.sqrt(jnp.diagonal(rest))
        rest = rest / (scale[:, None] * scale[None, :]) + 1e-12 * jnp.eye(rest.shape[0])
        half = jnp.linalg.solve(rest, (across / scale[None, :]).T)
        left = mine - (across / scale[None, :]) @ half
        return -0.5 * jnp.linalg.slogdet(left)[1] / n + (length - 1.0) ** 2

    minimise: Any = optx.minimise
    out = minimise(
        uncertainty,
        optx.BFGS(rtol=1e-4, atol=1e-4),
        initial_direction,
        (model, body, rate_size),
        options={"autodiff_mode": "fwd"},
        max_steps=max_steps,
        throw=False,
    )
    return out.value
