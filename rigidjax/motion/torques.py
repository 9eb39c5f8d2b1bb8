"""Torques. Each names the lowest rung that can feel it, and feels nothing below."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax._types import HasSpin, ScalarLike, Vec3


class AbstractTorque(eqx.Module):
    """A torque on a body: called with the time, the state and the body, gives N m in body axes.

    Subclass it for your own; `feels` is the lowest rung that has what you read from the state:
    `HasSpin` (`.omega`), `HasAttitude` (also `.q`) or `HasPose` (also `.x`, `.v`).
    """

    feels: eqx.AbstractClassVar[type]

    @abc.abstractmethod
    def __call__(self, t: ScalarLike, state: Any, body: Any) -> Vec3:
        """Torque (3,), N m, body frame."""


# A user's own callable Module need not subclass anything.
Torque = AbstractTorque | Callable[[Any, Any, Any], Any]


class ConstantTorque(AbstractTorque):
    """A torque that stays the same in the body, such as a thruster.

    **Arguments:** `torque` (3,) N m, body frame.

    >>> ConstantTorque([0.0, 0.0, 1.0]).feels.__name__
    'HasSpin'
    """

    feels: ClassVar[type] = HasSpin
    torque: Float[Array, "3"]

    def __init__(self, torque: Float[Array, "3"] | object):
        self.torque = _checks.floating(torque, (3,), "torque")

    def __call__(self, t: ScalarLike, state: HasSpin, body: object) -> Vec3:
        return self.torque


class Damping(AbstractTorque):
    """Linear damping `τ = −c Ω`, component by component.

    **Arguments:** `coefficient` (3,) c along the body axes, N m s/rad.

    >>> Damping([0.1, 0.1, 0.1]).coefficient.shape
    (3,)
    """

    feels: ClassVar[type] = HasSpin
    coefficient: Float[Array, "3"]

    def __init__(self, coefficient: Float[Array, "3"] | object):
        self.coefficient = _checks.floating(coefficient, (3,), "coefficient")

    def __call__(self, t: ScalarLike, state: HasSpin, body: object) -> Vec3:
        return -self.coefficient * state.omega


def require_rung(torque: Torque, state: object) -> None:
    """Raise `TypeError` unless `state` has what `torque` feels."""
    feels = getattr(torque, "feels", None)
    if feels is not None and not isinstance(state, feels):
        raise TypeError(
            f"{type(torque).__name__} needs a state with {feels.__name__} (see rigidjax's ladder "
            f"of states), got {type(state).__name__}; climb to the rung that can feel this torque"
        )


def evaluate(torque: Torque, t: ScalarLike, state: object, body: object) -> Vec3:
    """The torque's value, its shape checked: a user's own may return anything."""
    return _checks.floating(
        torque(t, state, body), (3,), f"torque {type(torque).__name__}", hint="body-frame N m"
    )
