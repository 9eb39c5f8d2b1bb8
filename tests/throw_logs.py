"""Whole logs of a body that is carried, thrown, caught, bounced and laid down, simulated in NumPy."""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

H = 1e-3  # s, of the simulation
G = 9.81


class Log(NamedTuple):
    """Readings in SI units, and the truth."""

    t: np.ndarray
    rates: np.ndarray
    forces: np.ndarray
    inertia: np.ndarray  # (3, 3), Tr I = 2
    free: np.ndarray  # (n, 2), the starts and ends of free flight, s
    rest: np.ndarray


def smooth(rng, count, size, band):
    """Random motion (count, 3) of a deviation `size` with nothing above `band`, Hz."""
    k = np.arange(1, max(2, int(band * count * H)) + 1)[:, None, None]
    phase = 2 * np.pi * rng.random((len(k), 1, 3))
    waves = np.sin(2 * np.pi * k * np.linspace(0, 1, count)[:, None] + phase)
    return size * np.sqrt(2 / len(k)) * waves.sum(axis=0)


def ramp(count):
    """From 0 to 1, smoothly."""
    return 0.5 - 0.5 * np.cos(np.pi * (np.arange(count) + 0.5) / count)


def make(
    seed, throws=3, rate=200.0, *, bounces=True, fastest=20.0, lever=0.04, noise=1.0, clip=34.9
):
    """A log at `rate`, Hz, of a body that is thrown at up to `fastest`, rad/s, with its sensor up to
    `lever`, m, from the centre of mass; `noise` in those of a phone.
    """
    rng = np.random.default_rng(seed)
    a = np.sort(rng.uniform(0.3, 1.0, 3)) * [1.0, 1.2, 1.5]
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    inertia = axes @ np.diag(a.sum() - a) @ axes.T / a.sum()
    inverse = np.linalg.inv(inertia)
    place = rng.uniform(-lever, lever, 3) / np.sqrt(3)
    # Pieces of rates and of forces at the centre of mass in the world, and what they are.
    rates, pushes, kinds = [], [], []

    def add(kind, w, f):
        rates.append(w), pushes.append(f), kinds.append(np.full(len(w), kind))

    def rest(seconds):
        n = int(seconds / H)
        add("rest", np.zeros((n, 3)), np.tile([0, 0, G], (n, 1)))

    def handling(seconds, first, last):
        n = int(seconds / H)
        s = ramp(n)[:, None]
        w = (1 - s) * first + s * last + 4 * s * (1 - s) * smooth(rng, n, rng.uniform(0.5, 3), 2)
        shake = 4 * s * (1 - s) * smooth(rng, n, rng.uniform(0.5, 4), 4)
        add("hand", w, np.array([0, 0, G]) + shake)

    def flight(seconds, w):
        n = int(seconds / H)
        way = np.empty((n, 3))
        slope = lambda w: inverse @ np.cross(inertia @ w, w) - 0.02 * w
        for k in range(n):
            way[k] = w
            half = w + 0.5 * H * slope(w)
            w = w + H * slope(half)
        add("free", way, np.zeros((n, 3)))
        return w

    def held(seconds, first, last, force, rise):
        """A hand's force, which rises and falls in `rise`, s, while the rates change."""
        n, m = int(seconds / H), max(1, int(rise / H))
        s, shape = ramp(n)[:, None], np.ones(n)
        m = min(m, n // 2)
        shape[:m], shape[n - m :] = ramp(m), ramp(m)[::-1]
        add("hand", (1 - s) * first + s * last, shape[:, None] * force)

    zero = np.zeros(3)
    rest(rng.uniform(1, 2))
    for _ in range(throws):
        direction = rng.normal(size=3)
        spin = rng.uniform(2, fastest) * direction / np.linalg.norm(direction)
        up, aside = rng.uniform(1.5, 5.0), rng.normal(0, 2, 2)
        handling(rng.uniform(0.5, 2), zero, 0.1 * spin)
        spell = rng.uniform(0.15, 0.35)
        held(spell, 0.1 * spin, spin, np.r_[aside, G + up / spell], rng.uniform(0.004, 0.02))
        spin = flight(2 * up / G, spin)
        for _ in range(rng.integers(1, 4) if bounces and rng.random() < 0.4 else 0):
            e, spell = rng.uniform(0.3, 0.6), rng.uniform(0.003, 0.008)
            new = 0.5 * spin + rng.normal(0, 4, 3)
            held(spell, spin, new, np.r_[rng.normal(0, 50, 2), (1 + e) * up / spell], spell / 2)
            up *= e
            spin = flight(2 * up / G, new)
        spell = rng.uniform(0.08, 0.25)
        caught = np.r_[rng.normal(0, 4, 2), G + up / spell]
        held(spell, spin, 0.05 * spin, caught, rng.uniform(0.004, 0.03))
        handling(rng.uniform(0.3, 1.5), 0.05 * spin, zero)
        if rng.random() < 0.6:
            rest(rng.uniform(0.5, 2))
    if not throws:
        handling(rng.uniform(3, 8), zero, zero)
    rest(rng.uniform(0.5, 1))
    w, f, kind = (np.concatenate(one) for one in (rates, pushes, kinds))
    turns, step = Rotation.from_rotvec(H * w), 1
    while step < len(w):
        # The product of all turns up to each one, of twice as many in each round.
        turns = Rotation.concatenate([turns[:step], turns[:-step] * turns[step:]])
        step *= 2
    turned = turns.inv().apply(f)
    slope = np.gradient(w, H, axis=0)
    f = turned + np.cross(slope, place) + np.cross(w, np.cross(w, place))
    step = max(1, round(1 / (rate * H)))
    n = len(w) // step

    def read(x, noise, bias, digit, limit):
        """A sensor takes means over a step, and is off by up to 1 %."""
        x = x[: n * step].reshape(n, step, 3).mean(axis=1) * (1 + rng.normal(0, 0.01, 3))
        x = x + rng.normal(0, bias, 3) + noise * rng.normal(size=x.shape)
        return np.clip(digit * np.round(x / digit), -limit, limit)

    def spans(name):
        edges = np.flatnonzero(np.diff(np.r_[False, kind == name, False].astype(int)))
        return H * edges.reshape(-1, 2)

    t = H * (step * (np.arange(n) + 0.5) - 0.5)
    rates = read(w, noise * 0.01 * rng.uniform(0.3, 2), 0.02, 1e-3, clip)
    forces = read(f, noise * 0.05 * rng.uniform(0.3, 3), 0.1, 5e-3, 157.0)
    return Log(t, rates, forces, inertia, spans("free"), spans("rest"))
