"""Find the maximum of a posterior density, and draw from the density for intervals.

Draws are needed because intervals from Fisher's information at the maximum are too narrow for short
records: such intervals hold the spectral density of a torque fixed at its most probable value,
which is below its mean.
"""

import sys
from collections.abc import Callable
from statistics import NormalDist
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from rigidjax import _checks
from rigidjax._types import Scalar
from rigidjax.body.inertia import tensor_of
from rigidjax.identify.filtering.terms import curvature
from rigidjax.identify.inference.density import LogDensity, map_draws
from rigidjax.identify.model.first_order import value_and_jacfwd
from rigidjax.identify.model.model import Unpacked
from rigidjax.identify.model.normal import NormalMatrix
from rigidjax.identify.search.least_squares import Settings, minimise
from rigidjax.identify.search.stages import of_order_one
from rigidjax.identify.uncertainty.quantities import interval_about
from rigidjax.motion.torques.composite import parts_of

# A sampler is a function. It is given a key, a log-density (a function of a vector z) and a first z
# (n,), and returns draws of z (samples, n).
Sampler = Callable[[Any, Callable[[Array], Array], Array], Array]

# These arguments of `_checks.import_library` are the module, the extra of rigidjax that installs
# the module, and the function that needs the module.
_BLACKJAX = ("blackjax", "posterior", "posterior")

# The first mass matrix of a sampler counts like an estimate from this number of draws, because it
# comes from Laplace's method, which gives a good first matrix.
_FIRST_WEIGHT = 50.0

# With at least this number of recordings, one gradient keeps a core of the processor busy. The
# gradients of four chains then take as long if they are computed together as if they are computed
# one after another.
_FULL = 8


class Nuts(eqx.Module):
    """Draw from a posterior density by the no-U-turn sampler of blackjax.

    A warm-up adapts the step and the mass matrix of the sampler. The class needs blackjax:
    `pip install '.[posterior]'` in the clone. Source: Hoffman and Gelman 2014, JMLR 15:1593.

    **Arguments:**

    - `samples`: the number of draws of each chain.
    - `warmup`: the number of draws of the warm-up, which are thrown away.
    - `acceptance`: the mean acceptance probability of the points of a trajectory; the warm-up
      adapts the step so that this mean is reached. 0.8 is careful; 0.65 takes half as many
      gradients as 0.8 if the density is nearly normal.

    **Raises:** `ValueError` for numbers below 1 and an `acceptance` that is not between 0 and 1.

    >>> Nuts(samples=500).samples
    500
    """

    samples: int = eqx.field(static=True, default=1000)
    warmup: int = eqx.field(static=True, default=500)
    acceptance: float = eqx.field(static=True, default=0.8)

    def __check_init__(self):
        _checks.integer(self.samples, "samples", 1)
        _checks.integer(self.warmup, "warmup", 1)
        _checks.fraction(self.acceptance, "acceptance")

    def __call__(self, key: PRNGKeyArray, density: Callable[[Array], Array], start: Array) -> Array:
        """Return the draws (samples, n) of one chain that begins at `start` (n,).

        `density` is the log-density as a function of a vector (n,), and `key` a random key.
        """
        blackjax = _checks.import_library(*_BLACKJAX)
        adaptation = blackjax.adaptation
        # The warm-up is that of `blackjax.window_adaptation`, but here one loop does the warm-up
        # and the draws. A separate loop for the warm-up would compile the density once more, which
        # takes longer than the draws.
        begin, tune, settle = adaptation.step_size.dual_averaging_adaptation(self.acceptance)
        metric = adaptation.mass_matrix.mass_matrix_adaptation(True, _FIRST_WEIGHT)
        metric_begin, metric_add, metric_end = metric
        kernel = blackjax.nuts.build_kernel()

        def adapt(
            tuning: tuple, state: PyTree, accepted: Array, in_slow_window: Array, window_ends: Array
        ) -> tuple:
            steps, scale, _ = tuning
            steps = tune(steps, accepted)
            scale = lax.cond(
                in_slow_window, lambda: metric_add(scale, state.position), lambda: scale
            )

            def end_window() -> tuple:
                restarted = begin(settle(steps))
                return restarted, metric_end(scale), jnp.exp(restarted.log_step_size)

            return lax.cond(
                window_ends, end_window, lambda: (steps, scale, jnp.exp(steps.log_step_size))
            )

        def draw_step(carry: tuple, row: tuple) -> tuple[tuple, Array]:
            state, (steps, scale, size) = carry
            key, drawing, slow, ends = row
            size = jnp.where(drawing, settle(steps), size)
            state, info = kernel(key, state, density, size, scale.inverse_mass_matrix)
            tuning = lax.cond(
                drawing,
                lambda: (steps, scale, size),
                lambda: adapt((steps, scale, size), state, info.acceptance_rate, slow, ends),
            )
            return (state, tuning), state.position

        schedule = adaptation.staged_adaptation.build_schedule(self.warmup)
        slow, ends = jnp.pad(jnp.asarray(schedule) == 1, ((0, self.samples), (0, 0))).T
        drawing = jnp.arange(self.warmup + self.samples) >= self.warmup
        first = (begin(1.0), metric_begin(start.size), jnp.ones((), start.dtype))
        state = blackjax.nuts.init(start, density)
        xs = (jax.random.split(key, drawing.size), drawing, slow, ends)
        _, draws = lax.scan(draw_step, (state, first), xs)
        return draws[self.warmup :]


