"""Define a sensor of the brightness of a body, whose readings are a light curve."""

import math
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import HasAttitude, NumbersLike, Scalar, ScalarLike, Vec3
from rigidjax.identify.sensors import base
from rigidjax.identify.sensors.base import AbstractSensor, SensorInput
from rigidjax.motion.torques.base import vector_at
from rigidjax.rotation import quaternion
from rigidjax.rotation.linalg3 import determinant, dot
from rigidjax.tumblers.brightness import AbstractScattering
from rigidjax.tumblers.scattering import scattering_or_default, unit_direction

UNITS = ("flux", "mag")


class Brightness(AbstractSensor):
    """Measure the brightness of an ellipsoid in sunlight; the readings are a light curve.

    A flux is `level · B/(π (abc)^⅔)`, a magnitude `level − 2.5 log₁₀(B/(π (abc)^⅔))`, with B the
    result of `rj.tumblers.brightness.ellipsoid` for the semi-axes a, b, c. The level is therefore
    the brightness of a sphere of the same volume at zero phase, and the prediction depends only on
    the ratios of the semi-axes. Readings (T,) are reduced to unit distances from sun and observer.
    Zero phase means that sun and observer are in the same direction.

    Some rotations of the attitude in the world do not change the brightness, so that a light curve
    does not determine them. For fixed directions such rotations are the half turns about `sun ×
    observer` and, except for `Geometric`, about the sum and the difference of the two directions. A
    `fit` assumes an ellipsoid; `fit_light_curve` allows for other shapes. Source: as
    `rigidjax.tumblers.brightness`; for tumblers Kaasalainen 2001, A&A 376:302,
    doi:10.1051/0004-6361:20010935.

    **Arguments:**

    - `sun`, `observer`: the directions from the body to sun and observer, world frame, of any
      length: a vector (3,), or a function of the time t, s, that returns a vector (3,), such as
      `torques.Linear(times, directions)`.
    - `scattering`: the law, `LommelSeeliger()` (also for `None`), `Geometric()` or `Lambert()` of
      `rj.tumblers.brightness`.
    - `noise`: the standard deviation of a reading, in its unit; `None` to estimate it.
    - `unit`: the unit of a reading, `"flux"` or `"mag"`.
    - `level`: the flux or magnitude of a sphere of the same volume at zero phase; `None` for a flux
      of 1 or a magnitude of 0. The level is seldom known: make it a `Free`.
    - `semi_axes`: (3,) along the body's axes; `None` for those of the uniform ellipsoid whose
      moments of inertia have the same ratios as the moments of the body. These semi-axes are
      proportional to √λ_k, where λ_k are the second moments of the body.
    - `offset`: the clock offset, s: the reading with the time stamp t was taken at t + offset.

    **Raises** `ValueError` for a direction of length zero, a noise or semi-axis that is not
    positive.

    >>> Brightness([1.0, 0.0, 0.0], [0.0, 1.0, 0.0], noise=0.02, unit="mag").components
    1
    """

    reading_shape: ClassVar[tuple[int, ...]] = ()
    components: ClassVar[int] = 1
    feels: ClassVar[type] = HasAttitude
    suspect: ClassVar[tuple[str, str, str]] = (
        "shape",
        "perhaps a shape that is no ellipsoid: then the motion may be right all the same",
        "take the intervals of fit_light_curve, which allow for such a shape",
    )
    unit: str = eqx.field(static=True)  # pyright: ignore[reportIncompatibleVariableOverride]
    sun: Any
    observer: Any
    scattering: AbstractScattering
    noise: Float[Array, "1"] | None
    level: Scalar
    semi_axes: Float[Array, "3"] | None
    offset: Scalar | None

    def __init__(
        self,
        sun: NumbersLike | Callable[..., Any],
        observer: NumbersLike | Callable[..., Any],
        scattering: AbstractScattering | None = None,
        *,
        noise: NumbersLike | None = None,
        unit: str = "flux",
        level: NumbersLike | None = None,
        semi_axes: NumbersLike | None = None,
        offset: NumbersLike | None = None,
    ):
        self.sun = _checked_direction(sun, "sun")
        self.observer = _checked_direction(observer, "observer")
        self.scattering = scattering_or_default(scattering)
        self.noise = base.deviations_field(1)(noise)
        self.unit = _checks.require_option(unit, UNITS, "unit")
        usual = 1.0 if unit == "flux" else 0.0
        checked_level = base.array_field("level", ())(usual if level is None else level)
        if unit == "flux":
            words = "level: wanted a positive flux, since the unit is 'flux'"
            checked_level = _checks.error_if(checked_level, ~(checked_level > 0), words)
        self.level = checked_level
        if semi_axes is not None:
            semi_axes = _checks.array_of_shape(semi_axes, (3,), "semi_axes").astype(float)
            semi_axes = _checks.require_positive(semi_axes, "semi_axes", "three positive lengths")
        self.semi_axes = semi_axes
        self.offset = base.optional_array_field("offset", ())(offset)

    def error(self, motion: SensorInput, reading: Array) -> Float[Array, "1"]:
        return (reading - self.predict(motion))[None]

    def predict(self, motion: SensorInput) -> Scalar:
        """Return the predicted flux or magnitude, without noise."""
        shape = motion.body.second_moment
        if self.semi_axes is not None:
            shape = jnp.diag(self.semi_axes * self.semi_axes)
        shape = shape / jnp.trace(shape)
        q = motion.state.q
        sun, observer = (
            quaternion.rotate_inverse(q, v) for v in directions_at(self, motion.t, q.dtype)
        )
        area = self.scattering.of_ellipsoid(shape, sun, observer)
        relative = area / (math.pi * jnp.cbrt(determinant(shape)))
        if self.unit == "flux":
            return self.level * relative
        # If the observer does not see the lit side, the flux is 0 and the magnitude infinite. The
        # magnitude is therefore bounded, by 30 above the level, which is fainter than any reading.
        visible = relative > 1e-12
        return self.level - 2.5 / math.log(10.0) * jnp.log(jnp.where(visible, relative, 1e-12))

    def typical_rate(self, t: np.ndarray, values: np.ndarray) -> float:
        """Return a rough rate of the body, rad/s: half of the angular frequency of the strongest
        line in the spectrum of the first 1000 readings, because the brightness of an ellipsoid has
        two maxima in a turn.
        """
        t, values = t[:1000], values[:1000]
        if t.size < 10 or np.ptp(values) == 0:
            return 0.0
        span = t[-1] - t[0]
        highest = min(0.25 / np.median(np.diff(t)), 500.0 / span)
        turns = 2.0 * np.pi * np.arange(0.5 / span, max(highest, 1.0 / span), 0.25 / span)
        waves = np.exp(1j * turns[:, None] * (t - t[0]))
        power = np.abs(waves @ (values - values.mean()))
        return 0.5 * float(turns[np.argmax(power)])

    def refusal(self, values: np.ndarray) -> tuple[np.ndarray, str]:
        """Return a mask of the `values` that must be refused, and a message with the reason: those
        that are a flux below −10 times the noise, or the standard deviation of `values` if no noise
        is given.
        """
        noise = np.std(values) if self.noise is None else np.asarray(self.noise)[0]
        wrong = values < 0 if self.unit == "flux" else np.zeros(values.shape, bool)
        wrong = wrong & (np.abs(values) > 10 * noise)
        words = "the flux at index {index} is far below zero; magnitudes are read with unit='mag'"
        return wrong, words


