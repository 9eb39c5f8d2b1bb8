"""Good calls: events, crossings, exponents, manifolds."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from surface import scenes as s
from surface.calls import KINDS, leave_out, row

import rigidjax as rj

# Second derivatives of a run compile for half a minute: the tests of their own have them.
SOME = ("jit", "vmap", "scan")


def rate(t, state, body):
    return state.omega[1] - 0.05


row("Event", lambda: dict(condition=rate, direction=1, max_step=0.5), transforms=())


def met(body, state0, t0, t1, condition, torque=None, max_step=None, **more):
    """The crossings without what is NaN because there are no more."""
    found = rj.crossings(body, state0, t0, t1, condition, torque, max_step=max_step, **more)
    good = (found.result == dfx.RESULTS.successful) | found.full
    return found.count, jnp.where(good, jnp.nan_to_num(found.times), jnp.nan)


row(
    "crossings",
    lambda: dict(
        body=s.inertia(), state0=s.attitude(), t0=0.0, t1=3.0, condition=rate, torque=s.top(),
        direction=1, max_crossings=2, max_step=0.5,
    ),
    run=met,
    arguments=(
        "body", "state0", "t0", "t1", "condition", "torque", "direction", "max_crossings", "max_step"
    ),
    groups=(*KINDS, "nan", "inf"),
    traced=("state0",),
    transforms=SOME,
    says=("inertia", "needs a state", "ts"),
)  # fmt: skip


def ended(body, state0, ts, torque, event=None):
    out = rj.simulate(body, state0, ts, torque, event=event)
    return jnp.nan_to_num(out.ys.omega), out.event_time


def decay(t, y, args):
    return jax.tree.map(lambda leaf: -0.5 * leaf, y)


row(
    "simulate (event)",
    lambda: dict(
        body=s.inertia(), state0=s.attitude(), ts=np.array([0.0, 3.0]), torque=s.top(), event=rate
    ),
    run=ended,
    arguments=("event",),
    groups=KINDS,
    transforms=(),
    says=("condition",),
)
row(
    "lyapunov_exponents",
    lambda: dict(
        field=decay, state0=np.array([0.1, 0.2]), time=2.0, number=1,
        intervals=30, transient=5, t0=0.0, max_steps=100,
    ),
    arguments=("field", "time", "number", "intervals", "transient", "t0", "max_steps"),
    groups=(*KINDS, "nan", "inf"),
    transforms=(),
)  # fmt: skip
leave_out("made by crossings", "solve.Crossings")
leave_out("made by lyapunov_exponents", "solve.Exponents")
leave_out("made by ThreeBody.manifold", "orbits.Manifold")