class Posterior(eqx.Module):
    """Hold draws from the posterior density of a fitted model, the result of the function
    `posterior`.

    **Fields:**

    - `density`: the `LogDensity` from which x was drawn.
    - `x`: (chains, samples, n) the draws of the argument x of the density.

    `points` holds the body, the states and the values of each draw, and `map(function)` applies a
    function to each draw. `rhat` (n,) is below 1.01 if the chains agree, and `ess` (n,) is the
    number of independent draws that the draws of each entry of x are worth (Gelman et al., Bayesian
    Data Analysis (2013), §11.4, 11.5).
    """

    density: LogDensity
    x: Float[Array, "chains samples n"]

    @property
    def rhat(self) -> Float[Array, " n"]:
        """Return the potential scale reduction R̂ (n,) of the draws of each entry of x, by
        blackjax.

        It is near 1 if the chains of these draws agree.
        """
        return _checks.import_library(*_BLACKJAX).diagnostics.potential_scale_reduction(self.x)

    @property
    def ess(self) -> Float[Array, " n"]:
        """Return how many independent draws the draws of each entry of x are worth, an array (n,),
        by blackjax.
        """
        return _checks.import_library(*_BLACKJAX).diagnostics.effective_sample_size(self.x)

    @property
    def points(self) -> Unpacked:
        """Return the body, the initial states and the values of the `Free`s of all these draws, as
        one `Unpacked`.

        Its arrays have two leading axes, for the chains and the samples.
        """
        return self.map(_identity)

    def map(self, function: Callable[[Unpacked], Any]) -> Any:
        """Return `function(point)` for each draw, with leading axes for the chains and the samples.

        `point` is an `Unpacked` with the body, states and values of the draw. An example is
        `drawn.map(lambda point: point.body.moments)`. **Raises** `TypeError` if `function` is not a
        function.
        """
        _checks.require_function(
            function, "function", "of `Unpacked`, such as lambda point: point.body"
        )
        rows = map_draws(function, self.density, self.x.reshape(-1, self.x.shape[-1]))
        return jax.tree.map(lambda leaf: leaf.reshape(*self.x.shape[:2], *leaf.shape[1:]), rows)

    def to_arviz(self) -> Any:
        """Return the draws in the form that the library ArviZ reads: what `arviz.from_dict`
        returns.

        Its variables are the inertia tensors, the values of the `Free`s, the initial body rates and
        the spectral densities of the process. **Raises** `ImportError` without arviz, and on
        Python 3.11, for which there is no arviz that reads this form.
        """
        if sys.version_info < (3, 12):
            raise ModuleNotFoundError(
                "to_arviz: arviz needs Python 3.12 or later, and this is Python 3.11; take the "
                "numbers themselves (`points`, `x`), or run your program on a later Python",
                name="arviz",
            )
        arviz = _checks.import_library("arviz", "posterior", "to_arviz")
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


