"""Provide the radar observations of the tumbling asteroid 4179 Toutatis from December 1992.

Published figures: Y. Takahashi, M. W. Busch, D. J. Scheeres, "Spin state and moment of inertia
characterization of 4179 Toutatis", The Astronomical Journal 146:95 (2013), table 3,
doi:10.1088/0004-6256/146/4/95; from the radar imaging of R. S. Hudson and S. J. Ostro, Science
270:84 (1995).
"""

from datetime import datetime

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax import exact
from rigidjax._names import define_dir_and_getattr
from rigidjax.body import spatial_angular_momentum
from rigidjax.body.inertia import Inertia
from rigidjax.identify.answer.result import Fit, value_and_interval_of
from rigidjax.identify.answer.table import Row
from rigidjax.identify.data.recording import Recording
from rigidjax.identify.model.charts import PrincipalRatios
from rigidjax.identify.model.model import Model
from rigidjax.identify.model.priors import SoftL1
from rigidjax.identify.sensors import AttitudeSensor, Gyro
from rigidjax.motion import Attitude
from rigidjax.rotation import euler

CITATION = "Takahashi, Busch & Scheeres 2013, AJ 146:95, table 3"
DAY = 86400.0

# Each row has the date and time in UTC, three Euler angles, and three components of the body rate.
# The angles (φ, θ, ψ) of the 3-1-3 sequence, in degrees, are those of the body axes against the
# ecliptic of J2000. The rate is in degrees a day. The long axis of Toutatis is body z.
OBSERVATIONS = (
    ("1992-12-02T21:40", 122.2, 86.5, 107.0, -35.6, 7.2, -97.0),
    ("1992-12-03T19:30", 86.3, 81.8, 24.5, -16.4, -29.1, -91.9),
    ("1992-12-04T18:10", 47.8, 60.7, 284.0, 29.1, -23.2, -97.8),
    ("1992-12-05T18:50", 14.6, 39.4, 207.1, 33.3, 8.2, -92.2),
    ("1992-12-06T17:30", 331.3, 23.7, 151.6, 6.6, 34.5, -95.8),
    ("1992-12-07T17:20", 222.5, 25.4, 143.9, 12.8, 25.4, -104.1),
    ("1992-12-08T16:40", 169.8, 45.5, 106.9, -31.1, -21.9, -97.7),
    ("1992-12-09T17:50", 137.3, 71.3, 22.3, 11.8, -36.9, -94.9),
    ("1992-12-10T17:20", 103.1, 85.2, 292.6, 35.8, -8.9, -97.9),
    ("1992-12-11T09:40", 77.0, 85.7, 225.5, 31.0, 17.0, -96.3),
    ("1992-12-12T09:20", 42.8, 70.2, 133.2, -1.3, 37.0, -95.9),
    ("1992-12-13T08:10", 13.7, 44.4, 51.9, -38.3, 17.9, -97.3),
    ("1992-12-14T07:50", 323.7, 14.0, 0.0, -70.5, -30.6, -91.1),
    ("1992-12-15T07:50", 193.2, 24.4, 21.4, 22.1, -26.6, -96.6),
    ("1992-12-16T07:10", 165.1, 46.4, 310.6, 33.4, -3.4, -93.7),
    ("1992-12-17T06:49", 130.6, 76.1, 234.9, 12.6, 33.9, -94.0),
    ("1992-12-18T07:09", 91.6, 81.6, 142.4, -24.3, 29.6, -102.0),
)
# ATTITUDE_NOISE_DEG is the standard deviation of a direction in the paper of CITATION, whose table
# is OBSERVATIONS. That paper has no standard deviation of the rates: RATE_NOISE_DEG_A_DAY is twice
# the scatter of the rates about the fit.
ATTITUDE_NOISE_DEG = 15.0
RATE_NOISE_DEG_A_DAY = 10.0


def recording() -> Recording:
    """Return the 17 radar observations of the asteroid Toutatis: times, attitudes and body rates.

    The times are in s since the first observation, the attitudes map body axes to the ecliptic axes
    of J2000, and the rates are in rad/s.

    >>> recording().t.shape
    (17,)
    """
    when = [datetime.fromisoformat(row[0]) for row in OBSERVATIONS]
    t = np.array([(moment - when[0]).total_seconds() for moment in when])
    angles = jnp.asarray(np.radians([row[1:4] for row in OBSERVATIONS]))
    # The matrix of the published angles maps ecliptic to body coordinates. The same three angles in
    # the order of eq 31 of the notes give the transpose of this matrix, body → ecliptic.
    attitudes = _attitudes(angles)
    rates = np.radians([row[4:7] for row in OBSERVATIONS]) / DAY
    sensor = AttitudeSensor(np.radians(ATTITUDE_NOISE_DEG))
    gyro = Gyro(np.radians(RATE_NOISE_DEG_A_DAY) / DAY)
    return Recording(t, (sensor, attitudes), (gyro, rates))


