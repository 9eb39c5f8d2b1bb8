"""Compute the posterior density of a fitted model, as a function of unconstrained numbers."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from rigidjax import _checks
from rigidjax._types import Scalar
from rigidjax.identify.answer.result import Fit
from rigidjax.identify.data import stacking
from rigidjax.identify.filtering.terms import recording_terms
from rigidjax.identify.model.build import extended, interval_steps
from rigidjax.identify.model.free import Slot
from rigidjax.identify.model.model import (
    Model,
    Unpacked,
    map_rows,
    require_one_kind,
    scenes_of,
    starting_scene,
    unpack_at,
)
from rigidjax.identify.model.scene import Process, Scene, require_unknown_torque
from rigidjax.identify.model.terms import prior_residuals
from rigidjax.identify.uncertainty.covariance import white_covariance
from rigidjax.motion.torques.composite import parts_of

# This advice is added to the error that x is not determined, if the density has a process (an
# unknown random torque): a fit without this torque may end far from the true body.
_GUESS = (
    ", or begin from a first guess, fit(model, starts=1, max_steps=1): the torque may be too "
    "strong for a fit without it"
)


class LogDensity(eqx.Module):
    """Compute the logarithm of the posterior density of a fitted model, as a function of one vector
    x.

    Call the object with x (n,), real numbers without bounds. The entries of x are the parameters
    of the fitted model and the logarithms of additional factors. One factor multiplies each noise
    that the fit estimates, and one factor multiplies each number of the process (a random torque).
    `unpack(x)` returns the body, the states and the values that x represents.

    If there is a process or a `Walk` (a drift of a sensor), a Kalman filter integrates the unknown
    torque and the drifts out. Otherwise the readings are taken as independent and normal about the
    motion. Such a density is too narrow if the errors of the readings are autocorrelated: keep
    fewer readings, or give a process. The jitter of a sensor has the value of the fit. The priors
    are the priors of the model (of its `Free`s, or an `Entropic` prior); the prior of all other
    numbers is flat in x.

    **Arguments:**

    - `fit`: a result of `identify.fit`. With a process a first guess is enough,
      `fit(model, starts=1, max_steps=1)`.
    - `process`: a `RandomTorque`, a `CorrelatedTorque` or a `Sum` of such torques; `None` takes the
      process of the model.
    - `deviation`: the standard deviation of the normal prior of the logarithm of each number of the
      process, such as a spectral density or a correlation time. The mean of this prior is the
      logarithm of the number in `process`. `None` for a known process.

    If only ratios of moments are determined, as by a gyro alone, the spectral density of a torque
    scales with the square of a moment of inertia. Give the process in the unit in which the fit has
    the inertia (`fit.body`), and compare only the ratio `density / moment**2` with other results.

    **Fields:**

    - `model`: the fitted model with the additional factors as `Free`s.
    - `x0`: (n,) the x of the fit.
    - `covariance`: (n, n) the covariance of x by Laplace's method, for the start and the mass
      matrix of a sampler. If errors are autocorrelated, it is smaller than the covariance of the
      fit.

    **Raises:** `ValueError` for a robust loss, which belongs to no density, and for directions of x
    that neither the data nor a prior determines.

    For numpyro: `numpyro.infer.MCMC(NUTS(potential_fn=lambda x: -density(x)), …)`; for blackjax:
    `blackjax.nuts(density, …)`, or `identify.posterior`. Gradients are computed for one recording
    after another in forward mode, also under `jax.grad`. Compile the density by
    `equinox.filter_jit(density)`.

    >>> record, chart = rj.datasets.toutatis.recording(), rj.identify.PrincipalRatios()
    >>> density = LogDensity(rj.identify.fit(rj.identify.Model(record, chart)))
    >>> density.size, bool(density(density.x0) > density(density.x0 + 0.1))
    (8, True)
    """

    model: Model
    x0: Float[Array, " n"]
    covariance: Float[Array, "n n"]

    def __init__(
        self,
        fit: Fit,
        process: Process | None = None,
        *,
        deviation: float | None = 2.0,
    ):
        _checks.require_instance(
            fit, Fit, "LogDensity: fit", requirement="what identify.fit returns"
        )
        model = fit.model
        require_one_kind(model, "LogDensity")
        process = model.process if process is None else process
        if process is not None:
            require_unknown_torque(process)
        if model.loss is not None:
            raise ValueError(
                "fit: wanted a model without a robust loss, which is no density, got "
                f"{type(model.loss).__name__}; fit with loss=None"
            )
        if not np.isfinite(np.asarray(fit.covariance)).all():
            what = " ".join(one.in_words for one in fit.undetermined_combinations)
            hint = "" if process is None else _GUESS
            raise ValueError(
                "fit: neither the data nor a prior determine some combination of the "
                "parameters, so there is no posterior; give a prior or fewer parameters"
                f"{hint}. {what}".rstrip()
            )
        fixed = process is None or deviation is None
        prior = None if fixed else jnp.asarray(_checks.positive_float(deviation, "deviation"))
        factors = _noise_factors(model)
        if prior is not None:
            total = sum(int(reading.host_mask.sum()) for reading in model.records.readings)
            wide = np.full(1, 1 / math.sqrt(total))
            factors += [_Factor(slot, wide) for slot in _process_slots(process, prior)]
        slots = [factor.slot for factor in factors]
        wider, places = extended(model, slots)
        records = eqx.tree_at(
            lambda r: [reading.sensor.noise for reading in r.readings],
            model.records,
            list(fit.noises),
            is_leaf=lambda node: node is None,
        )
        steps = model.filter_steps if process is None else interval_steps(records, model.reference)
        known = dict(records=records, process=process, filter_steps=steps)
        self.model = dataclasses.replace(wider, **known)
        covariance = _white_covariance(fit, process is None and not model.walks)
        self.x0 = jnp.zeros(self.model.size, fit.x.dtype).at[places].set(fit.x)
        whole = np.zeros((self.model.size, self.model.size))
        whole[np.ix_(places, places)] = covariance
        added = self.model.slots[len(model.slots) :]
        for slot, factor in zip(added, factors, strict=True):
            own = np.ravel(np.asarray(slot.shared))
            whole[own, own] = factor.variance
        self.covariance = jnp.asarray(whole, fit.x.dtype)

    @property
    def size(self) -> int:
        """Return n, the number of entries of the argument x of this density."""
        return self.x0.size

    def __call__(self, x: Float[Array, " n"]) -> Scalar:
        # Derivatives are computed for one recording after another, in forward mode.
        x = _checks.array_of_shape(x, self.x0.shape, "x")
        terms = map_rows(self.model.index.rows(x), self.model, recording_terms)
        return terms.total - 0.5 * jnp.sum(prior_residuals(self.model, x) ** 2)

    def unpack(self, x: Float[Array, " n"]) -> Unpacked:
        """Return the quantities that the argument x (n,) of this density represents, as an
        `Unpacked`.

        It holds the body, the initial states, the values of the `Free`s, the noise of each sensor
        (standard deviations (R, k) for R recordings and k components), and the process.
        """
        x = _checks.array_of_shape(x, self.x0.shape, "x")
        scenes, point = scenes_of(self.model, x), unpack_at(self.model, x)
        noise: Any = tuple(sensor.noise for sensor in scenes.sensors)
        process = stacking.pick(scenes.process, 0)
        return dataclasses.replace(point, noise=noise, process=process)


@eqx.filter_jit
def map_draws(
    function: Callable[[Unpacked], Any], density: LogDensity, x: Float[Array, "m n"]
) -> PyTree:
    """Return `function(point)` for each of m draws x (m, n) from a posterior density, where `point`
    is an `Unpacked` with the body, the states and the values that the draw represents.

    The results are stacked: each array has a leading axis of length m. The program is compiled once
    for all densities with the same structure and shapes.
    """
    return jax.vmap(lambda one: function(density.unpack(one)))(x)


class _Factor(NamedTuple):
    """Hold a new parameter, the logarithm of a factor, and its variance in Laplace's method."""

    slot: Slot
    variance: Float[np.ndarray, " groups"]


