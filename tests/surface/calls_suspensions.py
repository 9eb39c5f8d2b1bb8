"""Good calls: a body on one axis."""

import jax.numpy as jnp
from surface import scenes as s
from surface.calls import leave_out, row

import rigidjax as rj


def axle() -> rj.suspensions.Axle:
    return rj.suspensions.Axle([0.0, 1.0, 0.2], [0.1, 0.0, 0.2])


def strings() -> rj.suspensions.Strings:
    return rj.suspensions.Strings(2, 0.1, 0.12, 0.8)


def bar() -> rj.suspensions.TorsionBar:
    return rj.suspensions.TorsionBar([0.0, 0.0, 1.0], 0.4)
