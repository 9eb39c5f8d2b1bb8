"""Map one number to the moment of a body about the axis of its suspension."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.identify.model.charts import AbstractBodyChart, Numbers
from rigidjax.motion.suspension import AbstractSuspension, moment_about


class Moment(AbstractBodyChart):
    """Map one number to the moment of inertia about the axis of a suspension, which is all that a
    swing shows of a body.

    The inertia of the `guess` about its centre of mass is multiplied by a factor. Mass and centre
    of mass are those of the guess: of a pendulum, which shows only the moment over the mass times
    the arm, they have to be right. For an `Axle` the moment is that about the axle, with the mass
    times the square of the arm; for a `TorsionBar` and `Strings` that about the centre of mass.

    **Arguments:** `guess` a `MassProperties`, or for a `TorsionBar` an `Inertia`, of about the
    right size; `suspension` that of the model's `torque`. **Raises:** `TypeError` if they do not
    fit together; `ValueError` for a guess without a moment about the axis.

    >>> rod = rj.shapes.box(0.3, [0.02, 0.02, 0.6])
    >>> chart = Moment(rod, rj.suspensions.Axle([0, 1, 0], [0, 0, 0.3]))
    >>> round(float(jnp.exp(chart.logs(rod))[0]), 5)  # 0.3 (0.6² + 0.02²)/12 + 0.3·0.3²
    0.03601
    """

    guess: Inertia | MassProperties
    suspension: AbstractSuspension
    size: ClassVar[int] = 1
    log_names: ClassVar[tuple[str, ...]] = ("moment",)
    unit: ClassVar[str] = "kg m²"

    def __check_init__(self) -> None:
        _checks.require_instance(self.suspension, AbstractSuspension, "suspension")
        self.suspension.require_body(self.guess)
        own = moment_about(self.suspension.unit, self.guess)
        if _checks.is_known(own) and not own > 0:
            raise ValueError(f"guess: wanted a moment about the axis, got {float(own):.3g} kg m²")

    def body(self, vector: Numbers) -> Inertia | MassProperties:
        own = moment_about(self.suspension.unit, self.guess)
        factor = 1 + jnp.expm1(vector[0]) * self._moment(self.guess) / own
        pick: Any = lambda body: body.second_moment  # noqa: E731
        if isinstance(self.guess, Inertia):
            pick = lambda body: body.tensor  # noqa: E731
        return eqx.tree_at(pick, self.guess, factor * pick(self.guess))

    def vector(self, body: Inertia | MassProperties) -> Numbers:
        return self.logs(body) - self.logs(self.guess)

    def logs(self, body: Inertia | MassProperties) -> Float[Array, "1"]:
        return jnp.log(self._moment(body))[None]

    def _moment(self, body: Inertia | MassProperties) -> Array:
        return self.suspension.moment(body, 0.0)