_MARK = object()


def _noise_factors(model: Model) -> list[_Factor]:
    """Return a factor of the unknown noise of each sensor, for each group of recordings."""
    groups, out = np.asarray(model.noise_groups), []
    scene = starting_scene(model, model.records)
    for index, reading in enumerate(model.records.readings):
        if reading.sensor.noise is not None:
            continue
        rows = np.bincount(groups, np.asarray(reading.host_mask.sum(axis=1)))
        # The logarithm of a standard deviation has the variance 1/(2n) if n numbers were read.
        variance = 0.5 / np.maximum(rows * reading.sensor.components, 1)
        # The leaf is `None` until it is marked.
        marked = eqx.tree_at(
            lambda s, index=index: s.sensors[index].noise, scene, _MARK, is_leaf=lambda x: x is None
        )
        path = next(path for path, leaf in jax.tree.leaves_with_path(marked) if leaf is _MARK)
        name = f"noise of {type(reading.sensor).__name__} {index}"
        labels = tuple(str(group) for group in range(rows.size))
        slot = _slot(path, name, (1,), reading.sensor.unit, labels, model.noise_groups)
        out.append(_Factor(slot, variance))
    return out


def _process_slots(process: Process | None, prior: Array) -> list[Slot]:
    """Return a slot for each number of a random torque; `prior` is the deviation of logarithms."""
    scene, slots = Scene(None, None, process, (), None), []
    several, number = len(parts_of(process)) > 1, -1
    for path, leaf in jax.tree.leaves_with_path(scene):
        # If the process is a sum of torques, the names get the index of the torque. A new torque
        # begins at each number with the name `density`, since it is the first number of each
        # torque.
        number += path[-1].name == "density"
        name = f"{path[-1].name} {number}" if several else path[-1].name
        slots.append(_slot(path, name, (1,) * jnp.ndim(leaf), "", (), None, prior))
    return slots


def _slot(
    path: tuple[Any, ...],
    name: str,
    shape: tuple[int, ...],
    unit: str,
    labels: tuple[str, ...],
    groups: Array | None,
    prior: Array | None = None,
) -> Slot:
    """Return the slot of a positive factor of a leaf of the scene, one for each group if any."""
    one = jnp.ones(())
    return Slot(path, name, unit, False, True, shape, labels, groups, one, prior, None)


def _white_covariance(fit: Fit, has_deterministic_motion: bool) -> Float[np.ndarray, "n n"]:
    """Return the covariance of a fit without what it allows for beside white errors.

    This is constant errors within a `Tolerance` and, if the motion has no random part or the
    covariance is singular, autocorrelation.
    """
    covariance = np.asarray(fit.covariance)
    if fit.uncertainty.considered and fit.linear is not None:
        covariance = white_covariance(fit.linear).covariance
    elif fit.covariance_kind.startswith("sandwich"):
        # The sandwich covariance of a fit is larger than the covariance of a density with white
        # errors. For many recordings it may be singular as well; a sampler could then not scale its
        # draws by the Cholesky factor of this covariance.
        size = np.sqrt(np.diagonal(covariance))
        definite = np.linalg.eigvalsh(covariance / np.outer(size, size)).min() > 1e-10
        if (has_deterministic_motion or not definite) and fit.linear is not None:
            covariance = white_covariance(fit.linear).covariance
    return covariance
