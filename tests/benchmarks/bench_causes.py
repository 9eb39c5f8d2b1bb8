"""Recordings whose fault is known: which cause does a fit name?

    python tests/benchmarks/bench_causes.py [COUNT] [NAME…]

Of each wrong set-up COUNT (10) records of random bodies and rates: how often the right cause is
named first, a wrong one first, and how often `ok` is said; of 40 clean records how often a cause is
named, and `ok` said. Motions are made by SciPy's `solve_ivp`.
"""

import sys
import time

import jax
import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

jax.config.update("jax_enable_x64", True)

from rigidjax import identify, torques

T = np.arange(200) * 0.02
G = np.array([0.0, 0.0, -9.81])


class Case:
    """One random body (1 the largest moment), its motion for 4 s, and the noise of its gyro."""

    def __init__(self, seed, rate=(2.0, 4.0), torque=None, times=T):
        self.rng = rng = np.random.default_rng(seed)
        a = np.sort(rng.uniform(0.3, 1.0, 3)) * [1.0, 1.25, 1.6]
        self.inertia = np.array([a[1] + a[2], a[0] + a[2], a[0] + a[1]]) / (a[1] + a[2])
        self.inertia = rng.permutation(self.inertia)
        # Well apart from every axis: the motion shows all ratios.
        w = rng.choice([-1.0, 1.0], 3) * rng.uniform(0.45, 1.0, 3)
        self.size = rng.uniform(*rate)
        self.w0 = self.size * w / np.linalg.norm(w)
        self.sigma = self.size * 10 ** rng.uniform(-2.3, -1.9)
        self.q, self.w = self.motion(times, torque)

    def motion(self, times, torque=None):
        inertia = self.inertia

        def field(t, y):
            q, w = y[:4], y[4:]
            dq = 0.5 * np.r_[-q[1:] @ w, q[0] * w + np.cross(q[1:], w)]
            push = np.cross(inertia * w, w) + (0.0 if torque is None else torque(t, w))
            return np.r_[dq, push / inertia]

        way = dict(method="DOP853", rtol=1e-10, atol=1e-10, t_eval=times)
        y = solve_ivp(field, (min(times[0], 0.0), times[-1]), [1, 0, 0, 0, *self.w0], **way).y.T
        return y[:, :4], y[:, 4:]

    def noisy(self, values, sigma=None):
        return values + (self.sigma if sigma is None else sigma) * self.rng.normal(
            size=values.shape
        )

    def attitudes(self, q=None, sigma=0.003):
        turn = Rotation.from_rotvec(sigma * self.rng.normal(size=(len(T), 3)))
        return _scalar_first(_turns(self.q if q is None else q) * turn)

    def gyro(self, values=None, noise=None, **how):
        return identify.Gyro(noise, **how), self.noisy(self.w) if values is None else values

    def world(self):
        return self.noisy(_turns(self.q).apply(self.w))


def _turns(q):
    return Rotation.from_quat(np.roll(q, -1, axis=1))


def _scalar_first(turns):
    return np.roll(turns.as_quat(), 1, axis=1)


def fit(*readings, t=T, chart=None, **how):
    record = identify.Recording(t, *readings, inputs=how.pop("inputs", None))
    return identify.fit(identify.Model(record, chart or identify.Ratios(), **how), starts=2)


def with_attitudes(c, rates, q=None, **how):
    return fit((identify.Gyro(**how), rates), (identify.AttitudeSensor(), c.attitudes(q)))


def world(c):
    return with_attitudes(c, c.world())


def half_turn(c):
    signs = 2.0 * np.eye(3)[c.rng.integers(3)] - 1.0
    return with_attitudes(c, c.noisy(c.w * signs))


def order(c):
    """Any of the 47 wrong signed orders."""
    while True:
        order, signs = c.rng.permutation(3), c.rng.choice([-1.0, 1.0], 3)
        if (order != np.arange(3)).any():
            return with_attitudes(c, c.noisy(c.w[:, order] * signs))


