"""Experiment design: the expected uncertainty of a planned motion, and the best motion."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import Scalar, Vec3
from rigidjax.identify import flat_limit
from rigidjax.identify.normal import normal_of
from rigidjax.identify.parameters import Parameters, places
from rigidjax.identify.problem import Problem, fits, one_problem
from rigidjax.identify.quantities import Quantity, quantities, values_and_slopes
from rigidjax.identify.terms import changes, in_deviations, with_blocks
from rigidjax.identify.uncertainty import inverted


def expected(problem: Problem, parameters: Parameters) -> tuple[Quantity, ...]:
    """The expected report of a fit of such a recording, with its standard deviations.

    **Arguments:** `problem` whose recordings give times, sensors with known noise, and torques (the
    readings themselves do not matter); `parameters` the motion that is planned. **Returns** the
    quantities of `Fit.quantities` (`name`, `value`, `deviation` in the same `unit`) with the
    standard deviations of the Cramér–Rao bound, infinite where the motion would show nothing.
    **Raises:** `ValueError` for a sensor whose noise is not given, or numbers that are not finite.

    >>> problem = rj.datasets.toutatis.problem()
    >>> plan = problem.start(rj.Inertia.from_principal(3.1, 3.2, 1.0))
    >>> bool(expected(problem, plan)[0].deviation < 1.0)
    True
    """
    _on_host(problem, parameters)
    _look(problem, parameters)
    near = flat_limit.beside(problem, parameters)
    information = np.asarray(_fisher(problem, parameters if near is None else near))
    if not np.isfinite(information).all():
        raise ValueError(
            "expected: Fisher's information has NaN or infinity in it: problem holds NaN in its "
            "recordings, or the motion of these parameters is beyond the dtype"
        )
    found = values_and_slopes(problem, parameters, near)
    half, null = inverted(information)
    return quantities(problem, found, half @ half.T, null)


def fisher(problem: Problem, parameters: Parameters) -> Float[Array, "n n"]:
    """Fisher's information (n, n) of the free numbers: `Jᵀ Σ⁻¹ J` of the predictions.

    **Arguments:** `problem` with known noises; `parameters` the motion. It is differentiable in the
    parameters, for a design by gradients. **Raises** `ValueError` for a sensor without noise.

    >>> problem = rj.datasets.toutatis.problem()
    >>> fisher(problem, problem.start()).shape
    (8, 8)
    """
    _look(problem, parameters)
    return _fisher(problem, parameters)


@eqx.filter_jit
def _fisher(problem: Problem, parameters: Parameters) -> Float[Array, "n n"]:
    sensors = problem.records.sensors
    noises: list[Any] = [sensor.noise for sensor in sensors]
    blocks = with_blocks(parameters, problem)[1][0]
    rows = []
    for index, (sensor, noise, block) in enumerate(zip(sensors, noises, blocks, strict=True)):
        jitter, late = getattr(sensor, "jitter", None), None
        if jitter is not None:
            late = jitter.deviation[:, None, None] * changes(parameters, problem)[index]
        rows.append(in_deviations(block, noise, late))
    return normal_of(rows, places(problem, parameters), ravel_pytree(parameters)[0].size).core


def _look(problem: Problem, parameters: Parameters) -> None:
    fits(problem, parameters)
    for sensor in problem.records.sensors:
        if sensor.noise is None:
            raise ValueError(
                f"design: wanted a {type(sensor).__name__} with known noise, got noise=None"
            )
        if (jitter := getattr(sensor, "jitter", None)) is not None and jitter.estimated:
            raise ValueError(f"design: wanted a {type(sensor).__name__} with known jitter, in s")


def _on_host(problem: Problem, motion: Any) -> None:
    if not _checks.known((problem, motion)):
        raise TypeError(
            "problem, parameters, body, omega: wanted known numbers, got traced ones; this works "
            "on the host: call it outside of jax.jit, and differentiate fisher"
        )


def best_first_rate(
    problem: Problem, body: Any, omega: Any, *, max_steps: int = 60
) -> tuple[Vec3, tuple[Quantity, ...]]:
    """The direction of the initial rate that determines the body best; its length is kept.

    It minimises the mean logarithm of the standard deviations of the body's free numbers
    (D-optimality, other numbers free as well), by BFGS of optimistix near `omega`: try several.
    **Arguments:** `problem`, `body` as for `Problem.start`; `omega` (3,) rad/s, body frame, where
    the search starts and how fast the body can be thrown; `max_steps`. **Returns** the rate (3,)
    and what to expect from it (`expected`). **Raises:** as `fisher`.
    """
    one_problem(problem)
    max_steps = _checks.whole(max_steps, "max_steps", 1)
    _on_host(problem, (body, omega))
    _look(problem, problem.start(body, omega))
    start = _checks.floating(omega, (3,), "omega").astype(problem.records.t.dtype)
    size = jnp.sqrt(jnp.sum(start**2))
    found = _search(problem, body, start / size, size, max_steps)
    rate = size * found / jnp.sqrt(jnp.sum(found**2))
    return rate, expected(problem, problem.start(body, rate))


@eqx.filter_jit
def _search(problem: Problem, body: Any, start: Array, size: Array, max_steps: int) -> Array:
    minimise: Any = optx.minimise
    out = minimise(
        _doubt,
        optx.BFGS(rtol=1e-4, atol=1e-4),
        start,
        (problem, body, size),
        options={"autodiff_mode": "fwd"},
        max_steps=max_steps,
        throw=False,
    )
    return out.value


def _doubt(direction: Array, args: Any) -> Scalar:
    """½ log det of the body's covariance over its size, plus a penalty on the length."""
    problem, body, size = args
    length = jnp.sqrt(jnp.sum(direction**2))
    information = fisher(problem, problem.start(body, size * direction / length))
    n = problem.body.size
    # The body's information with the other numbers free: Schur's complement.
    mine, across, rest = information[:n, :n], information[:n, n:], information[n:, n:]
    scale = jnp.sqrt(jnp.diagonal(rest))
    rest = rest / (scale[:, None] * scale[None, :]) + 1e-12 * jnp.eye(rest.shape[0])
    half = jnp.linalg.solve(rest, (across / scale[None, :]).T)
    left = mine - (across / scale[None, :]) @ half
    return -0.5 * jnp.linalg.slogdet(left)[1] / n + (length - 1.0) ** 2