def directions_at(sensor: Brightness, t: ScalarLike, dtype: DTypeLike | None = None) -> list[Vec3]:
    """Return the unit vectors from the body to sun and observer at `t`, s, world frame."""
    vectors = vector_at(sensor.sun, t, "sun"), vector_at(sensor.observer, t, "observer")
    return [_unit(v if dtype is None else v.astype(dtype)) for v in vectors]


def bisector_at(sensor: Brightness, t: ScalarLike) -> Vec3:
    """Return the unit vector half way between sun and observer, world frame."""
    sun, observer = directions_at(sensor, t)
    return _unit(sun + observer)


def _unit(v: Vec3) -> Vec3:
    """Return the unit vector along a vector that is not zero."""
    return v / jnp.sqrt(dot(v, v))


def _checked_direction(
    source: NumbersLike | Callable[..., Any], name: str
) -> Vec3 | Callable[..., Any]:
    """Return a direction of any length as its unit vector, or a function of time, after a check."""
    if callable(source):
        return _checks.require_function(source, name, "of time to (3,)")
    shape = _checks.numeric_array(source, name).shape
    if len(shape) == 2 and shape[1] == 3:
        raise ValueError(
            f"{name}: wanted a direction (3,) or a function of time, got shape {shape}; one row "
            "for each time is rigidjax.torques.Linear(times, directions)"
        )
    return unit_direction(source, name).astype(jnp.result_type(float))
