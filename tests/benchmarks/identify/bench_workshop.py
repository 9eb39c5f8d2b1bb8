"""How many 95 % intervals of six moments, kg m², hold in fits of swings, throws and a hand together.

    python tests/benchmarks/identify/bench_workshop.py [SETS]

SETS (400) simulated bodies, each with three periods on two strings (0.3 ms; the strings are 0.8 m,
to 1 mm, one number for all three), two throws of 1 s with a gyro (0.02 rad/s), and 3 s in a hand
that feels 0.1 N and 0.005 N m. All is one fit. Printed: the part of intervals that hold, with its
standard deviation over sets, and how wide they are beside those of the hand alone.
"""

import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

jax.config.update("jax_enable_x64", True)

import rigidjax as rj
from rigidjax import identify

G = [0.0, 0.0, -9.81]
CHART = identify.Mass(rj.shapes.box(1.0, [0.1, 0.1, 0.1]))
NAMES = ["Ixx", "Iyy", "Izz", "Iyz", "Ixz", "Ixy"]
PERIOD, GYRO, WRENCH = 3e-4, 0.02, (0.1, 0.005)
T, TS = np.linspace(0.0, 3.0, 151), np.linspace(0.0, 1.0, 101)
X = np.stack([0.2 * np.sin(2 * T), 0.1 * np.cos(3 * T), 0.1 * np.sin(T)], 1)
ANGLES = np.stack([1.1 * np.sin(2 * T), 0.9 * np.sin(3 * T + 1)], 1)
Q = Rotation.from_euler("ZX", ANGLES).as_quat(scalar_first=True)
MOTION = rj.torques.LoggedMotion(T, X, Q)
HAND = identify.ForceTorque(WRENCH, gravity=G)


def strings(axis, length):
    return rj.suspensions.Strings(2, 0.15, 0.15, length, axis, 9.81)


HUNG = [
    lambda point, axis=axis: rj.suspensions.period(
        point.body, strings(axis, point.values["length"])
    )
    for axis in np.eye(3)
]


@jax.jit
def truths(body, length, rates):
    """The periods, and the rates of the throws."""
    axes = jnp.eye(3)
    times = jax.vmap(lambda axis: rj.suspensions.period(body, strings(axis, length)))(axes)
    throw = lambda rate: rj.simulate(body.inertia, rj.Spin(rate), TS, throw=False).ys.omega
    return times, jax.vmap(throw)(rates)


def experiment(random):
    """A body, and the models of all its recordings and of the hand alone."""
    second = np.diag(random.uniform(0.02, 0.12, 3) ** 2)
    axes = Rotation.random(rng=random).as_matrix()
    mass, com = random.uniform(0.3, 3.0), random.uniform(-0.1, 0.1, 3)
    body = rj.MassProperties(mass, com, mass * axes @ second @ axes.T)
    length = 0.8 + 1e-3 * random.normal()
    times, rates = truths(body, length, random.normal(size=(2, 3)) * 6.0)
    start = rj.Rigid(X[0], np.zeros(3), Q[0], np.zeros(3))
    read = identify.simulate_readings(HAND, body, start, T, rj.torques.Carried(MOTION))
    read = read + np.repeat(WRENCH, 3) * random.normal(size=read.shape)
    held = identify.Recording(T, (HAND, read), inputs={"motion": MOTION})
    throws = [
        identify.Recording(TS, (identify.Gyro(GYRO), rate + GYRO * random.normal(size=rate.shape)))
        for rate in np.asarray(rates)
    ]
    measured = [
        identify.Measured(of, value + PERIOD * random.normal(), PERIOD, f"period {axis}")
        for of, value, axis in zip(HUNG, times, "xyz", strict=True)
    ]
    free = [identify.Free(0.8, "length", scale=0.01, prior=1e-3, unit="m")]
    carried = rj.torques.Carried()
    kinds = {
        "hand": identify.Model(held, CHART, torque=carried, free=free),
        "throw": identify.Model(throws, CHART),
    }
    alone = identify.Model(held, CHART, torque=carried)
    return body, identify.Model(kinds, measured=measured), alone


def main(sets):
    hits, widths, ok, walls = [], [], [], []
    for seed in range(sets):
        body, model, alone = experiment(np.random.default_rng(seed))
        tensor = np.asarray(body.inertia.tensor)
        truth = tensor[(0, 1, 2, 1, 0, 0), (0, 1, 2, 2, 2, 1)]
        begin = time.perf_counter()
        fit = identify.fit(model, starts=1)
        walls.append(time.perf_counter() - begin)
        ends = np.array([fit.interval(0.95)[name] for name in NAMES])
        hits.append((ends[:, 0] <= truth) & (truth <= ends[:, 1]))
        ok.append(fit.ok)
        if seed < 40:
            hand = identify.fit(alone).interval(0.95)
            wide = np.diff(np.array([hand[name] for name in NAMES]))[:, 0]
            widths.append(np.diff(ends)[:, 0] / wide)
        if seed % 20 == 19:
            print(f"{seed + 1} sets: {np.mean(hits):.1%} hold", flush=True)
    each = np.mean(hits, axis=1)
    print(
        f"{sets} sets: {np.mean(hits):.1%} ± {np.std(each) / np.sqrt(sets):.1%} of six intervals "
        f"hold ({', '.join(f'{n} {p:.0%}' for n, p in zip(NAMES, np.mean(hits, axis=0), strict=True))}); "
        f"{np.mean(ok):.0%} ok; widths beside the hand alone {np.median(widths):.2f}; "
        f"{1e3 * np.median(walls):.0f} ms"
    )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 400)
