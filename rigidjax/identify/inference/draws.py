"""The maximum of a posterior density with weighted draws, and draws by samplers of other libraries.

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
from jaxtyping import Array, Bool, Float

from rigidjax import _checks
from rigidjax._types import Scalar
from rigidjax.body.inertia import tensor_of
from rigidjax.identify.filtering.terms import curvature
from rigidjax.identify.inference.density import LogDensity, of_draws
from rigidjax.identify.model.model import Unpacked
from rigidjax.identify.model.normal import Normal
from rigidjax.identify.search.least_squares import Settings, minimise
from rigidjax.identify.search.stages import is_order_one
from rigidjax.identify.uncertainty.quantities import around
from rigidjax.motion.torques.composite import parts_of

# A sampler: key, log-density of z, a first z (n,) → draws (samples, n).
Sampler = Callable[[Any, Callable[[Array], Array], Array], Array]

# For `_checks.library`.
_BLACKJAX = ("blackjax", "posterior", "posterior")

# The weight of the first mass matrix, in draws: it is good already if Laplace's method is.
_WORTH = 50.0

# So many recordings keep a core busy: gradients of four chains at once take as long as one by one.
_FULL = 8


class Nuts(eqx.Module):
    """The no-U-turn sampler of blackjax, its step and mass matrix adapted first.

    **Arguments:** `samples` kept, `warmup` before them, of each chain; `acceptance` the mean
    acceptance probability of a trajectory's points, which sets the step: 0.8 is careful, 0.65 takes
    half as many gradients where the density is nearly normal. It needs blackjax: `pip install
    rigidjax[posterior]`. Hoffman and Gelman 2014, JMLR 15:1593. **Raises:** `ValueError` for
    numbers below 1 and an `acceptance` that is not between 0 and 1.

    >>> Nuts(samples=500).samples
    500
    """

    samples: int = eqx.field(static=True, default=1000)
    warmup: int = eqx.field(static=True, default=500)
    acceptance: float = eqx.field(static=True, default=0.8)

    def __check_init__(self):
        _checks.whole(self.samples, "samples", 1)
        _checks.whole(self.warmup, "warmup", 1)
        _checks.fraction(self.acceptance, "acceptance")

    def __call__(self, key: Any, density: Callable[[Array], Array], start: Array) -> Array:
        """Draws (samples, n) of one chain."""
        blackjax = _checks.library(*_BLACKJAX)
        adaptation = blackjax.adaptation
        # The warm-up of `blackjax.window_adaptation` in one loop with the draws: in a loop of its
        # own the density is compiled once more, which takes longer than to draw.
        begin, tune, settle = adaptation.step_size.dual_averaging_adaptation(self.acceptance)
        metric = adaptation.mass_matrix.mass_matrix_adaptation(True, _WORTH)
        metric_begin, metric_add, metric_end = metric
        kernel = blackjax.nuts.build_kernel()

        def warm(tuning: tuple, state: Any, accepted: Array, slow: Array, ends: Array) -> tuple:
            steps, scale, _ = tuning
            steps = tune(steps, accepted)
            scale = lax.cond(slow, lambda: metric_add(scale, state.position), lambda: scale)

            def end() -> tuple:
                again = begin(settle(steps))
                return again, metric_end(scale), jnp.exp(again.log_step_size)

            return lax.cond(ends, end, lambda: (steps, scale, jnp.exp(steps.log_step_size)))

        def body(carry: tuple, now: tuple) -> tuple[tuple, Array]:
            state, (steps, scale, size) = carry
            key, drawing, slow, ends = now
            size = jnp.where(drawing, settle(steps), size)
            state, info = kernel(key, state, density, size, scale.inverse_mass_matrix)
            tuning = lax.cond(
                drawing,
                lambda: (steps, scale, size),
                lambda: warm((steps, scale, size), state, info.acceptance_rate, slow, ends),
            )
            return (state, tuning), state.position

        schedule = adaptation.staged_adaptation.build_schedule(self.warmup)
        slow, ends = jnp.pad(jnp.asarray(schedule) == 1, ((0, self.samples), (0, 0))).T
        drawing = jnp.arange(self.warmup + self.samples) >= self.warmup
        first = (begin(1.0), metric_begin(start.size), jnp.ones((), start.dtype))
        state = blackjax.nuts.init(start, density)
        xs = (jax.random.split(key, drawing.size), drawing, slow, ends)
        _, draws = lax.scan(body, (state, first), xs)
        return draws[self.warmup :]


class Posterior(eqx.Module):
    """The result of `posterior`.

    **Fields:** `density`; `x` (chains, samples, n) draws of the vector that it takes. `points` are
    their bodies, states and values, `of(function)` any function of each. `rhat` (n,) is below 1.01
    if the chains agree, and `ess` (n,) is the number of independent draws, as in Gelman et al.,
    Bayesian Data Analysis (2013), §11.4, 11.5.
    """

    density: LogDensity
    x: Float[Array, "chains samples n"]

    @property
    def rhat(self) -> Float[Array, " n"]:
        """Potential scale reduction between the chains, near 1 if they agree (blackjax)."""
        return _checks.library(*_BLACKJAX).diagnostics.potential_scale_reduction(self.x)

    @property
    def ess(self) -> Float[Array, " n"]:
        """The effective number of independent draws (blackjax)."""
        return _checks.library(*_BLACKJAX).diagnostics.effective_sample_size(self.x)

    @property
    def points(self) -> Unpacked:
        """The bodies, states and values of the draws, with leading axes of chains and samples."""
        return self.of(_itself)

    def of(self, function: Callable[[Unpacked], Any]) -> Any:
        """`function(point)` of each draw, with leading axes of chains and samples.

        Such as `drawn.of(lambda point: point.body.moments)`. **Raises** `TypeError` if it is no
        function.
        """
        _checks.function(function, "function", "of `Unpacked`, such as lambda point: point.body")
        found = of_draws(function, self.density, self.x.reshape(-1, self.x.shape[-1]))
        return jax.tree.map(lambda leaf: leaf.reshape(*self.x.shape[:2], *leaf.shape[1:]), found)

    def to_arviz(self) -> Any:
        """The draws for ArviZ: body, values, initial states, process.

        **Raises:** `ImportError` without arviz (it needs Python 3.12).
        """
        arviz = _checks.library("arviz", "posterior", "to_arviz (Python 3.12)")
        points = self.points
        out = dict(points.values)
        out["omega0"] = points.state0.omega
        several = isinstance(points.body, dict)
        bodies = points.body if several else {"": points.body}
        for name, body in bodies.items():
            word = f"inertia [{name}]" if several else "inertia"
            out[word] = tensor_of(body)
        for number, part in enumerate(parts := parts_of(points.process)):
            out[f"density {number}" if len(parts) > 1 else "density"] = part.density
        return arviz.from_dict({"posterior": {k: jnp.asarray(v) for k, v in out.items()}})


def _itself(point: Unpacked) -> Unpacked:
    return point


def posterior(
    density: LogDensity, key: Any, *, sampler: Sampler | None = None, chains: int = 4
) -> Posterior:
    """Draws of body, initial states, all `Free`s, noise and process, given all readings.

    **Arguments:** `density` a `LogDensity`; `key` of `jax.random`; `sampler` a function of a key, a
    log-density and a first vector to draws (samples, n), `Nuts()` unless given; its numbers have
    the identity as covariance by Laplace's method, and it starts from a draw of that. `chains` run
    together under `vmap`, or one after another with eight recordings and more. **Returns** a
    `Posterior`. **Raises** `ImportError` if blackjax is missing.

    >>> import jax
    >>> record, chart = rj.datasets.toutatis.recording(), rj.identify.PrincipalRatios()
    >>> density = rj.identify.LogDensity(rj.identify.fit(rj.identify.Model(record, chart)))
    >>> # Instead of Nuts(), a sampler of one's own: normal draws, which is Laplace's method.
    >>> normal = lambda key, log_density, start: jax.random.normal(key, (200, start.size))
    >>> drawn = posterior(density, jax.random.key(0), sampler=normal)
    >>> drawn.x.shape, bool((drawn.rhat < 1.05).all())  # four chains that agree
    ((4, 200, 8), True)
    """
    _checks.instance(density, LogDensity, "density", hint="identify.LogDensity(fit) makes one")
    _checks.key(key)
    chains = _checks.whole(chains, "chains", 2)
    sampler = Nuts() if sampler is None else _checks.function(sampler, "sampler", "of a key")
    if isinstance(sampler, Nuts):
        _checks.library(*_BLACKJAX)
    root = jnp.linalg.cholesky(density.covariance)
    x = _draw(density, root, jax.random.split(key, chains), sampler)
    return Posterior(density, x)


@eqx.filter_jit
def _draw(density: LogDensity, root: Array, keys: Array, sampler: Any) -> Array:
    def of(z: Array) -> Array:
        return density.x0 + jnp.sum(root * z[None], 1)

    def chain(key: Any) -> Array:
        first, later = jax.random.split(key)
        start = 0.5 * jax.random.normal(first, density.x0.shape, density.x0.dtype)
        return jax.vmap(of)(sampler(later, lambda z: density(of(z)), start))

    # One after another no chain waits for the longest step of the others.
    if density.model.count >= _FULL:
        return lax.map(chain, keys)
    return jax.vmap(chain)(keys)


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
                "start, or draw from the density (identify.posterior)"
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
        null, reach = np.zeros((0, self.x.size)), NormalDist().inv_cdf(0.5 + 0.5 * level)
        return around(centre, slope, np.asarray(self.covariance), null, reach)


def refit(
    density: LogDensity, *, max_steps: int = 200, draws: int = 1000, key: Any = None
) -> Refit:
    """The maximum of the posterior density, and weighted draws around it for intervals.

    A fit that allows for an unknown torque, the process of its model: `refit(LogDensity(fit))`
    finds body, initial states, all `Free`s, and the torque's density, starting from `fit`, by
    Fisher's scoring: Levenberg–Marquardt with the expected information of the innovations as the
    normal matrix (Gupta and Mehra 1974, doi:10.1109/TAC.1974.1100714). The draws come from a wide
    Student's t about that point, weighted by the density over that of the t (importance sampling:
    Geweke 1989, doi:10.2307/1913710). Draws of more than some dozen numbers are worth little
    (`effective`); intervals then come from the information, which is enough if each recording is
    long. `identify.posterior` draws from any density.

    **Arguments:** `density` a `LogDensity`; `max_steps` at most; `draws` how many; `key` of
    `jax.random` for them, by default always the same. **Returns** a `Refit`; `converged` is false
    if it ended early, or if some combination of the numbers changes neither readings nor priors:
    `weights` are then NaN.

    >>> ts = jnp.linspace(0.0, 10.0, 80)
    >>> motion = rj.simulate(rj.Inertia.from_principal(1.0, 2.0, 2.5), rj.Spin([1, 0.1, 1.0]), ts)
    >>> record = rj.identify.Recording(ts, (rj.identify.Gyro(0.01), motion.ys.omega))
    >>> found = rj.identify.fit(rj.identify.Model(record, rj.identify.PrincipalRatios()))
    >>> best = refit(rj.identify.LogDensity(found))
    >>> bool(jnp.allclose(best.point.state0.omega, jnp.array([1.0, 0.1, 1.0]), atol=1e-3))
    True
    >>> low, high = best.interval_of(lambda point: point.state0.omega)
    >>> bool((low < high).all())
    True
    """
    _checks.instance(density, LogDensity, "density", hint="identify.LogDensity(fit) makes one")
    steps, count = _checks.whole(max_steps, "max_steps", 1), _checks.whole(draws, "draws", 1)
    key = jax.random.key(0) if key is None else _checks.key(key)
    return _refit(density, Settings(_SMALL, _DAMPING, steps), key, count)


@eqx.filter_jit
def _refit(density: LogDensity, settings: Settings, key: Any, count: int) -> Refit:
    def evaluated(x: Array) -> Any:
        cost, gram, slope = curvature(density.model, x)
        return None, cost, Normal(gram), slope

    order_one = is_order_one(density.model, density.x0.dtype)
    end = minimise(evaluated, density.x0, order_one, settings, None)
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
