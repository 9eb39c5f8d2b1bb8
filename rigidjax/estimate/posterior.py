"""Draws from a posterior density, by samplers of other libraries."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax.estimate.density import LogDensity, of_draws
from rigidjax.identify.parameters import Unpacked

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
            out[word] = body.tensor if hasattr(body, "tensor") else body.inertia.tensor
        if points.process is not None:
            out["density"] = points.process.density
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
    >>> density = rj.estimate.LogDensity(rj.identify.fit(rj.identify.Problem(record, chart)))
    >>> # Instead of Nuts(), a sampler of one's own: normal draws, which is Laplace's method.
    >>> normal = lambda key, log_density, start: jax.random.normal(key, (200, start.size))
    >>> drawn = posterior(density, jax.random.key(0), sampler=normal)
    >>> drawn.x.shape, bool((drawn.rhat < 1.05).all())  # four chains that agree
    ((4, 200, 8), True)
    """
    _checks.instance(density, LogDensity, "density", hint="estimate.LogDensity(fit) makes one")
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
    if density.problem.count >= _FULL:
        return lax.map(chain, keys)
    return jax.vmap(chain)(keys)