def late(c):
    """Attitudes that come some ms early or late."""
    shift = c.rng.choice([-1, 1]) * c.rng.uniform(0.01, 0.04)
    q, _ = c.motion(np.r_[0.0, T + 0.05 + shift])
    q = q[1:]
    _, w = c.motion(T + 0.05)
    return with_attitudes(c, c.noisy(w), q)


def scalar_last(c):
    return fit((identify.AttitudeSensor(), np.roll(c.attitudes(), -1, axis=1)))


def world_to_body(c):
    return fit((identify.AttitudeSensor(), c.attitudes() * [1, -1, -1, -1]))


def bias(c):
    size = c.rng.normal(size=3)
    size *= c.rng.uniform(0.04, 0.1) * c.size / np.linalg.norm(size)
    return fit(c.gyro(c.noisy(c.w) + size))


def small_bias(c):
    """A phone's of 0.03 rad/s beside a noise of 0.02 rad/s, for 6 s."""
    t = np.arange(300) * 0.02
    c = Case(c.rng.integers(10**6), (4.0, 6.0), times=t)
    size = c.rng.choice([-1.0, 1.0], 3) * c.rng.uniform(0.02, 0.035, 3)
    return fit(c.gyro(c.noisy(c.w, 0.02) + size, 0.02), t=t)


def drifting(c):
    size = c.rng.normal(size=3)
    size *= c.rng.uniform(0.02, 0.04) * c.size / np.linalg.norm(size)
    return with_attitudes(c, c.noisy(c.w) + T[:, None] * size)


def scale(c):
    factor = 1.0 + np.array([0.03, 0.0, -0.03])[c.rng.permutation(3)]
    return with_attitudes(c, c.noisy(c.w * factor))


def mounted(c):
    turn = Rotation.from_rotvec(c.rng.uniform(0.05, 0.12) * np.array([1, -1, 1]) / np.sqrt(3))
    return with_attitudes(c, c.noisy(turn.apply(c.w)))


def driven(seed, torque, **how):
    return Case(seed, torque=torque, **how)


def momentum(seed):
    """Of a wheel: a part of the body's."""
    rng = np.random.default_rng(seed + 1000)
    h = rng.normal(size=3)
    return h / np.linalg.norm(h) * rng.uniform(0.3, 0.7)


def wheel(seed):
    h = momentum(seed)
    c = driven(seed, lambda t, w: np.cross(h, w))
    return fit(c.gyro())


def spinning_up(seed):
    h = 2.0 * momentum(seed) / T[-1]
    c = driven(seed, lambda t, w: np.cross(h * t, w) - h)
    return fit(c.gyro())


def drag(seed):
    size = np.random.default_rng(seed + 2000).uniform(0.03, 0.2, 3)
    c = driven(seed, lambda t, w: -size * w)
    return fit(c.gyro())


def push(seed):
    size = np.random.default_rng(seed + 3000).normal(size=3) * 0.3
    c = driven(seed, lambda t, w: size)
    return fit(c.gyro())


def degrees_short(c):
    """In 2 s a body at rates of one rad/s."""
    c = Case(c.rng.integers(10**6), (0.7, 1.2), times=T[:100])
    return fit((identify.Gyro(), np.degrees(c.noisy(c.w))), t=T[:100])


def degrees_beside_a_wheel(seed):
    h = momentum(seed)
    c = driven(seed, lambda t, w: np.cross(h, w))
    rates = np.degrees(c.noisy(c.w))
    free = [identify.Free(lambda s: s.sensors[0].bias, "bias", scale=0.05)]
    law = torques.Flywheel(h)
    gyro = identify.Gyro(bias=[0.0] * 3)
    return fit((gyro, rates), chart=identify.Tensor(0.5), torque=law, free=free)


