"""Good calls: filters, smoothers, posteriors."""

import functools

import jax
import numpy as np
from surface import scenes as s
from surface.calls import leave_out, row
from surface.scenes import TS, V

import rigidjax as rj
from rigidjax import identify

HOST = dict(host=True, transforms=())
FEW = dict(groups=("stranger", "kind", "function"), transforms=())


@functools.cache
def model():
    record = identify.Recording(TS, (identify.Gyro(0.1), np.tile(V, (len(TS), 1))))
    return identify.Model(record, identify.Known(s.inertia()), process=rj.torques.RandomTorque(0.1))


@functools.cache
def belief():
    return identify.first_belief(model(), state=rj.Spin(V), rate=0.1)


row("motion.torques.RandomTorque", dict(density=np.abs(V)))
row("motion.torques.CorrelatedTorque", dict(density=np.abs(V), time=0.5))
row(
    "identify.Walk",
    dict(where=lambda s: s.sensors[0].bias, deviation=0.1, density=0.2),
    arguments=("deviation", "density"),
    groups=("stranger", "nan", "inf"),
    transforms=(),
)
row(
    "identify.first_belief",
    lambda: dict(model=model(), x=model().start(), state=s.attitude(), rate=0.1, attitude=0.2),
    groups=("stranger", "nan"),
    arguments=("model", "x", "state", "rate", "attitude"),
    transforms=(),
)
for name in ("filter", "smooth", "log_likelihood"):
    row(
        f"identify.{name}",
        lambda: dict(model=model(), belief=belief(), x=model().start()),
        groups=("stranger",),
        transforms=(),
    )
row(
    "identify.step",
    lambda: dict(model=model(), belief=belief(), t=0.3, reading=V, x=model().start()),
    run=lambda model, belief, t, reading, x: identify.step(model, belief, t, reading, x=x),
    groups=("stranger", "shape"),
    transforms=(),
)
row(
    "identify.sample",
    lambda: dict(
        key=jax.random.key(0), body=s.inertia(), state0=s.spin(), ts=TS, substeps=2,
        process=rj.torques.RandomTorque(0.1), torque=s.damping(),
    ),
    groups=("stranger",),
    transforms=(),
)  # fmt: skip
row(
    "identify.Nuts",
    dict(samples=10, warmup=10, acceptance=0.8),
    groups=("stranger",),
    transforms=(),
)
leave_out("made by first_belief and by each filter", "identify.Belief")
leave_out(
    "what a function returns",
    *(
        f"identify.{name}"
        for name in ("Filtered", "Smoothed", "Push", "Sampled", "ReadNumbers", "ExtendedState")
    ),
)
leave_out("made of a fit, which takes long; see tests/identify/inference", "identify.LogDensity")
leave_out(
    "takes a LogDensity, and long; see tests/identify/inference",
    *(f"identify.{name}" for name in ("posterior", "Posterior", "refit", "Refit")),
)
