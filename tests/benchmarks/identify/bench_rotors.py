"""Thrown drones whose rotors are pulsed one after the other: how often intervals hold the truth.

Run `python tests/benchmarks/identify/bench_rotors.py [--throws 24] [--kind speed]`. Each throw is of another drone, simulated by
NumPy alone (classical Runge–Kutta steps of 0.25 ms): rotors of unequal lift, the momentum of the rotors, a motor lag,
a gyro with bias and noise, tachometers with noise that are late. What is fitted: `speed`, the logged speeds and a known rotor
inertia (±3 %); `command`, the commands alone, with the thrust from the weight at hover (±2 %).
"""

import argparse
import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)

import rigidjax as rj
from rigidjax import identify, torques

STEP, RATE = 0.25e-3, 500  # s; gyro, Hz
UP = np.tile([0.0, 0.0, 1.0], (4, 1))
SPINS = np.array([1.0, -1.0, 1.0, -1.0])
UNLIKE = 0.03  # the lifts of the rotors scatter by it


class Drone(NamedTuple):
    """Hold what a throw depends on, in SI units."""

    tensor: np.ndarray
    mass: float
    places: np.ndarray
    thrust: np.ndarray
    drag: np.ndarray
    rotor: float  # moment of inertia of a rotor
    lag: float
    late: float  # the commands act so much later than they are logged
    full: float  # rad/s at full command


def drone(rng):
    """A quadrotor of 0.3 to 1.1 kg whose principal axes are a few degrees off."""
    mass = rng.uniform(0.3, 1.1)
    arm = 0.09 * (mass / 0.6) ** (1 / 3) * rng.uniform(0.85, 1.15)
    moments = mass * arm**2 * np.array([rng.uniform(0.3, 0.5), rng.uniform(0.4, 0.7), 0.0])
    moments[2] = rng.uniform(0.75, 0.95) * moments.sum()
    turn = np.asarray(rj.quaternion.to_matrix(rj.quaternion.exp(rng.normal(0.0, 0.05, 3))))
    places = arm * np.array([[1.0, -1, 0], [-1, -1, 0], [-1, 1, 0], [1, 1, 0]]) / np.sqrt(2) * 1.4
    hover = rng.uniform(700.0, 1000.0)
    thrust = mass * 9.81 / 4 / hover**2 * (1 + UNLIKE * rng.normal(size=4))
    drag = thrust.mean() * rng.uniform(0.012, 0.018) * np.ones(4)
    rotor = rng.uniform(2.5e-3, 4e-3) * moments.mean()
    lag, late, full = rng.uniform(0.02, 0.04), rng.uniform(1e-3, 5e-3), 2.2 * hover
    tensor = turn @ np.diag(moments) @ turn.T
    return Drone(tensor, mass, places, thrust, drag, rotor, lag, late, full)


def commands(t, first=0.08, length=0.07, gap=0.05, low=0.08, high=0.7):
    """The commands (T, 4), from 0 to 1: one motor after the other."""
    begin = first + (length + gap) * np.arange(4) - 1e-9
    inside = (t[:, None] >= begin) & (t[:, None] < begin + length)
    return np.where(inside, high, low)


def flight(one, omega, duration, given=commands):
    """Times, rates and rotor speeds at each step of `STEP` s."""
    t = STEP * np.arange(round(duration / STEP) + 1)
    inverse = np.linalg.inv(one.tensor)
    wanted = one.full * given(t - one.late)

    def slope(y, u):
        w, n = y[:3], y[3:]
        rate = (u - n) / one.lag
        push = np.cross(one.places, (one.thrust * n**2)[:, None] * UP).sum(0)
        push = push - UP.T @ (SPINS * (one.drag * n**2 + one.rotor * rate))
        momentum = one.tensor @ w + UP.T @ (SPINS * one.rotor * n)
        return np.concatenate([inverse @ (push - np.cross(w, momentum)), rate])

    rows = [np.concatenate([omega, wanted[0]])]
    for u in wanted[:-1]:
        y = rows[-1]
        a = slope(y, u)
        b = slope(y + 0.5 * STEP * a, u)
        c = slope(y + 0.5 * STEP * b, u)
        d = slope(y + STEP * c, u)
        rows.append(y + STEP / 6 * (a + 2 * b + 2 * c + d))
    rows = np.array(rows)
    return t, rows[:, :3], rows[:, 3:]


class Log(NamedTuple):
    """Hold what is logged of a throw."""

    t: np.ndarray
    gyro: np.ndarray
    speeds: np.ndarray
    commands: np.ndarray


def log(rng, one, omega, duration):
    """A throw as its log: gyro with bias and noise, tachometers that are 3 ms late and noisy."""
    t, rates, speeds = flight(one, omega, duration)
    noise, late = rng.uniform(0.01, 0.04), round(rng.uniform(2e-3, 5e-3) / STEP)
    held = np.concatenate([np.repeat(speeds[:1], late, axis=0), speeds[: t.size - late]])
    every = slice(None, None, round(1 / RATE / STEP))
    gyro = rates[every] + rng.normal(0.0, 0.02, 3) + noise * rng.normal(size=rates[every].shape)
    tacho = held[every] * (1 + 0.005 * rng.normal(size=held[every].shape))
    return Log(t[every], gyro, tacho, commands(t[every]))


