"""The moments of simulated swings from a gyro's log: through `fit`, and through the command line.

    python tests/benchmarks/identify/bench_swings.py [COUNT]

COUNT pendulums and COUNT bodies on two strings (default 40), each with a log of its own: a gyro
with a bias, any axis, 500 or 4000 samples of 2 to 80 periods, amplitudes of 2° to 100° (strings:
60°), noise of 0.5 to 10 % of the largest rate, every other one damped (to a fifth of the amplitude
at most). The guess of the body is off by a factor of 1/2 to 2. Printed are how many logs end `ok`,
how many 95 % intervals hold the true moment, and the CPU time of a fit that is compiled already.
"""

import contextlib
import io
import math
import re
import sys
import tempfile
import time
from pathlib import Path

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

import rigidjax as rj
from rigidjax import identify
from rigidjax.cli.command import main

G = 9.80665


def swing(kind, random):
    """Return body, suspension with the true friction, and first state."""
    across = random.uniform(0.1, 0.6, 2)
    body = rj.shapes.box(random.uniform(0.2, 3.0), [*across, 0.05])
    axis = random.normal(size=3)
    axis /= np.linalg.norm(axis)
    side = np.linalg.svd(axis[None])[2][1]
    damping = random.uniform(0.002, 0.03) if random.integers(2) else 0.0
    if kind == "axle":
        arm = random.uniform(0.1, 0.6)
        body = body.shift(arm * side)
        law = rj.suspensions.Axle(axis, np.zeros(3), G * side)
        numbers = dict(mass=body.mass, arm=arm)
    else:
        radius, length = random.uniform(0.05, 0.3), random.uniform(0.4, 2.0)
        law = rj.suspensions.Strings(2, radius, radius, length, axis)
        numbers = dict(mass=body.mass, radius=radius, length=length)
    amplitude = np.radians(np.exp(random.uniform(np.log(2), np.log(100 if kind == "axle" else 60))))
    period = float(rj.suspensions.period(body, law, amplitude))
    # Of the critical damping, at which a body does not swing.
    viscous = damping * 4 * math.pi * float(law.moment(body, 0.0)) / period
    friction = rj.suspensions.Friction(viscous) if damping else None
    law = type(law)(**{**vars(law), "friction": friction})
    phase = random.uniform(0, 2 * math.pi)
    start = rj.Turn(amplitude * math.cos(phase), amplitude * 2 * math.pi / period * math.sin(phase))
    return body, law, start, period, numbers


def logged(kind, seed):
    """Return the log of a swing, the model of its fit, and what the command line is told."""
    random = np.random.default_rng([seed, kind == "axle"])
    body, law, start, period, numbers = swing(kind, random)
    # Of two sizes, each of which is compiled once.
    count = random.choice([500, 4000])
    periods = np.exp(random.uniform(np.log(2), np.log(min(80, count / 16))))
    # A log ends when a fifth of the amplitude is left: noise alone explains nothing.
    if law.friction is not None:
        decay = float(law.friction.viscous / law.moment(body, 0.0)) / 2
        periods = min(periods, 1.6 / (decay * period))
    ts = np.linspace(0.0, periods * period, count)
    exact = rj.simulate(body, start, ts, law).ys.rate[:, None] * law.axis
    noise = float(np.exp(random.uniform(np.log(5e-3), np.log(0.1))) * np.abs(exact).max())
    bias = random.normal(size=3) * 0.02
    read = exact + bias + noise * random.normal(size=exact.shape)
    free = [identify.Free(lambda s: s.sensors[0].bias, "bias")]
    if law.friction is not None:
        law = type(law)(**{**vars(law), "friction": rj.suspensions.Friction(0.0)})
        free.append(identify.Free(lambda s: s.torque.friction.viscous, "friction", scale=1e-3))
    # The true axis of the box is free of the fit: only its moment about the axle is not known.
    off = 2 ** random.uniform(-1, 1)
    guess = rj.MassProperties(body.mass, body.com, off * body.second_moment)
    record = identify.Recording(ts, (identify.Gyro(bias=np.zeros(3)), read))
    model = identify.Model(record, identify.Moment(guess, law), torque=law, free=free)
    words = " ".join(f"--{name} {float(value)!r}" for name, value in numbers.items())
    return ts, read, model, float(law.moment(body, 0.0)), words


def from_the_command_line(kind, ts, read, words, folder):
    """Return the exit code, the status, and the ends of the interval."""
    path = Path(folder) / "swing.csv"
    np.savetxt(path, np.c_[ts, read], "%.9g", delimiter=",", header="t,wx,wy,wz", comments="")
    with contextlib.redirect_stdout(io.StringIO()) as out:
        code = main(f"swing --suspension {kind} {words} --log {path}".split())
    said = out.getvalue()
    status = said.splitlines()[0]
    ends = re.search(r"moment of inertia.*interval (\S+) … (\S+)", said).groups()
    return code, status, *map(float, ends)


def run(kind, count, folder):
    rows = []
    for seed in range(count):
        ts, read, model, moment, words = logged(kind, seed)
        identify.fit(model)
        begin = time.process_time()
        fit = identify.fit(model)
        end = time.process_time()
        low, high = fit.interval(0.95)["moment"]
        told = "bifilar" if kind == "strings" else kind
        _, status, least, most = from_the_command_line(told, ts, read, words, folder)
        own = moment
        if kind == "axle":
            own = moment - float(fit.body.mass) * float(np.sum(np.square(fit.body.com)))
        rows.append((fit.ok, low <= moment <= high, status == "status: ok", least <= own <= most))
        rows[-1] += (end - begin, "not ended" in fit.status or "not ended" in status)
        shown = f"{kind} {seed}: {len(ts)} samples, {(high - low) / (2 * moment):.1e}, {fit.status}"
        print(shown if fit.ok else f"{shown} (true {moment:.6g})", status, rows[-1], flush=True)
    ok, held, told_ok, told_held, wall, lost = np.array(rows, float).T
    print(
        f"{kind}: fit ok {ok.sum():.0f}, held {held.sum():.0f}; command line ok "
        f"{told_ok.sum():.0f}, held {told_held.sum():.0f}; of {count}; not ended {lost.sum():.0f}; "
        f"a warm fit {1e3 * np.median(wall):.0f} ms, at most {1e3 * wall.max():.0f} ms"
    )


if __name__ == "__main__":
    many = int(sys.argv[1]) if len(sys.argv) > 1 else 40
    with tempfile.TemporaryDirectory() as folder:
        for kind in ("axle", "strings"):
            run(kind, many, folder)