def _identity(point: Unpacked) -> Unpacked:
    # A module-level function is the same object in all calls, so that JAX compiles only once.
    return point


def posterior(
    density: LogDensity, key: PRNGKeyArray, *, sampler: Sampler | None = None, chains: int = 4
) -> Posterior:
    """Draw from the posterior density of a body, its initial states, all `Free`s (other numbers
    that a fit may move), the noise, and the process (a random torque).

    **Arguments:**

    - `density`: a `LogDensity`.
    - `key`: a key of `jax.random`.
    - `sampler`: a function that is given a key, a log-density and a first vector (n,), and returns
      draws (samples, n); `Nuts()` by default. The vectors are x, shifted and scaled so that by
      Laplace's method they have the mean 0 and the identity as covariance. The components of the
      first vector are normal, with the mean 0 and the standard deviation 0.5.
    - `chains`: the number of chains. The chains run together under `vmap`, or one after another for
      eight recordings and more.

    **Returns** a `Posterior`. **Raises** `ImportError` if blackjax is missing.

    >>> import jax
    >>> record, chart = rj.datasets.toutatis.recording(), rj.identify.PrincipalRatios()
    >>> density = rj.identify.LogDensity(rj.identify.fit(rj.identify.Model(record, chart)))
    >>> # Instead of Nuts(), a sampler of one's own: normal draws, which is Laplace's method.
    >>> normal = lambda key, log_density, start: jax.random.normal(key, (200, start.size))
    >>> drawn = posterior(density, jax.random.key(0), sampler=normal)
    >>> drawn.x.shape, bool((drawn.rhat < 1.05).all())  # four chains that agree
    ((4, 200, 8), True)
    """
    _checks.require_instance(
        density, LogDensity, "density", hint="identify.LogDensity(fit) makes one"
    )
    _checks.random_key(key)
    chains = _checks.integer(chains, "chains", 2)
    sample = Nuts() if sampler is None else _checks.require_function(sampler, "sampler", "of a key")
    if isinstance(sample, Nuts):
        _checks.import_library(*_BLACKJAX)
    root = jnp.linalg.cholesky(density.covariance)
    x = _draw(density, root, jax.random.split(key, chains), sample)
    return Posterior(density, x)


@eqx.filter_jit
def _draw(
    density: LogDensity, root: Array, keys: Array, sampler: Sampler
) -> Float[Array, "chains samples n"]:
    """Draw from a posterior density by a Markov chain for each key.

    The sampler draws z with `x = x0 + root z`, where the `root` is one of the covariance of x.
    """

    def to_x(z: Array) -> Array:
        return density.x0 + jnp.sum(root * z[None], 1)

    def chain(key: Array) -> Array:
        first, later = jax.random.split(key)
        start = 0.5 * jax.random.normal(first, density.x0.shape, density.x0.dtype)
        return jax.vmap(to_x)(sampler(later, lambda z: density(to_x(z)), start))

    # Many recordings keep a core of the processor busy with one chain, and the chains run one after
    # another: chains that run together wait, in each step, for the chain with the longest
    # trajectory.
    if density.model.count >= _FULL:
        return lax.map(chain, keys)
    return jax.vmap(chain)(keys)


