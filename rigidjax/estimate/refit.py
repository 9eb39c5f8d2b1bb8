"""The most probable numbers of a problem, the unknown torque integrated out, and weighted draws.

The information at the maximum alone gives intervals that are too narrow on short records: it fixes
the torque's density at its most probable value, which is below its mean.
"""

from collections.abc import Callable
from statistics import NormalDist
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from rigidjax import _checks
from rigidjax._types import Scalar
from rigidjax.estimate.density import LogDensity, curvature, of_draws
from rigidjax.identify.levenberg_marquardt import Settings, search
from rigidjax.identify.normal import Normal
from rigidjax.identify.parameters import Unpacked
from rigidjax.identify.quantities import carried
from rigidjax.identify.search import made_of

# Steps of so many standard deviations end the search; its damping at the start.
_SMALL, _DAMPING = 1e-3, 1e-2
# Draws come from Student's t, wider than Laplace's method, so that tails get their weight.
_FREEDOM, _WIDER = 6.0, 1.2
# Fewer independent draws cannot give the ends of an interval.
_LEAST = 100.0


class Refit(eqx.Module):
    """The result of `refit`.

    **Fields:** `density`; `x` (n,) where it is largest, `log_density` there; `covariance` (n, n) of
    x, the inverse of Fisher's information there; `converged`; `draws` (m, n) and their `weights`
    (m,), which add up to 1, represent the posterior density. `effective` is the number of
    independent draws that they are worth.
    """

    density: LogDensity
    x: Float[Array, " n"]
    log_density: Scalar
    covariance: Float[Array, "n n"]
    converged: Bool[Array, ""]
    draws: Float[Array, "m n"]
    weights: Float[Array, " m"]

    @property
    def point(self) -> Unpacked:
        """The body, initial states, values, noise and process that the vector x stands for."""
        return self.density.unpack(self.x)

    @property
    def effective(self) -> Scalar:
        """The number of independent draws that the weighted ones are worth, 1/Σw² (Kish 1965)."""
        return 1.0 / jnp.sum(self.weights**2)

    def interval_of(
        self, of: Callable[[Unpacked], Any], level: float = 0.95
    ) -> tuple[np.ndarray, np.ndarray]:
        """Interval (low, high) of any function of `Unpacked` to an array, with equal tails.

        It comes from the weighted draws. If these are worth fewer than 100 independent ones
        (`effective`), it comes from the covariance and the derivative of the function, which must
        then be differentiable: take the logarithm of a positive quantity. That interval is too
        narrow on short records. **Raises** `ValueError` for a level outside (0, 1), and if too few
        draws are independent and x is not the maximum either.
        """
        level = _checks.fraction(level, "level", "a probability between 0 and 1")
        _checks.function(of, "of", "of `Unpacked` to an array")
        if not (float(self.effective) >= _LEAST or bool(self.converged)):
            raise ValueError(
                "interval_of: the search did not reach the maximum of the density, and fewer than "
                "100 draws are independent: give refit more max_steps, or its fit a better "
                "start, or draw from the density (estimate.posterior)"
            )
        if float(self.effective) >= _LEAST:
            each = np.asarray(of_draws(of, self.density, self.draws))
            tails = np.array([0.5 - 0.5 * level, 0.5 + 0.5 * level])
            weights = np.asarray(self.weights)

            def quantiles(values: np.ndarray) -> np.ndarray:
                order = np.argsort(values)
                below = np.cumsum(weights[order]) - 0.5 * weights[order]
                return np.interp(tails, below, values[order])

            low, high = np.apply_along_axis(quantiles, 0, each)
            return np.asarray(low), np.asarray(high)

        def value(x: Array) -> Array:
            return jnp.asarray(of(self.density.unpack(x)))

        centre, slope = (np.asarray(a) for a in (value(self.x), jax.jacfwd(value)(self.x)))
        deviation = carried(slope, np.asarray(self.covariance), np.zeros((0, self.x.size)))
        reach = NormalDist().inv_cdf(0.5 + 0.5 * level) * deviation
        return np.asarray(centre - reach), np.asarray(centre + reach)