def other_sign(seed):
    h = momentum(seed)
    c = driven(seed, lambda t, w: np.cross(h, w))
    law = torques.Flywheel(-h)
    return fit(c.gyro(), chart=identify.Tensor(0.5), torque=law)


def mirrored(seed):
    h = momentum(seed)
    c = driven(seed, lambda t, w: np.cross(h, w))
    signs = -np.eye(3)[seed % 3] * 2.0 + 1.0
    return fit(c.gyro(c.noisy(c.w) * signs), chart=identify.Tensor(0.5), torque=torques.Flywheel(h))


def held(seed, change):
    """A tool in a hand, whose wrench is read; (wrench, gravity) are changed."""
    rng = np.random.default_rng(seed)
    mass, com = rng.uniform(0.5, 2.0), rng.uniform(-0.05, 0.05, 3)
    tensor = np.diag(rng.uniform(0.8, 1.2, 3)) * 4e-3
    t = np.arange(160) * 0.025
    angle = rng.uniform(0.5, 1.0, (3, 2)), rng.uniform(1.0, 3.0, (3, 2)), rng.uniform(0, 6, (3, 2))
    size, rate, phase = angle
    turn = np.sum(size * np.sin(rate * t[:, None, None] + phase), axis=-1)
    place = 0.2 * np.sum(size * np.cos(1.3 * rate * t[:, None, None] + phase), axis=-1)
    log = torques.LoggedMotion.from_poses(t, place, _scalar_first(Rotation.from_rotvec(turn)))
    law, noise = torques.Carried(), (0.05, 0.003)
    import jax.numpy as jnp

    import rigidjax as rj

    body = rj.MassProperties(mass, com, tensor)
    sensor = identify.ForceTorque(noise, gravity=G)
    bare = identify.Recording(t, (sensor, np.zeros((t.size, 6))), inputs={"motion": log})
    known = identify.Model(bare, identify.Known(body), torque=law)
    wrench = -np.asarray(known.errors(known.start())[0]).reshape(t.size, 6)
    wrench = wrench + np.repeat(noise, 3) * rng.normal(size=wrench.shape)
    wrench, gravity = change(t, wrench, rng)
    reading = (identify.ForceTorque(noise, gravity=gravity), wrench)
    guess = rj.MassProperties(1.0, jnp.zeros(3), 4e-3 * jnp.eye(3))
    return fit(reading, t=t, chart=identify.Mass(guess), torque=law, inputs={"motion": log})


def drift_of_force(t, y, rng):
    return y + t[:, None] * np.repeat([0.1, 0.006], 3) * rng.choice([-1, 1], 6), G


def noisy_second(c):
    """An accelerometer whose white noise exceeds its signal, beside a good gyro."""
    d = np.cross(c.inertia * c.w, c.w) / c.inertia
    r = np.array([0.01, 0.0, 0.005])
    force = np.cross(d, r) + np.cross(c.w, np.cross(c.w, r))
    away = identify.Accelerometer(None, place=[0.0] * 3)
    free = [identify.Free(lambda s: s.sensors[1].place, "place", scale=0.01)]
    return fit(c.gyro(), (away, c.noisy(force, 3.0 * force.std())), free=free)


def world_alone(c):
    return fit((identify.Gyro(), c.world()))


def off(c):
    """A gyro 1 % off, no tolerance: `ok` has its condition, or the intervals hold."""
    found = fit(c.gyro(c.noisy(c.w * [1.01, 1.0, 1.0]), c.sigma))
    truth = np.sort(c.inertia)[:2] / np.max(c.inertia)
    ends = np.array([found.interval()[name] for name in ("I1/I3", "I2/I3")])
    found.__dict__["holds"] = bool(((ends[:, 0] <= truth) & (truth <= ends[:, 1])).all())
    return found


