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


row("Turn", dict(angle=0.3, rate=-0.5))
row("suspensions.Axle", dict(axis=s.V, point=s.W, gravity=s.DOWN))
row("suspensions.Friction", dict(viscous=0.1, quadratic=0.2, coulomb=0.3, width=0.1))
row("suspensions.TorsionBar", dict(axis=s.V, stiffness=0.4))
row(
    "suspensions.Strings",
    dict(number=3, radius_above=0.1, radius_below=0.12, length=0.8, axis=s.V, gravity=9.81),
    traced=("radius_above", "radius_below", "length", "axis", "gravity"),
)
for name, suspension in {"Axle": axle, "Strings": strings, "TorsionBar": bar}.items():
    row(
        f"suspensions.period ({name})",
        lambda suspension=suspension: dict(
            body=s.body(), suspension=suspension(), amplitude=jnp.asarray(0.7)
        ),
        run=rj.suspensions.period,
    )
row(
    "identify.Moment",
    lambda: dict(guess=s.body(), suspension=axle()),
    groups=("stranger", "shape", "nan"),
)
leave_out("abstract: made by subclassing", "motion.AbstractSuspension")
leave_out("made by a suspension's swing", "suspensions.Swing", "suspensions.Twist")