# Compiled once, for all calls of `recording`.
_attitudes = jax.jit(jax.vmap(lambda angles: euler.to_quaternion(angles, sequence="ZXZ")))


def model() -> Model:
    """Return the model of Toutatis as a free body in principal axes, with a robust loss.

    The loss grows linearly with the size of an outlier, not quadratically.

    >>> model().charts[0].log_names
    ('Ix/Iz', 'Iy/Iz')
    """
    return Model(recording(), PrincipalRatios(), loss=SoftL1())


@jax.jit
def _periods_and_direction(body: Inertia, state: Attitude) -> Float[Array, "4"]:
    """Return the logarithms of the rotation and the precession period, days, and the longitude and
    latitude, rad, of the angular momentum in world axes.
    """
    turning = exact.body_period(body, state.omega)
    precessing = exact.precession_period(body, state.omega)
    momentum = spatial_angular_momentum(body, state)
    longitude = jnp.arctan2(momentum[1], momentum[0])
    latitude = jnp.arctan2(momentum[2], jnp.hypot(momentum[0], momentum[1]))
    return jnp.stack([jnp.log(turning / DAY), jnp.log(precessing / DAY), longitude, latitude])


def rows(fit: Fit) -> list[Row]:
    """Return the periods and the direction of the angular momentum as rows for `report.table`.

    **Arguments:** `fit` the fit of the model that `model()` returns. **Returns** rows (name, value,
    low, high, unit), where low and high are the ends of the 95 % interval: two periods, days, and
    the ecliptic longitude and latitude (J2000) of the angular momentum, degrees.
    """
    value_low_high = value_and_interval_of(
        fit, lambda point: _periods_and_direction(point.body, point.state0)
    )
    names = ("rotation about the long axis", "precession of the long axis")
    # The interval of a quantity that the data do not determine may end at infinity.
    with np.errstate(over="ignore"):
        periods = np.exp(value_low_high)[:, :2].T.tolist()
    out: list[Row] = [(name, *row, "day") for name, row in zip(names, periods, strict=True)]
    names = ("angular momentum, longitude", "angular momentum, latitude")
    directions = np.degrees(value_low_high)[:, 2:].T.tolist()
    for name, numbers in zip(names, directions, strict=True):
        turn = 360.0 if "longitude" in name and numbers[0] < 0 else 0.0
        out.append((name, *(number + turn for number in numbers), "deg, ecliptic J2000"))
    return out


def rms_degrees(fit: Fit) -> float:
    """Return the root mean square of the angles between observed and fitted attitudes, degrees.

    `fit` is the fit of the observations.
    """
    return float(np.degrees(fit.rms[0]))


def remarks(fit: Fit) -> str:
    """Return sentences about the observations that are outliers of the `fit`, and about the
    noise.
    """
    lines = []
    scatter = rms_degrees(fit) / np.sqrt(3)
    if scatter < 0.5 * ATTITUDE_NOISE_DEG:
        lines.append(
            f"The attitudes scatter by {scatter:.0f} deg an axis, less than the "
            f"{ATTITUDE_NOISE_DEG:.0f} deg that was published; the intervals keep the published "
            "figure."
        )
    errors = np.linalg.norm(np.degrees(np.asarray(fit.residuals[1])) * DAY, axis=1)
    for index in np.flatnonzero(errors > 3 * RATE_NOISE_DEG_A_DAY):
        day = OBSERVATIONS[index][0][:10]
        words = f"outlier: the rate of {day} is {errors[index]:.0f} deg/day off"
        lines.append(f"{words} (it counts linearly, not quadratically)")
    return "\n".join(lines)


__all__ = [
    "ATTITUDE_NOISE_DEG", "CITATION", "DAY", "OBSERVATIONS", "RATE_NOISE_DEG_A_DAY", "model",
    "recording", "remarks", "rms_degrees", "rows",
]  # fmt: skip

define_dir_and_getattr(__name__)