def refit(
    density: LogDensity, *, max_steps: int = 200, draws: int = 1000, key: Any = None
) -> Refit:
    """The maximum of the posterior density, and weighted draws around it for intervals.

    A fit that allows for an unknown torque: `refit(LogDensity(fit, RandomTorque(1e-4)))` finds
    body, initial states, all `Free`s, and the torque's density, starting from `fit`, by Fisher's
    scoring: Levenberg–Marquardt with the expected information of the innovations as the normal
    matrix (Gupta and Mehra 1974, doi:10.1109/TAC.1974.1100714). The draws come from a wide
    Student's t about that point, weighted by the density over that of the t (importance sampling:
    Geweke 1989, doi:10.2307/1913710). Draws of more than some dozen numbers are worth little
    (`effective`); intervals then come from the information, which is enough if each recording is
    long. `estimate.posterior` draws from any density.

    **Arguments:** `density` a `LogDensity`; `max_steps` at most; `draws` how many; `key` of
    `jax.random` for them, by default always the same. **Returns** a `Refit`; `converged` is false
    if it ended early, or if some combination of the numbers changes neither readings nor priors:
    `weights` are then NaN.

    >>> ts = jnp.linspace(0.0, 10.0, 80)
    >>> motion = rj.simulate(rj.Inertia.from_principal(1.0, 2.0, 2.5), rj.Spin([1, 0.1, 1.0]), ts)
    >>> record = rj.identify.Recording(ts, (rj.identify.Gyro(0.01), motion.ys.omega))
    >>> found = rj.identify.fit(rj.identify.Problem(record, rj.identify.PrincipalRatios()))
    >>> best = refit(rj.estimate.LogDensity(found))
    >>> bool(jnp.allclose(best.point.state0.omega, jnp.array([1.0, 0.1, 1.0]), atol=1e-3))
    True
    >>> low, high = best.interval_of(lambda point: point.state0.omega)
    >>> bool((low < high).all())
    True
    """
    _checks.instance(density, LogDensity, "density", hint="estimate.LogDensity(fit) makes one")
    steps, count = _checks.whole(max_steps, "max_steps", 1), _checks.whole(draws, "draws", 1)
    key = jax.random.key(0) if key is None else _checks.key(key)
    return _refit(density, Settings(_SMALL, _DAMPING, steps), key, count)


@eqx.filter_jit
def _refit(density: LogDensity, settings: Settings, key: Any, count: int) -> Refit:
    def evaluated(x: Array) -> Any:
        cost, gram, slope = curvature(density, x)
        return None, cost, Normal(gram), slope

    parameters, factors, logs = density.like
    ones = jax.tree.map(jnp.ones_like, (factors, logs))
    made = ravel_pytree((made_of(parameters), *ones))[0]
    end = search(evaluated, density.x0, made, settings, None)
    covariance = jnp.linalg.inv(end.normal.core)
    draws, weights = _weighted(density, end.point, covariance, key, count)
    converged = end.converged & jnp.isfinite(weights).all()
    return Refit(density, end.point, -end.cost, covariance, converged, draws, weights)


def _weighted(
    density: LogDensity, top: Array, covariance: Array, key: Any, count: int
) -> tuple[Float[Array, "m n"], Float[Array, " m"]]:
    """Draws of Student's t about the maximum, and their weights."""
    size, kind = top.size, top.dtype
    normal, square = jax.random.split(key)
    z = jax.random.normal(normal, (count, size), kind)
    shrunk = jax.random.chisquare(square, _FREEDOM, (count, 1), kind) / _FREEDOM
    z = z / jnp.sqrt(shrunk)
    root = _WIDER * jnp.linalg.cholesky(covariance)
    draws = top[None] + z @ root.T
    found = lax.map(density, draws)
    taken = -0.5 * (_FREEDOM + size) * jnp.log1p(jnp.sum(z * z, 1) / _FREEDOM)
    # A point so far out that the density is no number there has none.
    logs = jnp.where(jnp.isfinite(found), found - taken, -jnp.inf)
    return draws, jax.nn.softmax(logs)
