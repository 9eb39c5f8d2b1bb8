"""A quadrotor from windows: fitted on all runs but two, predicted open-loop on those two.

Run `python tests/benchmarks/identify/bench_nanodrone.py FOLDER [--stride 40] [--only square]`, FOLDER with the csv files of
the nano-drone benchmark (arXiv 2512.14450): prints the mean absolute errors of a component, and the
mean lengths of the vectors, at 1, 10 and 50 samples ahead and their sum, beside a prediction that
holds the state, the free numbers with their deviations, and times. The files have no licence and are not part of this project.
"""

import argparse
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rigidjax.motion.torques.base import AbstractForce

jax.config.update("jax_enable_x64", True)

import rigidjax as rj
from rigidjax import identify, torques

HELD_OUT = ("square_run5", "random2_run4")
PLACES = 0.0353 * np.array([[1.0, -1, 0], [-1, -1, 0], [-1, 1, 0], [1, 1, 0]])
UP = np.tile([0.0, 0, 1.0], (4, 1))


class Flapping(AbstractForce):
    """The moment of rotors in a cross-flow, linear in the velocity in body axes."""

    feels = rj.motion.HasPose
    matrix: jax.Array

    def __call__(self, t, state, body):
        u = rj.quaternion.rotate_inverse(state.q, state.v)
        return torques.Wrench(0.0 * u, jnp.sum(self.matrix * u, 1))


class Between(eqx.Module):
    """The logged speeds of this sample and the next, weighed."""

    ahead: jax.Array
    now: torques.Input = torques.Input("now")
    soon: torques.Input = torques.Input("soon")

    def __call__(self, t):
        return self.now(t) + self.ahead * (self.soon(t) - self.now(t))


MASS, SPINS = 0.045, np.array([1.0, -1, 1, -1])


class Craft(AbstractForce):
    """A quadrotor: gravity, rotors about the centre of mass, drag, and what else is free."""

    feels = rj.motion.HasPose
    centre: jax.Array  # of mass, m
    thrust: jax.Array  # of each rotor, N s²
    drag: jax.Array  # of each rotor, N m s²
    linear: jax.Array  # drag of the body, kg/s
    quadratic: jax.Array  # kg/m
    damping: jax.Array  # N m s
    twist: jax.Array  # a constant torque, N m
    flap: jax.Array  # torque by velocity, body axes, N s
    speeds: Between

    def __call__(self, t, state, body):
        law = torques.Sum(
            torques.UniformGravity([0.0, 0.0, -9.81]),
            torques.Rotors(PLACES - self.centre, UP, SPINS, self.thrust, self.drag, self.speeds),
            torques.BodyDrag(self.linear, self.quadratic),
            torques.Damping(self.damping),
            torques.ConstantTorque(self.twist),
            Flapping(self.flap),
        )
        return law(t, state, body)


SIZES = dict(
    centre=1e-3, thrust=3.4e-8, drag=2e-10, linear=1e-2, quadratic=1e-2, damping=1e-6, twist=1e-5,
    flap=1e-5,
)  # fmt: skip
FREE = (
    *(identify.Free(lambda s, k=k: getattr(s.torque, k), k, scale=size) for k, size in SIZES.items()),
    identify.Free(lambda s: s.torque.speeds.ahead, "ahead"),
)  # fmt: skip
GUESS = Craft(
    centre=jnp.zeros(3), thrust=3.4e-8 * jnp.ones(4), drag=2e-10 * jnp.ones(4),
    linear=1e-2 * jnp.ones(3), quadratic=jnp.zeros(3), damping=1e-6 * jnp.ones(3),
    twist=jnp.zeros(3), flap=jnp.zeros((3, 3)), speeds=Between(jnp.asarray(0.5)),
)  # fmt: skip


class Root(identify.AbstractBodyChart):
    """A root of the second moment about the centre of mass, in units of 1e-2.5 kg^½ m."""

    size, log_names, unit = 6, ("I1", "I2", "I3"), "kg m²"

    def body(self, vector):
        first = jnp.array([1.6, 0.0, 1.4, 0.0, 0.0, 1.4])
        root = jnp.zeros((3, 3)).at[np.tril_indices(3)].set(first + vector)
        return rj.MassProperties(MASS, np.zeros(3), 1e-5 * root @ root.T)

    def vector(self, body):
        return jnp.zeros(6)

    def logs(self, body):
        return jnp.log(body.inertia.moments)


def cut(path, length, stride):
    log = np.genfromtxt(path, delimiter=",", names=True)
    of = lambda *names: np.stack([log[name] for name in names], 1)
    states = rj.Rigid(
        of("x", "y", "z"), of("vx", "vy", "vz"), of("qw", "qx", "qy", "qz"), of("wx", "wy", "wz")
    )
    speeds = of("m1", "m2", "m3", "m4")
    inputs = {"now": speeds, "soon": np.concatenate([speeds[1:], speeds[-1:]])}
    return identify.windows(log["t"], states, inputs, length=length, stride=stride)


def shown(name, errors):
    for kind, e in errors.items():
        few = "  ".join(f"{e[k]:.4f}" for k in (0, 9, 49))
        print(f"{name:12s} {kind:6s} {few}   sum {e.sum():.2f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--stride", type=int, default=40)
    parser.add_argument("--only", default="", help="fit the runs whose name begins so")
    options = parser.parse_args()
    runs = {path.stem: path for path in sorted(options.folder.glob("*.csv"))}
    train = identify.Windows.join(
        *(
            cut(path, 50, options.stride)
            for name, path in runs.items()
            if name not in HELD_OUT and name.startswith(options.only)
        )
    )
    begin = time.process_time()
    model = identify.Model(train, Root(), torque=GUESS, free=FREE)
    found = identify.fit(model, starts=1)
    cost = 0.5 * found.chi2 / (train.count * train.length)
    print(
        f"{train.count} windows: cost {cost:.4f}, {time.process_time() - begin:.1f} CPU s; "
        f"{found.status}"
    )
    for one in found.quantities:
        print(f"{one.name} {one.value:.3g} ± {one.deviation:.2g}")
    print("I =", np.asarray(found.body.inertia.tensor), "kg m²")
    of_each = {name: cut(runs[name], 50, 1) for name in HELD_OUT}
    for name, test in {"both": identify.Windows.join(*of_each.values()), **of_each}.items():
        model, held = identify.predict_windows(found, test), test.held_horizons()
        for measure in ("mean_absolute", "mean_norm"):
            print(name, measure)
            shown("model", getattr(model, measure))
            shown("state held", getattr(held, measure))
