"""Good calls: laws with states of their own, what lies between a command and what it does."""

import jax.numpy as jnp
import numpy as np
from surface import scenes as s
from surface.calls import KINDS, row
from surface.scenes import V, W

import rigidjax as rj
from rigidjax.identify.data.windows import Horizons
from rigidjax.motion.coupled import Coupled

AXES = np.eye(3)[:2]


def wheels() -> rj.torques.ReactionWheels:
    return rj.torques.ReactionWheels(AXES, [0.1, 0.2], [3.0, -2.0], [0.01, 0.02], viscous=0.01)


def held() -> Horizons:
    t = np.arange(8.0)
    return rj.identify.windows(t, rj.Spin(np.outer(t, V)), length=3).held_horizons()


def coupled() -> Coupled:
    return Coupled(s.attitude(), (jnp.array([0.3, -0.4]),))


row(
    "motion.torques.ReactionWheels",
    dict(
        axes=AXES,
        inertia=np.array([0.1, 0.2]),
        speeds=np.array([3.0, -2.0]),
        motor=np.array([0.01, 0.02]),
        feedback=lambda t, state, speeds: -0.1 * speeds,
        max_torque=0.1,
        max_speed=np.array([40.0, 50.0]),
        viscous=0.01,
        coulomb=0.02,
        turn_over=2.0,
    ),
)
row(
    "motion.torques.ReactionWheels.without_wheels",
    lambda: dict(self=wheels(), body=s.inertia()),
)
for name, given in {
    "speeds_of": dict(own=V[:2], state=s.attitude()),
    "torques_of": dict(t=0.3, own=V[:2], state=s.attitude()),
}.items():
    row(f"motion.torques.ReactionWheels.{name}", lambda given=given: dict(self=wheels(), **given))
row(
    "identify.Mass (some of it)",
    lambda: dict(guess=s.body(), free=("com", "mass")),
    run=rj.identify.Mass,
)
row("identify.Position", dict(noise=0.1, bias=V, offset=0.01))
row("identify.Velocity", dict(noise=0.1, place=V, mounting=0.1 * W, bias=V, offset=0.01))
row("identify.Range", dict(station=V, noise=0.1, place=W, bias=0.2, offset=0.01))
row(
    "motion.torques.Lagged",
    lambda: dict(source=s.Quadratic(jnp.asarray(3.0)), time=0.2, start=0.5),
)
row("motion.torques.Delayed", lambda: dict(source=s.Quadratic(jnp.asarray(3.0)), delay=0.2))
row(
    "motion.torques.ChangingInertia",
    lambda: dict(inertia=lambda t: (1.0 + t) * jnp.eye(3), torque=s.damping()),
)
row("motion.Coupled", lambda: dict(motion=s.attitude(), own=coupled().own), groups=())
row(
    "motion.Coupled.start",
    lambda: dict(body=s.inertia(), state0=s.attitude(), torque=wheels(), t=0.3),
    run=Coupled.start,
    arguments=("body", "state0", "t"),
    says=("own", "inertia"),
)
row(
    "plot.horizons",
    lambda: dict(results=held(), step=0.1, measure="rms"),
    groups=KINDS,
    transforms=(),
)