# The search for the maximum ends if a step is shorter than _SMALL standard deviations of each
# number. The damping of its Levenberg–Marquardt steps starts at _DAMPING.
_SMALL, _DAMPING = 1e-3, 1e-2
# Draws come from Student's t distribution with _FREEDOM degrees of freedom and a scale of _WIDER
# times that of Laplace's normal distribution. With a narrower distribution a few draws in the tails
# would get all the weight.
_FREEDOM, _WIDER = 6.0, 1.2
# An interval is computed from the draws if they are worth at least this number of independent ones.
_LEAST = 100.0


class Refit(eqx.Module):
    """Hold the maximum of a posterior density and weighted draws about it, the result of the
    function `refit`.

    **Fields:**

    - `density`: the posterior density, a `LogDensity` (function of x that returns its logarithm).
    - `x`: (n,) the point at which the density is largest.
    - `log_density`: the logarithm of the density at x.
    - `covariance`: (n, n) the covariance of x, which is the inverse of Fisher's information at x.
    - `converged`: whether the search converged and all weights are finite.
    - `draws`: (m, n) draws of x, which represent the posterior density together with their weights.
    - `weights`: (m,) the weights of the draws, which add up to 1.

    `effective_count` is the number of independent draws that the weighted draws are worth.
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
        """Return the body, initial states, values, noise and process that the maximum x of the
        density represents.
        """
        return self.density.unpack(self.x)

    @property
    def effective_count(self) -> Scalar:
        """Return how many independent draws the weighted `draws` of this result are worth.

        It is 1/Σw² for the weights w. Source: Kish, Survey Sampling (1965).
        """
        return 1.0 / jnp.sum(self.weights**2)

    def interval_of(
        self, function: Callable[[Unpacked], Any], level: float = 0.95
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the interval (low, high), with equal tails, of a function of the drawn quantities.

        The interval is computed from the weighted draws, if these are worth 100 independent draws
        or more (`effective_count`). Else it is computed from the covariance of x and the derivative
        of the function. In this case the function must be differentiable, and should return the
        logarithm of a positive quantity instead of the quantity. An interval from the covariance is
        too narrow for short records.

        **Arguments:**

        - `function`: a function that is given an `Unpacked` (the body, the states and the values of
          a draw) and returns an array.
        - `level`: the probability that the interval holds the true value.

        **Raises** `ValueError` for a level outside (0, 1), and if too few draws are independent and
        the search did not converge either.
        """
        level = _checks.fraction(level, "level", "a probability between 0 and 1")
        _checks.require_function(function, "function", "of `Unpacked` to an array")
        if not (float(self.effective_count) >= _LEAST or bool(self.converged)):
            raise ValueError(
                "interval_of: the search did not reach the maximum of the density, and fewer than "
                "100 draws are independent: give refit more max_steps, or its fit a better "
                "start, or draw from the density (identify.posterior)"
            )
        if float(self.effective_count) >= _LEAST:
            each = np.asarray(map_draws(function, self.density, self.draws))
            tails = np.array([0.5 - 0.5 * level, 0.5 + 0.5 * level])
            weights = np.asarray(self.weights)

            def quantiles(values: np.ndarray) -> np.ndarray:
                order = np.argsort(values)
                below = np.cumsum(weights[order]) - 0.5 * weights[order]
                return np.interp(tails, below, values[order])

            low, high = np.apply_along_axis(quantiles, 0, each)
            return np.asarray(low), np.asarray(high)

        def function_of_numbers(x: Array) -> Array:
            return _checks.differentiable_array(function(self.density.unpack(x)), "function(point)")

        centre, slope = map(np.asarray, value_and_jacfwd(function_of_numbers, self.x))
        null, reach = np.zeros((0, self.x.size)), NormalDist().inv_cdf(0.5 + 0.5 * level)
        return interval_about(centre, slope, np.asarray(self.covariance), null, reach)


