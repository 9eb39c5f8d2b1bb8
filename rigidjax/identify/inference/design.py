"""Experiment design: the expected uncertainty of a planned motion, and the best motion."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import Scalar, Vec3
from rigidjax.identify.model.model import Model, require_numbers, require_one
from rigidjax.identify.model.terms import blocks, changes, in_deviations
from rigidjax.identify.search.normal import normal_of
from rigidjax.identify.uncertainty import flat_limit
from rigidjax.identify.uncertainty.covariance import inverted
from rigidjax.identify.uncertainty.quantities import Quantity, quantities, values_and_slopes


def expected(model: Model, x: Float[Array, " n"]) -> tuple[Quantity, ...]:
    """Return the report to expect of a fit of such recordings, with its standard deviations.

    **Arguments:** `model` with its torque, whose recordings give times, sensors with known noise
    and inputs (the readings themselves do not matter); `x` (n,) the free numbers of the motion that
    is planned, as `Model.start` gives them. **Returns** the quantities of `Fit.quantities` (`name`,
    `value`, `deviation`, `unit`) with the standard deviations of the Cramér–Rao bound, infinite
    where the motion would show nothing. **Raises:** `ValueError` for a sensor whose noise is not
    given, or numbers that are not finite.

    >>> model = rj.datasets.toutatis.model()
    >>> plan = model.start(rj.Inertia.from_principal(3.1, 3.2, 1.0))
    >>> bool(expected(model, plan)[0].deviation < 1.0)
    True
    """
    _on_host(model, x)
    _require_noise(model, x)
    near = flat_limit.thickened(model, x)
    information = np.asarray(_fisher(model, x if near is None else near))
    if not np.isfinite(information).all():
        raise ValueError(
            "expected: Fisher's information has NaN or infinity in it: model holds NaN in its "
            "recordings, or the motion of these numbers is beyond the dtype"
        )
    found = values_and_slopes(model, x, near)
    half, null = inverted(information)
    return quantities(model, found, half @ half.T, null)


def fisher(model: Model, x: Float[Array, " n"]) -> Float[Array, "n n"]:
    """Return Fisher's information (n, n) of the free numbers: `Jᵀ Σ⁻¹ J` of the predictions.

    **Arguments:** `model` with known noises; `x` (n,) the free numbers of the motion. It is
    differentiable in x, for a design by gradients. **Raises** `ValueError` for a sensor without
    noise.

    >>> model = rj.datasets.toutatis.model()
    >>> fisher(model, model.start()).shape
    (8, 8)
    """
    _require_noise(model, x)
    return _fisher(model, x)


@eqx.filter_jit
def _fisher(model: Model, x: Float[Array, " n"]) -> Float[Array, "n n"]:
    sensors = model.records.sensors
    noises: list[Any] = [sensor.noise for sensor in sensors]
    _, slopes = blocks(model, x)
    rows = []
    for index, (sensor, noise, block) in enumerate(zip(sensors, noises, slopes, strict=True)):
        jitter, late = getattr(sensor, "jitter", None), None
        if jitter is not None:
            late = jitter.deviation[:, None, None] * changes(model, x)[index]
        rows.append(in_deviations(block, noise, late))
    return normal_of(rows, model.index.places, model.size).core


def _require_noise(model: Model, x: Float[Array, " n"]) -> None:
    """Raise `ValueError` for a sensor whose noise or jitter is not known."""
    require_numbers(model, x)
    for sensor in model.records.sensors:
        if sensor.noise is None:
            raise ValueError(
                f"design: wanted a {type(sensor).__name__} with known noise, got noise=None"
            )
        if (jitter := getattr(sensor, "jitter", None)) is not None and jitter.estimated:
            raise ValueError(f"design: wanted a {type(sensor).__name__} with known jitter, in s")


def _on_host(model: Model, motion: Any) -> None:
    if not _checks.known((model, motion)):
        raise TypeError(
            "model, x, body, omega: wanted known numbers, got traced ones; this works "
            "on the host: call it outside of jax.jit, and differentiate fisher"
        )


def best_first_rate(
    model: Model, body: Any, omega: Any, *, max_steps: int = 60
) -> tuple[Vec3, tuple[Quantity, ...]]:
    """The direction of the initial rate that determines the body best; its length is kept.

    It minimises the mean logarithm of the standard deviations of the body's free numbers
    (D-optimality, other numbers free as well), by BFGS of optimistix near `omega`: try several.
    **Arguments:** `model`, `body` as for `Model.start`; `omega` (3,) rad/s, body frame, where
    the search starts and how fast the body can be thrown; `max_steps`. **Returns** the rate (3,)
    and what to expect from it (`expected`). **Raises:** as `fisher`.
    """
    require_one(model)
    max_steps = _checks.whole(max_steps, "max_steps", 1)
    _on_host(model, (body, omega))
    _require_noise(model, model.start(body, omega))
    start = _checks.floating(omega, (3,), "omega").astype(model.records.t.dtype)
    size = jnp.sqrt(jnp.sum(start**2))
    found = _search(model, body, start / size, size, max_steps)
    rate = size * found / jnp.sqrt(jnp.sum(found**2))
    return rate, expected(model, model.start(body, rate))


@eqx.filter_jit
def _search(model: Model, body: Any, start: Array, size: Array, max_steps: int) -> Array:
    minimise: Any = optx.minimise
    out = minimise(
        _doubt,
        optx.BFGS(rtol=1e-4, atol=1e-4),
        start,
        (model, body, size),
        options={"autodiff_mode": "fwd"},
        max_steps=max_steps,
        throw=False,
    )
    return out.value


def _doubt(direction: Array, args: Any) -> Scalar:
    """½ log det of the body's covariance over its size, plus a penalty on the length."""
    model, body, size = args
    length = jnp.sqrt(jnp.sum(direction**2))
    information = fisher(model, model.start(body, size * direction / length))
    n = model.index.bodies
    # The body's information with the other numbers free: Schur's complement.
    mine, across, rest = information[:n, :n], information[:n, n:], information[n:, n:]
    scale = jnp.sqrt(jnp.diagonal(rest))
    rest = rest / (scale[:, None] * scale[None, :]) + 1e-12 * jnp.eye(rest.shape[0])
    half = jnp.linalg.solve(rest, (across / scale[None, :]).T)
    left = mine - (across / scale[None, :]) @ half
    return -0.5 * jnp.linalg.slogdet(left)[1] / n + (length - 1.0) ** 2