TURNED = ("the wheel", "spin", "constant internal")
# Name: the words of which one must come first; a function of a `Case` or of a seed.
CASES = {
    "rates in the world frame": (("world",), world),
    "half a turn": (("half a turn",), half_turn),
    "axes in a wrong signed order": (("swap", "order"), order),
    "attitudes early or late": (("clock",), late),
    "attitudes alone, scalar last": (("scalar",), scalar_last),
    "attitudes alone, world to body": (("world to body",), world_to_body),
    "a bias": (("a bias left out",), bias),
    "a phone's bias, noise given": (("a bias left out",), small_bias),
    "a bias that drifts": (("drifts",), drifting),
    "scales 3 % off": (("scale",), scale),
    "a gyro turned by some degrees": (("turned by",), mounted),
    "a wheel left out": (("constant internal",), wheel),
    "a wheel that spins up, left out": (("spins up",), spinning_up),
    "drag left out": (("against the rate",), drag),
    "a constant torque left out": (("constant torque",), push),
    "world rates alone": (("world",), world_alone),
    "deg/s read as rad/s, 2 s": (("deg/s",), degrees_short),
    "deg/s beside a wheel": (("deg/s",), degrees_beside_a_wheel),
    "the wheel's other sign": (("other sign",), other_sign),
    "a mirrored axis beside a wheel": (("mirrored",), mirrored),
    "gravity upside down": (("gravity",), lambda s: held(s, lambda t, y, r: (y, -G))),
    "the wrench on the support": (("support",), lambda s: held(s, lambda t, y, r: (-y, G))),
    "a drifting bias of force": (("drifts",), lambda s: held(s, drift_of_force)),
    "one noisy sensor of two": ((), noisy_second),
    "a gyro 1 % off": ((), off),
}
SEEDED = (wheel, spinning_up, drag, push, degrees_beside_a_wheel, other_sign, mirrored)


def clean(seed):
    c = Case(seed)
    return (
        with_attitudes(c, c.noisy(c.w))
        if seed % 4 == 3
        else fit(c.gyro(None, [None, c.sigma][seed % 2]))
    )


def main(count=10, names=()):
    print(f"{'set-up':34} right  wrong  none   ok   of {count}")
    total = np.zeros(4, int)
    for name, (wanted, make) in CASES.items():
        if names and not any(n in name for n in names):
            continue
        begin, numbers, said = time.time(), np.zeros(4, int), []
        for seed in range(100, 100 + count):
            seeded = make in SEEDED or make.__name__ == "<lambda>"
            found = make(seed) if seeded else make(Case(seed))
            words = " ".join(map(str, found.causes)).split(" or ")[0]
            if "alone" in name:
                # Both readings of quaternions alone are the same up to turns of both frames.
                words = " ".join(map(str, found.causes))
            named = any(w in words for w in wanted)
            line = " ".join(found.identifiability) + found.status
            # `ok` must have its line, where no data can show the fault.
            said_so = not wanted or any(
                w in line for w in (*wanted, *(["bias below"] * (make is small_bias)))
            )
            right = named or (found.ok and said_so)
            if make is off:
                right = found.status.startswith("ok, if") or (found.ok and found.__dict__["holds"])
            numbers += [right, bool(words) and not named, not words and not found.ok, found.ok]
            said += [] if right else [f"    {seed}: {found.status[:90]} | {words[:100]}"]
        total += numbers
        print(
            f"{name:34} " + "  ".join(f"{n:4d}" for n in numbers), f"   {time.time() - begin:.0f} s"
        )
        print("\n".join(said), flush=True) if said else None
    print(f"{'all':34} " + "  ".join(f"{n:4d}" for n in total))
    if not names or "clean" in names:
        fits = [clean(seed) for seed in range(4 * count)]
        print(
            f"{len(fits)} clean records: ok {sum(f.ok for f in fits)}, causes {sum(bool(f.causes) for f in fits)}"
        )


if __name__ == "__main__":
    main(*(int(x) for x in sys.argv[1:2]), names=sys.argv[2:])
