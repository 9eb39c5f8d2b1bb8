"""What is known, what is free, and how far a guess is from the data."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax._types import HasAttitude, HasSpin, Quat, Scalar
from rigidjax.body.inertia import Inertia
from rigidjax.exact import FreeBody
from rigidjax.identify.bodies import AbstractBodyChart
from rigidjax.identify.loss import SoftL1
from rigidjax.identify.recording import Recording
from rigidjax.identify.sensors import AttitudeSensor, Gyro
from rigidjax.motion import Attitude, Spin
from rigidjax.motion.torques import Torque
from rigidjax.rotation import quaternion
from rigidjax.solve import simulate


class Parameters(eqx.Module):
    """The free numbers of a fit, all unconstrained and of order one.

    **Fields:** `body` the chart's numbers; `spin` (3,) the first body rate over the typical rate;
    `turn` (3,) the rotation vector from the reference attitude to the first one (body frame, rad),
    or `None` where no sensor sees the attitude.
    """

    body: Float[Array, " chart"]
    spin: Float[Array, "3"]
    turn: Float[Array, "3"] | None


class Problem(eqx.Module):
    """A recording, and what of the motion behind it is free.

    **Arguments:** `recording`; `body` the chart of the inertia, such as `Ratios()` (the full tensor
    up to scale) or `PrincipalRatios()` (body axes known to be principal); `torque` what turns the
    body besides its own spin, or `None`; `loss` how an outlier counts: `SoftL1()`, or `None` for
    plain least squares. The motion starts at the first time of the recording.

    **Raises:** `TypeError` for arguments of another kind.

    >>> import rigidjax as rj
    >>> record = rj.identify.Recording([0.0, 1.0], (rj.identify.Gyro(), [[1.0, 0, 0]] * 2))
    >>> rj.identify.Problem(record, rj.identify.Ratios()).typical_rate
    Array(1., dtype=float64)
    """

    recording: Recording
    body: AbstractBodyChart
    torque: Torque | None
    loss: SoftL1 | None
    reference: Quat | None
    typical_rate: Scalar

    def __init__(
        self,
        recording: Recording,
        body: AbstractBodyChart,
        *,
        torque: Torque | None = None,
        loss: SoftL1 | None = None,
    ):
        if not isinstance(recording, Recording):
            raise TypeError(f"Problem: wanted a Recording, got {type(recording).__name__}")
        if not isinstance(body, AbstractBodyChart):
            raise TypeError(
                "Problem: wanted what of the body is free, such as Ratios() or PrincipalRatios(), "
                f"got {type(body).__name__}"
            )
        self.recording, self.body, self.torque, self.loss = recording, body, torque, loss
        self.reference = _first_attitude(recording)
        # An array, not a float: another recording must not compile again.
        self.typical_rate = jnp.asarray(_typical_rate(recording), recording.t.dtype)

    def unpack(self, parameters: Parameters) -> tuple[Inertia, Spin | Attitude]:
        """The body and the first state that the parameters stand for."""
        omega = parameters.spin * self.typical_rate
        body = self.body.inertia(parameters.body)
        if self.reference is None or parameters.turn is None:
            return body, Spin(omega)
        q = quaternion.multiply(self.reference, quaternion.exp(parameters.turn))
        return body, Attitude(q, omega)

    def motion(self, parameters: Parameters) -> HasSpin:
        """The states at the recording's times, with a leading time axis."""
        body, state0 = self.unpack(parameters)
        if self.torque is None:
            # The checks of `simulate` are for users; inside a fit they are host callbacks.
            return jax.vmap(FreeBody(body, state0))(self.recording.t - self.recording.t[0])
        out = simulate(
            body, state0, self.recording.t, self.torque, adjoint=dfx.ForwardMode(), throw=False
        )
        return out.ys

    def errors(self, parameters: Parameters) -> tuple[Float[Array, "times 3"], ...]:
        """Reading minus prediction for each sensor, in its unit; zero where masked."""
        states = self.motion(parameters)
        out = []
        for reading in self.recording.readings:
            error = jax.vmap(reading.sensor.error)(states, reading.values)
            out.append(jnp.where(reading.mask[:, None], error, 0.0))
        return tuple(out)


def _typical_rate(recording: Recording) -> float:
    for reading in recording.readings:
        if isinstance(reading.sensor, Gyro):
            values = np.asarray(reading.values)[reading.seen]
            rate = float(np.sqrt(np.mean(np.sum(values**2, axis=1))))
            break
    else:
        rate = float(np.linalg.norm(attitude_rate(recording)))
    return rate if rate > 0 else 1.0


def _first_attitude(recording: Recording) -> Quat | None:
    for reading in recording.readings:
        if isinstance(reading.sensor, AttitudeSensor):
            return reading.values[int(np.argmax(reading.seen))]
        if reading.sensor.feels is HasAttitude:
            return jnp.array([1.0, 0.0, 0.0, 0.0])
    return None


def attitude_rate(recording: Recording) -> np.ndarray:
    """A first body rate (3,), rad/s, from the first two attitudes; zero where there are none."""
    for reading in recording.readings:
        if isinstance(reading.sensor, AttitudeSensor):
            seen = np.flatnonzero(reading.seen)[:2]
            if seen.size == 2:
                first, second = reading.values[seen[0]], reading.values[seen[1]]
                turn = quaternion.log(quaternion.multiply(quaternion.conjugate(first), second))
                return np.asarray(turn) / float(recording.t[seen[1]] - recording.t[seen[0]])
    return np.zeros(3)
