"""Least squares from several starts, and what came of it."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from rigidjax.body.inertia import Inertia
from rigidjax.identify import uncertainty
from rigidjax.identify.loss import shrink
from rigidjax.identify.problem import Parameters, Problem
from rigidjax.identify.start import starting_points
from rigidjax.motion import Attitude, Spin

# The record is fitted from its beginning first: a long one is a forest of wrong minima (the phase
# slips by whole turns), a short one is not.
HORIZONS = (0.25, 0.5, 1.0)


class Start(eqx.Module):
    """What came of one start: where it ended and whether that can be believed."""

    parameters: Parameters
    cost: float
    converged: bool
    fits: bool


class Fit(eqx.Module):
    """What `fit` returns: the best point and how sure it is.

    **Fields:** `parameters` the free numbers at the best point; `covariance` (n, n) of them,
    flattened in order; `noise` one (3,) standard deviation per sensor, given or estimated;
    `starts` what came of each start; `chi2` and `dof` of the whitened errors of the sensors whose
    noise was given; `singular_values` (n,) of the whitened Jacobian; `status` one line: `ok`, or
    what is wrong.
    """

    problem: Problem
    parameters: Parameters
    covariance: Float[Array, "n n"]
    noise: tuple[Float[Array, "3"], ...]
    starts: tuple[Start, ...]
    chi2: float
    dof: int
    singular_values: Float[Array, " n"]
    null_directions: Float[Array, "k n"]
    status: str

    @property
    def ok(self) -> bool:
        """Whether the fit converged and explains the data."""
        return self.status == "ok"

    @property
    def body(self) -> Inertia:
        """The inertia, up to scale."""
        return self.problem.unpack(self.parameters)[0]

    @property
    def state0(self) -> Spin | Attitude:
        """The state at the first time."""
        return self.problem.unpack(self.parameters)[1]

    @property
    def residuals(self) -> tuple[Float[Array, "times 3"], ...]:
        """Reading minus prediction for each sensor, in its unit; zero where masked."""
        return _errors(self.parameters, self.problem)

    @property
    def rms(self) -> tuple[float, ...]:
        """Root mean square length of each sensor's error, in its unit."""
        out = []
        for errors, reading in zip(self.residuals, self.problem.recording.readings, strict=True):
            lengths = np.sum(np.asarray(errors) ** 2, axis=1)[reading.seen]
            out.append(float(np.sqrt(lengths.mean())))
        return tuple(out)

    def interval(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Intervals of the two ratios of moments and the first body rate, name → (low, high).

        Gauss–Newton covariance; ratios through their logarithm. **Arguments:** `level` the
        probability with which each holds the truth. **Raises** `ValueError` outside (0, 1).
        """
        return uncertainty.intervals(self, level)

    def interval_of(
        self, of: Callable[[Inertia, Any], Any], level: float = 0.95
    ) -> tuple[np.ndarray, np.ndarray]:
        """Interval (low, high) of any differentiable function `of(body, state0) → array`.

        The covariance is carried by the function's derivative. **Raises** as `interval`.
        """
        return uncertainty.interval_of(self, of, level)

    @property
    def identifiability(self) -> tuple[str, ...]:
        """In words: what the data fix, what they fix weakly, what they cannot see."""
        return uncertainty.in_words(self)


def _residual(parameters: Parameters, args: tuple) -> tuple[Float[Array, "times 3"], ...]:
    problem, noise, weights = args
    out = []
    for error, sigma in zip(problem.errors(parameters), noise, strict=True):
        whitened = jax.vmap(lambda e, s=sigma: shrink(problem.loss, e / s))(error)
        out.append(whitened * weights[:, None])
    return tuple(out)


@eqx.filter_jit
def _errors(parameters: Parameters, problem: Problem) -> tuple[Float[Array, "times 3"], ...]:
    return problem.errors(parameters)


@eqx.filter_jit
def _levenberg(
    start: Parameters,
    problem: Problem,
    noise: tuple,
    weights: Float[Array, " times"],
    tolerance: Any,
    max_steps: int,
) -> tuple[Parameters, Float[Array, ""], Bool[Array, ""]]:
    args = (problem, noise, weights)
    out = optx.least_squares(
        _residual,
        optx.LevenbergMarquardt(rtol=tolerance, atol=tolerance),
        start,
        args,
        options={"jac": "fwd"},
        max_steps=max_steps,
        throw=False,
    )
    residual = ravel_pytree(_residual(out.value, args))[0]
    return out.value, 0.5 * jnp.sum(residual**2), out.result == optx.RESULTS.successful


def fit(
    problem: Problem,
    *,
    starts: int = 8,
    initial: Parameters | None = None,
    key: PRNGKeyArray | None = None,
    tolerance: float = 1e-10,
    max_steps: int = 200,
    progress: Callable[[str], Any] | None = None,
) -> Fit:
    """The body and the first state that explain a recording best.

    **Arguments:**

    - `problem`: what was read and what is free.
    - `starts`: how many starting points to try (regression first, then scattered ones). Each is
      fitted to a quarter, a half and then the whole of the record.
    - `initial`: a starting point of your own, tried first.
    - `key`: random key of the scattered starts; `jax.random.key(0)` unless given.
    - `tolerance`, `max_steps`: where Levenberg–Marquardt stops, relative and absolute; steps.
    - `progress`: called with a line of text after each start, such as `print`.

    **Returns** a `Fit`. It always holds the best point that was reached; `fit.status` says in words
    when that is not to be trusted: not converged, or far above the noise. Interrupting (Ctrl-C)
    after the first start ends the search and keeps what was found.

    Levenberg–Marquardt of optimistix, Jacobians by forward mode through the motion.

    **Raises:** `TypeError` for what is no `Problem`, `ValueError` for fewer than one start.

    >>> import jax.numpy as jnp, rigidjax as rj
    >>> ts = jnp.linspace(0.0, 10.0, 60)
    >>> motion = rj.simulate(rj.Inertia.from_principal(1.0, 2.0, 2.5), rj.Spin([1, 0.1, 1.0]), ts)
    >>> record = rj.identify.Recording(ts, (rj.identify.Gyro(0.01), motion.ys.omega))
    >>> found = rj.identify.fit(rj.identify.Problem(record, rj.identify.PrincipalRatios()))
    >>> found.status, bool(jnp.allclose(found.body.tensor / found.body.tensor[0, 0],
    ...                                 jnp.diag(jnp.array([1.0, 2.0, 2.5])), atol=1e-6))
    ('ok', True)
    """
    if not isinstance(problem, Problem):
        raise TypeError(f"fit: wanted a Problem, got {type(problem).__name__}")
    if starts < 1:
        raise ValueError(f"fit: wanted at least one start, got {starts}")
    key = jax.random.key(0) if key is None else key
    points = starting_points(problem, starts, key)
    if initial is not None:
        points = [initial, *points][:starts]
    noise = _first_noise(problem)
    limit = jnp.asarray(tolerance)
    tried: list[tuple[Parameters, float, bool]] = []
    try:
        for number, point in enumerate(points, 1):
            value, cost, done = _climb(point, problem, noise, limit, max_steps)
            tried.append((value, float(cost), bool(done)))
            if progress is not None:
                best = min(cost for _, cost, _ in tried)
                progress(f"start {number}/{len(points)}: misfit {float(cost):.6g}, best {best:.6g}")
    except KeyboardInterrupt:
        if not tried:
            raise
    best = min(tried, key=lambda item: item[1] if np.isfinite(item[1]) else np.inf)
    estimated = any(r.sensor.noise is None for r in problem.recording.readings)
    value, cost, done = best
    if estimated:
        # Twice: the weights of the channels and the robust loss both depend on the noise.
        for _ in range(2):
            noise = uncertainty.estimate_noise(problem, _errors(value, problem), noise, value)
            whole = jnp.ones(problem.recording.t.shape)
            value, cost, done = _levenberg(value, problem, noise, whole, limit, max_steps)
        noise = uncertainty.estimate_noise(problem, _errors(value, problem), noise, value)
    return _assess(problem, value, bool(done), noise, tried, best[1])


def _climb(
    point: Parameters, problem: Problem, noise: tuple, tolerance: Any, max_steps: int
) -> tuple[Parameters, Any, Any]:
    t = problem.recording.t
    cost, done = jnp.inf, False
    for horizon in HORIZONS:
        seen = (t - t[0]) <= horizon * (t[-1] - t[0])
        rough = tolerance if horizon == 1.0 else jnp.maximum(tolerance, 1e-4)
        point, cost, done = _levenberg(
            point, problem, noise, seen.astype(t.dtype), rough, max_steps
        )
    return point, cost, done


def _first_noise(problem: Problem) -> tuple[Float[Array, "3"], ...]:
    out = []
    for reading in problem.recording.readings:
        if reading.sensor.noise is not None:
            out.append(reading.sensor.noise)
        else:
            # A tenth of the signal: what counts is that no channel drowns another.
            size = jnp.sqrt(jnp.mean(jnp.sum(reading.values**2, axis=1)) + 1e-300)
            out.append(jnp.full(3, 0.1) * size)
    return tuple(out)


def _assess(
    problem: Problem,
    value: Parameters,
    done: bool,
    noise: tuple,
    tried: list[tuple[Parameters, float, bool]],
    best_cost: float,
) -> Fit:
    covariance, singular, null = uncertainty.covariance(problem, value, noise)
    chi2, dof, believable = uncertainty.goodness(problem, value, noise)
    # Ten units of log-likelihood: a point further above the best is e¹⁰ times less likely. Where
    # the noise is estimated from the best point, its cost is half the number of readings.
    margin = 10.0
    if any(r.sensor.noise is None for r in problem.recording.readings):
        margin *= 2 * best_cost / problem.recording.size
    starts = []
    for parameters, cost, converged in tried:
        fits = believable and cost <= best_cost + margin
        starts.append(Start(parameters, cost, converged, fits))
    rivals = [s for s in starts if s.fits and s.converged and s.cost > best_cost + 0.01 * margin]
    if not np.isfinite(best_cost):
        status = "failed: no start gave a finite misfit"
    elif not believable:
        status = "poor fit: the errors are far above the noise; this is not the motion"
    elif not done:
        status = "not converged: max_steps reached; this is the best point found"
    elif rivals:
        status = f"ambiguous: {len(rivals)} of {len(starts)} starts fit as well elsewhere"
    else:
        status = "ok"
    return Fit(problem, value, covariance, noise, tuple(starts), chi2, dof, singular, null, status)
