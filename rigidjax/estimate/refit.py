"""The most probable numbers of a problem, with the unknown torque integrated out."""

from collections.abc import Callable
from statistics import NormalDist
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import lax
from jaxtyping import Array, Bool, Float

from rigidjax import _checks
from rigidjax._types import Scalar
from rigidjax.estimate.density import LogDensity, Point

# Of a standard deviation by Laplace's method: over this the gradient is differenced.
_STEP = 1e-2


class Refit(eqx.Module):
    """What `refit` returns.

    **Fields:** `density`; `x` (n,) where it is largest, `log_density` there; `covariance` (n, n) of
    x by the curvature there; `converged`.

    >>> import rigidjax as rj
    >>> ts = jnp.linspace(0.0, 10.0, 80)
    >>> motion = rj.simulate(rj.Inertia.from_principal(1.0, 2.0, 2.5), rj.Spin([1, 0.1, 1.0]), ts)
    >>> record = rj.identify.Recording(ts, (rj.identify.Gyro(0.01), motion.ys.omega))
    >>> found = rj.identify.fit(rj.identify.Problem(record, rj.identify.PrincipalRatios()))
    >>> best = refit(rj.estimate.LogDensity(found))
    >>> low, high = best.interval_of(lambda point: point.state0.omega)
    >>> bool((low < high).all())
    True
    """

    density: LogDensity
    x: Float[Array, " n"]
    log_density: Scalar
    covariance: Float[Array, "n n"]
    converged: Bool[Array, ""]

    @property
    def point(self) -> Point:
        """What x stands for: body, first states, values, noise, process."""
        return self.density.unpack(self.x)

    def interval_of(
        self, of: Callable[[Point], Any], level: float = 0.95
    ) -> tuple[np.ndarray, np.ndarray]:
        """Interval (low, high) of any differentiable function of a `Point` to an array.

        The covariance is carried by the function's derivative; take the logarithm of what is
        positive. The torque's density is held at its mode, so that intervals are too narrow where a
        record is short: of 80 readings, 87 to 94 of 100 at 95 % contained the truth. **Raises**
        `ValueError` for a level outside (0, 1).
        """
        level = _checks.positive(level, "level")
        if level >= 1:
            raise ValueError(f"level: wanted a probability between 0 and 1, got {level}")
        _checks.function(of, "of", "of a Point to an array")

        def value(x: Array) -> Array:
            return jnp.asarray(of(self.density.unpack(x)))

        centre, slope = value(self.x), jax.jacfwd(value)(self.x)
        spread = jnp.sqrt(jnp.einsum("...i,ij,...j->...", slope, self.covariance, slope))
        reach = NormalDist().inv_cdf(0.5 + 0.5 * level) * spread
        return np.asarray(centre - reach), np.asarray(centre + reach)


def refit(density: LogDensity, *, max_steps: int = 200) -> Refit:
    """Where the posterior density is largest, and the covariance by its curvature there.

    A fit that allows for an unknown torque: `refit(LogDensity(fit, RandomTorque(1e-4)))` finds
    body, first states, whatever is free, and the torque's density, from `fit` on. Quasi-Newton
    (BFGS) of optimistix in numbers scaled by Laplace's covariance, gradients in forward mode
    through the filter.

    **Arguments:** `density` a `LogDensity`; `max_steps` at most.

    **Returns** a `Refit`; `converged` false where it ended early.

    **Raises:** `TypeError` for another kind of thing.

    >>> import rigidjax as rj
    >>> ts = jnp.linspace(0.0, 10.0, 80)
    >>> motion = rj.simulate(rj.Inertia.from_principal(1.0, 2.0, 2.5), rj.Spin([1, 0.1, 1.0]), ts)
    >>> record = rj.identify.Recording(ts, (rj.identify.Gyro(0.01), motion.ys.omega))
    >>> found = rj.identify.fit(rj.identify.Problem(record, rj.identify.PrincipalRatios()))
    >>> best = refit(rj.estimate.LogDensity(found))
    >>> bool(jnp.allclose(best.point.state0.omega, jnp.array([1.0, 0.1, 1.0]), atol=1e-3))
    True
    """
    _checks.instance(density, LogDensity, "density", hint="estimate.LogDensity(fit) makes one")
    steps = _checks.whole(max_steps, "max_steps", 1)
    return _refit(density, jnp.linalg.cholesky(density.covariance), steps)


@eqx.filter_jit
def _refit(density: LogDensity, root: Array, max_steps: int) -> Refit:
    def of(z: Array, args: Any = None) -> Array:
        return -density.value(density.x0 + jnp.sum(root * z[None], 1))

    found = optx.minimise(
        of,
        optx.BFGS(rtol=1e-6, atol=1e-6),
        jnp.zeros_like(density.x0),
        options={"autodiff_mode": "fwd"},
        max_steps=max_steps,
        throw=False,
    )
    z = found.value
    slope = jax.jacfwd(of)
    # Both ends in one loop, so that the gradient is compiled once.
    ends = jnp.concatenate([jnp.eye(z.size), -jnp.eye(z.size)]).astype(z.dtype)
    slopes = lax.map(lambda unit: slope(z + _STEP * unit), ends)
    curve = (slopes[: z.size] - slopes[z.size :]) / (2 * _STEP)
    spread = jnp.linalg.inv(0.5 * (curve + curve.T))
    covariance = root @ spread @ root.T
    whole = jnp.isfinite(covariance).all() & (jnp.linalg.eigvalsh(curve + curve.T).min() > 0)
    return Refit(
        density,
        density.x0 + jnp.sum(root * z[None], 1),
        -of(z),
        covariance,
        (found.result == optx.RESULTS.successful) & whole,
    )