def refit(
    density: LogDensity, *, max_steps: int = 200, draws: int = 1000, key: PRNGKeyArray | None = None
) -> Refit:
    """Find the maximum of a posterior density, and draw about the maximum; intervals are computed
    from the draws.

    The function is a fit that allows for an unknown torque (the process of the model):
    `refit(LogDensity(fit))` finds the body, the initial states, all `Free`s and the spectral
    density of the torque, starting from the result `fit`. The search is Fisher's scoring:
    Levenberg–Marquardt steps with the expected information of the innovations as the normal matrix
    (Gupta and Mehra 1974, doi:10.1109/TAC.1974.1100714).

    The draws come from a wide Student's t distribution about the maximum. The weight of a draw is
    proportional to the posterior density over the density of the t distribution (importance
    sampling: Geweke 1989, doi:10.2307/1913710). For more than a few dozen parameters such draws
    are worth few independent draws (`effective_count`). Intervals then come from the covariance,
    which is good enough if each recording is long; `identify.posterior` draws from any density.

    **Arguments:**

    - `density`: a `LogDensity`.
    - `max_steps`: the largest number of steps of the search.
    - `draws`: the number of draws.
    - `key`: a key of `jax.random` for the draws; without a key the draws are the same at each call.

    **Returns** a `Refit`. Its `converged` is false if the search ended early, or if some change of
    the parameters changes neither readings nor priors; in the second case `weights` are NaN.

    >>> ts = jnp.linspace(0.0, 10.0, 80)
    >>> motion = rj.simulate(rj.Inertia.from_principal(1.0, 2.0, 2.5), rj.Spin([1, 0.1, 1.0]), ts)
    >>> record = rj.identify.Recording(ts, (rj.identify.Gyro(0.01), motion.ys.omega))
    >>> first = rj.identify.fit(rj.identify.Model(record, rj.identify.PrincipalRatios()))
    >>> best = refit(rj.identify.LogDensity(first))
    >>> bool(jnp.allclose(best.point.state0.omega, jnp.array([1.0, 0.1, 1.0]), atol=1e-3))
    True
    >>> low, high = best.interval_of(lambda point: point.state0.omega)
    >>> bool((low < high).all())
    True
    """
    _checks.require_instance(
        density, LogDensity, "density", hint="identify.LogDensity(fit) makes one"
    )
    steps, count = _checks.integer(max_steps, "max_steps", 1), _checks.integer(draws, "draws", 1)
    drawing = jax.random.key(0) if key is None else _checks.random_key(key)
    return _refit(density, Settings(_SMALL, _DAMPING, steps), drawing, count)


@eqx.filter_jit
def _refit(density: LogDensity, settings: Settings, key: PRNGKeyArray, count: int) -> Refit:
    """Return the maximum of a posterior density and draws about it from Student's t distribution,
    which is somewhat wider; with weights they represent the density (importance sampling).
    """

    def evaluate(x: Array) -> tuple[None, Array, NormalMatrix, Array]:
        cost, gram, slope = curvature(density.model, x)
        return None, cost, NormalMatrix(gram), slope

    order_one = of_order_one(density.model, density.x0.dtype)
    end = minimise(evaluate, density.x0, order_one, settings, None)
    covariance = jnp.linalg.inv(end.normal.core)
    size, kind = end.point.size, end.point.dtype
    normal, square = jax.random.split(key)
    z = jax.random.normal(normal, (count, size), kind)
    shrunk = jax.random.chisquare(square, _FREEDOM, (count, 1), kind) / _FREEDOM
    z = z / jnp.sqrt(shrunk)
    draws = end.point[None] + z @ (_WIDER * jnp.linalg.cholesky(covariance)).T
    wanted = lax.map(density, draws)
    drawn_from = -0.5 * (_FREEDOM + size) * jnp.log1p(jnp.sum(z * z, 1) / _FREEDOM)
    # A draw that is so far out that the density is NaN gets no weight.
    weights = jax.nn.softmax(jnp.where(jnp.isfinite(wanted), wanted - drawn_from, -jnp.inf))
    converged = end.converged & jnp.isfinite(weights).all()
    return Refit(density, end.point, -end.cost, covariance, converged, draws, weights)
