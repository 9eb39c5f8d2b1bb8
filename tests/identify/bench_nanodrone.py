"""A quadrotor from windows: fitted on all runs but two, predicted open-loop on those two.

Run `python tests/identify/bench_nanodrone.py FOLDER [--stride 40] [--only square]`, FOLDER with the csv files of
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


class Craft(eqx.Module):
    """The free numbers, each of order 1."""

    spread: jax.Array  # a root of the second moment about the centre of mass, 1e-2.5 kg^½ m
    centre: jax.Array  # of mass, mm
    thrust: jax.Array  # of each rotor, 3.4e-8 N s²
    drag: jax.Array  # of each rotor, 2e-10 N m s²
    linear: jax.Array  # drag of the body, 1e-2 kg/s
    quadratic: jax.Array  # 1e-2 kg/m
    damping: jax.Array  # 1e-6 N m s
    twist: jax.Array  # a constant torque, 1e-5 N m
    flap: jax.Array  # torque by velocity, body axes, 1e-5 N s
    ahead: jax.Array  # the rotors act so many samples before they are logged


def scene(craft):
    root = jnp.zeros((3, 3)).at[np.tril_indices(3)].set(craft.spread)
    body = rj.MassProperties(0.045, np.zeros(3), 1e-5 * root @ root.T)
    speeds = Between(craft.ahead)
    law = torques.Sum(
        torques.UniformGravity([0.0, 0.0, -9.81]),
        torques.Rotors(PLACES - 1e-3 * craft.centre, UP, [1.0, -1, 1, -1],
                       3.4e-8 * craft.thrust, 2e-10 * craft.drag, speeds),
        torques.BodyDrag(1e-2 * craft.linear, 1e-2 * craft.quadratic),
        torques.Damping(1e-6 * craft.damping),
        torques.ConstantTorque(1e-5 * craft.twist),
        Flapping(1e-5 * craft.flap),
    )  # fmt: skip
    return body, law


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


GUESS = Craft(
    spread=jnp.array([1.6, 0.0, 1.4, 0.0, 0.0, 1.4]), centre=jnp.zeros(3), thrust=jnp.ones(4),
    drag=jnp.ones(4), linear=jnp.ones(3), quadratic=jnp.zeros(3), damping=jnp.ones(3),
    twist=jnp.zeros(3), flap=jnp.zeros((3, 3)), ahead=jnp.asarray(0.5),
)  # fmt: skip


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
    train = identify.Windows.joined(
        *(
            cut(path, 50, options.stride)
            for name, path in runs.items()
            if name not in HELD_OUT and name.startswith(options.only)
        )
    )
    begin = time.process_time()
    found = identify.fit_windows(train, scene, GUESS)
    print(
        f"{train.count} windows: {found.steps} steps, cost {found.cost:.4f}, "
        f"{time.process_time() - begin:.1f} CPU s; converged {found.converged} {found.message}"
    )
    for name in found.value.__dataclass_fields__:
        value, deviation = (np.asarray(getattr(c, name)) for c in (found.value, found.deviation))
        print(name, np.round(value, 3), "±", np.round(deviation, 3))
    print("I =", np.asarray(scene(found.value)[0].inertia.tensor), "kg m²")
    of_each = {name: cut(runs[name], 50, 1) for name in HELD_OUT}
    for name, test in {"both": identify.Windows.joined(*of_each.values()), **of_each}.items():
        model, held = found.predict(test), test.held()
        for measure in ("mean_absolute", "mean_norm"):
            print(name, measure)
            shown("model", getattr(model, measure))
            shown("state held", getattr(held, measure))
