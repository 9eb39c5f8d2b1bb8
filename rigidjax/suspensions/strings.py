"""Hang a body on two or more strings: a bifilar or trifilar pendulum."""

import math
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax import _checks, _show
from rigidjax._types import Scalar, ScalarLike, Vec3
from rigidjax.body.inertia import Body, MassProperties
from rigidjax.motion import Turn
from rigidjax.motion.suspension import (
    AbstractSuspension,
    Friction,
    TurnEquations,
    applied,
    moment_about,
)
from rigidjax.motion.torques import base
from rigidjax.rotation.linalg3 import dot

# The number of nodes in a quarter of a swing. The rule of the midpoint converges as e^(−4ny) for n
# nodes, where y is the distance of the integrand's poles from the real axis; y is 0.14 for a swing
# of 164°.
_NODES = 96


class Strings(AbstractSuspension):
    """Hang a body on two, three or more vertical strings, at equal angles about a vertical axis
    through its centre of mass: a bifilar or trifilar pendulum.

    A turn by γ lifts the body: `h(γ) = √(l² − (a − b)² − 4ab sin² ½γ)` is the height of the upper
    ends above the lower ones, `V = −m g h`, and `M = y·Iy + m h'²` contains the energy of the lift,
    which the formula of small swings, `T = 2π √(I h(0)/(m g a b))`, needs not. **Arguments:**

    - `number` of strings, 2 or more; `radius_above` a and `radius_below` b, m, the distances of
      their ends from the axis; `length` l of each string, m;
    - `axis` (3,), body frame, of any length, upwards; `gravity` g, m/s², a positive number, down;
    - `friction`: a `Friction`, or `None`; `torque`: any other torque or force, or `None`.

    Strings pull only: a run in which they would push, or in which |γ| reaches π (the strings
    touch), ends there with a `ValueError`; with `throw=False` `simulate` keeps what came before,
    and `sol.stats` has the `end_time`. This is looked at at the ends of steps. The body is a
    `MassProperties`; its centre of mass is taken to be at the level of the lower ends. **Raises:**
    `ValueError` for a number that is not positive, and for strings that are too short. Source: Kane
    and Tseng 1967, Dynamics of the bifilar pendulum, Int. J. Mech. Sci. 9.

    >>> plate = rj.shapes.box(1.2, [0.3, 0.3, 0.02])
    >>> two = Strings(2, 0.1, 0.1, 0.8)
    >>> round(float(two.moment(plate, 1.0) / two.moment(plate, 0.0)), 4)
    1.0075
    """

    solvable: ClassVar[bool] = False
    number: int = eqx.field(static=True, converter=lambda n: _checks.integer(n, "number", 2))
    radius_above: Float[Array, ""] = eqx.field(converter=base.positive_converter("radius_above"))
    radius_below: Float[Array, ""] = eqx.field(converter=base.positive_converter("radius_below"))
    length: Float[Array, ""] = eqx.field(converter=base.positive_converter("length"))
    axis: Float[Array, "3"] = eqx.field(
        converter=base.vector_converter("axis"), default=(0.0, 0.0, 1.0)
    )
    gravity: Float[Array, ""] = eqx.field(
        converter=base.positive_converter("gravity"), default=9.80665
    )
    friction: Friction | None = None
    torque: Any = None

    def __check_init__(self) -> None:
        reach = self.length - jnp.abs(self.radius_above - self.radius_below)
        if _checks.is_known(reach) and not reach > 0:
            raise ValueError(
                "length: wanted strings longer than |radius_above − radius_below|, got "
                f"{float(self.length):.6g}"
            )

    def swing(self, body: Body, start: Turn) -> None:
        """Return nothing: no closed form is known."""

    def height(self, angle: ScalarLike) -> Scalar:
        """Return the height h(γ), m, of the upper ends above the lower ones; NaN where no strings
        of this length reach.
        """
        return self._height(jnp.sin(0.5 * jnp.asarray(angle)) ** 2)

    def moment(self, body: MassProperties, angle: ScalarLike) -> Scalar:
        return self._moment(body, jnp.sin(0.5 * jnp.asarray(angle)) ** 2)

    def potential(self, body: MassProperties, angle: ScalarLike) -> Scalar:
        return -body.mass * self.gravity * self.height(angle)

    def place(self, body: MassProperties, angle: ScalarLike) -> Vec3:
        return -self.height(angle) * self.unit

    def period(self, body: MassProperties, amplitude: ScalarLike) -> Scalar:
        """Return `4 ∫ √(M/2(V(α) − V(γ))) dγ` from 0 to the amplitude α.

        With `sin ½γ = k sin φ` and `k = sin ½α` it is `4 ∫ √(M (h + h(α))/(2 m g a b (1 − k² sin²
        φ))) dφ` over a quarter turn, whose integrand is smooth and periodic: the rule of the
        midpoint converges exponentially.
        """
        k2 = jnp.sin(0.5 * amplitude) ** 2
        nodes = (jnp.arange(_NODES, dtype=k2.dtype) + 0.5) * (0.5 * math.pi / _NODES)
        square = k2 * jnp.sin(nodes) ** 2
        pull = 2 * body.mass * self.gravity * self.radius_above * self.radius_below
        heights = self._height(square) + self._height(k2)
        root = jnp.sqrt(self._moment(body, square) * heights / (pull * (1 - square)))
        return 2 * math.pi * jnp.mean(root)

    def tension(self, body: MassProperties, turn: Turn, t: ScalarLike = 0.0) -> Scalar:
        """Return the tension of each string, N, at the time `t`, s: `m (g − ḧ)/n · l/h`, less what
        the law `torque` carries.

        >>> plate = rj.shapes.box(1.2, [0.3, 0.3, 0.02])
        >>> round(float(Strings(2, 0.1, 0.1, 0.8).tension(plate, rj.Turn(0.0, 0.0))), 6)
        5.88399
        """
        y, dtype = turn, turn.angle.dtype
        law, body = base.in_precision((self, body), dtype)
        field = TurnEquations(body, law)
        rate = lambda y: jax.jvp(law.height, (y.angle,), (y.rate,))[1]  # noqa: E731
        lift = jax.jvp(rate, (y,), (field(t, y),))[1]
        force = applied(law, t, y, body)[0]
        carried = 0.0 if force is None else dot(force, law.unit)
        pull = body.mass * (law.gravity - lift) - carried
        return pull * law.length / (law.number * law.height(y.angle))

    def ends(self, t: ScalarLike, turn: Turn, body: MassProperties) -> Array:
        """Return whether the strings are slack, or touch."""
        return (self.tension(body, turn, t) <= 0) | (jnp.abs(turn.angle) >= jnp.pi)

    def end_words(self, t: ScalarLike, turn: Turn) -> str:
        """Return why the run ends."""
        where = ""
        if _checks.is_known((t, turn)):
            angle = float(turn.angle)
            where = f" at t = {_show.time_as_text(t, 1.0)} s, at the angle {angle:.4g} rad"
        return f"the strings go slack or touch{where}; take a slower swing, or longer strings"

    def _height(self, square: Array) -> Array:
        """Return h from sin² ½γ."""
        product = 4 * self.radius_above * self.radius_below
        apart = self.radius_above - self.radius_below
        return jnp.sqrt((self.length - apart) * (self.length + apart) - product * square)

    def _moment(self, body: MassProperties, square: Array) -> Array:
        """Return M from sin² ½γ, with h' = −ab sin γ/h."""
        lift = 2 * self.radius_above * self.radius_below / self._height(square)
        return moment_about(self.unit, body) + body.mass * lift**2 * square * (1 - square)