# The lifts of the rotors are alike, to `UNLIKE`: numbers measured beside the log.
ALIKE = identify.Measured(
    lambda p: jnp.log(p.values["thrust"] / jnp.mean(p.values["thrust"])),
    np.zeros(4), UNLIKE, "alike",
)  # fmt: skip
LIFT = lambda p: jnp.log(jnp.sum(p.values["thrust"]))


def fit_by_speed(one, log, *, spins=SPINS, speeds=None, places=None, rotor=None, starts=4):
    """Fit speeds, with a rotor inertia that is known to 3 %."""
    speeds = log.speeds if speeds is None else speeds
    size = np.square(speeds).mean() / np.square(log.speeds).mean()
    law = torques.Rotors(
        one.places if places is None else places, UP, spins, np.full(4, 1e-6 / size), 1e-8 / size,
        torques.Delayed(torques.Input("speeds"), 0.0), one.rotor if rotor is None else rotor,
    )  # fmt: skip
    free = [
        identify.Free(lambda s: s.torque.thrust, "thrust", scale=0.1, positive=True),
        identify.Free(lambda s: s.torque.drag, "drag", scale=1e-8 / size),
        identify.Free(lambda s: s.torque.inertia, "rotor", scale=0.1, positive=True, prior=0.03),
        identify.Free(lambda s: s.torque.speeds.delay, "delay", scale=1e-3),
        identify.Free(lambda s: s.sensors[0].bias, "bias", scale=0.05),
    ]
    gyro = identify.Gyro(None, bias=[0.0, 0.0, 0.0])
    inputs = {"speeds": torques.Series(log.t, speeds)}
    record = identify.Recording(log.t, (gyro, log.gyro), inputs=inputs)
    model = identify.Model(record, identify.Tensor(2e-3), torque=law, free=free, measured=[ALIKE])
    return identify.fit(model, starts=starts)


def fit_by_command(one, log, rng, *, spins=SPINS, starts=4):
    """Fit commands, with the thrust from the weight at a hover command that is known to 1 %."""
    hover = np.sqrt(one.mass * 9.81 / one.thrust.sum()) / one.full * (1 + 0.01 * rng.normal())
    law = torques.Rotors(
        one.places, UP, spins, np.full(4, 5.0), 0.05,
        torques.Lagged(torques.Delayed(torques.Input("commands"), 0.0), 0.03), 1e-2,
    )  # fmt: skip
    free = [
        identify.Free(lambda s: s.torque.thrust, "thrust", scale=0.1, positive=True),
        identify.Free(lambda s: s.torque.drag, "drag", scale=0.1),
        identify.Free(lambda s: s.torque.inertia, "rotor", scale=1e-2),
        identify.Free(lambda s: s.torque.speeds.time, "lag", scale=0.1, positive=True, unit="s"),
        identify.Free(lambda s: s.torque.speeds.source.delay, "delay", scale=1e-3),
        identify.Free(lambda s: s.sensors[0].bias, "bias", scale=0.05),
    ]
    weight = identify.Measured(LIFT, np.log(one.mass * 9.81 / hover**2), 0.02, "weight")
    gyro = identify.Gyro(None, bias=[0.0, 0.0, 0.0])
    record = identify.Recording(log.t, (gyro, log.gyro), inputs={"commands": log.commands})
    model = identify.Model(
        record, identify.Tensor(2e-3), torque=law, free=free, measured=[ALIKE, weight]
    )
    return identify.fit(model, starts=starts)


def judged(name, one, found):
    """Print a line of a fit; return its status, which intervals hold, and how far off it is."""
    moments = np.linalg.eigvalsh(one.tensor)
    ends = found.interval(0.95)
    held, far, widths = [], [], []
    for number, truth in zip(("I1", "I2", "I3"), moments, strict=True):
        low, high = map(float, ends[number])
        held.append(low <= truth <= high)
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        far.append(abs(truth - middle) / half)
        widths.append(half / truth)
    errors = np.asarray(found.body.moments) / moments - 1
    print(
        f"{name} held {sum(held)} of 3, errors {np.round(100 * errors, 1)} %, intervals ±"
        f"{np.round(100 * np.array(widths), 1)} %, {found.status[:100]}",
        flush=True,
    )
    return found.ok, held, far, errors, widths


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--throws", type=int, default=24)
    parser.add_argument("--kind", default="speed command")
    options = parser.parse_args()
    for kind in options.kind.split():
        rows, begin = [], time.process_time()
        for seed in range(options.throws):
            rng = np.random.default_rng(seed)
            one = drone(rng)
            omega = rng.normal(0.0, 4.0, 3)
            read = log(rng, one, omega, 0.76)
            found = (
                fit_by_speed(one, read, rotor=one.rotor * (1 + 0.03 * rng.normal()))
                if kind == "speed"
                else fit_by_command(one, read, rng)
            )
            rows.append(judged(f"{kind} {seed}", one, found))
        fine, held, far, errors, widths = map(np.array, zip(*rows, strict=True))
        print(
            f"{kind}: ok {fine.sum()} of {len(rows)}; intervals hold {held.mean():.1%}; throws with all three "
            f"{held.all(1).mean():.0%}; ok and off by more than twice the half width: "
            f"{(fine & (far > 2).any(1)).sum()}; median error {np.median(abs(errors)):.2%}, "
            f"median half width {np.median(widths):.2%}; {time.process_time() - begin:.0f} CPU s"
        )
