"""The Earth's free precession, kicked by air and sea: period, amplitude, forecasts.

    python notebooks/polar_motion.py

The table `data/polar_motion.csv` has columns mjd, x_arcsec, x_error_arcsec, y_arcsec, y_error_arcsec. With p = x − i y and
the excitation χ the pole obeys dp/dt = iσ (p − χ), σ = 2π/T (1 + i/2Q) (Munk and MacDonald, The
Rotation of the Earth (1960), ch. 6). χ is white noise, or noise with a memory, or both; besides, the
seasons force turns of a year and half a year, either way, whose amplitudes may wander, and the mean
pole walks. All of it is linear, so a Kalman filter follows it; whatever is unknown is fitted to the
likelihood of the innovations.

The numbers are fitted to every 15th day: the published series is smoothed over some weeks in its
first years, and what a filter sees of it day by day is that smoothing, not the Earth. Its own errors
are believed.
"""

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

YEAR, STEP, SPARSE = 365.25, 5, 3
# Chandler and what excites it, turns of the seasons, mean pole: two real numbers each.
SEASONS = (1.0, -1.0, 2.0, -2.0)
SIZE = 4 + 2 * len(SEASONS) + 2
MODELS = {
    "white": ("period", "damping", "white", "floor", "season", "mean"),
    "red": ("period", "damping", "red", "memory", "floor", "season", "mean"),
    "white and red": ("period", "damping", "white", "red", "memory", "floor", "season", "mean"),
}
# Where a fit starts: d; 1/(2Q); mas/√d by which white excitation kicks the pole, |σ| times its own;
# mas of the red one; d; mas; mas/√d; mas/√d.
START = {
    "period": 433.0, "damping": 0.004, "white": 0.9, "red": 20.0, "memory": 12.0,
    "floor": 0.2, "season": 0.1, "mean": 0.1,
}  # fmt: skip


def read():
    """Times (T,) MJD, readings (T, 2) of (x, −y) and their errors, mas, every fifth day."""
    path = Path(__file__).parent / "data" / "polar_motion.csv"
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    t, x, dx, y, dy = table.T
    return t, 1e3 * np.column_stack([x, -y]), 1e3 * np.column_stack([dx, dy])


def turn(angle):
    """The matrix of the product with exp(i angle)."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])])


class Linear(NamedTuple):
    """Steps from z to F z + G u and readings H z + r v; u and v are normal, of unit variance."""

    transition: jax.Array  # F
    noise: jax.Array  # G
    matrix: jax.Array  # H
    deviation: jax.Array  # r, a row for each time


class States(NamedTuple):
    """Mean and covariance of the state at each time, and the log-likelihood of the readings."""

    mean: jax.Array
    covariance: jax.Array
    log_likelihood: jax.Array


@jax.jit
def kalman_filter(model, readings, root):
    """`States` from the readings up to each time; at first the mean is zero, with this root."""
    f, h, q = model.transition, model.matrix, model.noise @ model.noise.T

    def step(before, row):
        (z, p), (y, r) = before, row
        s, off = h @ p @ h.T + jnp.diag(r**2), y - h @ z
        gain = jnp.linalg.solve(s, h @ p).T
        log = -0.5 * (off @ jnp.linalg.solve(s, off) + jnp.linalg.slogdet(2 * jnp.pi * s)[1])
        z, p = z + gain @ off, p - gain @ s @ gain.T
        return (f @ z, f @ p @ f.T + q), (z, p, log)

    first = jnp.zeros(len(root)), root @ root.T
    _, (means, covariances, logs) = jax.lax.scan(step, first, (readings, model.deviation))
    return States(means, covariances, logs.sum())


@jax.jit
def smooth(model, found):
    """`States` from all readings, from those of the filter (Rauch, Tung and Striebel 1965)."""
    f, q = model.transition, model.noise @ model.noise.T

    def step(after, filtered):
        z, p = filtered
        ahead = f @ p @ f.T + q
        gain = jnp.linalg.solve(ahead, f @ p).T
        now = z + gain @ (after[0] - f @ z), p + gain @ (after[1] - ahead) @ gain.T
        return now, now

    last = found.mean[-1], found.covariance[-1]
    rows = found.mean[:-1], found.covariance[:-1]
    _, before = jax.lax.scan(step, last, rows, reverse=True)
    means, covariances = (jnp.concatenate([a, b[None]]) for a, b in zip(before, last))
    return States(means, covariances, found.log_likelihood)


def model_of(v, errors, step=float(STEP)):
    """The `Linear` model, and the root of the first covariance, for the numbers v by name."""
    rate = 2 * jnp.pi / v["period"]
    one, quarter = jnp.eye(2), turn(jnp.asarray(jnp.pi / 2))
    pull = rate * quarter - rate * v["damping"] * one
    memory = v.get("memory", jnp.asarray(1.0))
    a = jnp.block([[pull, -pull], [jnp.zeros((2, 2)), -one / memory]])
    strength = jnp.stack([v.get("white", jnp.asarray(0.0)), v.get("red", jnp.asarray(0.0))])
    spread = jnp.repeat(jnp.stack([strength[0] ** 2, 2 * strength[1] ** 2 / memory]), 2)
    # Van Loan 1978, doi:10.1109/TAC.1978.1101743.
    big = jnp.block([[-a, jnp.diag(spread)], [jnp.zeros((4, 4)), a.T]])
    e = jax.scipy.linalg.expm(step * big)
    grown = e[4:, 4:].T
    gathered = grown @ e[:4, 4:]
    gathered = 0.5 * (gathered + gathered.T) + 1e-12 * jnp.eye(4)
    turns = [turn(jnp.asarray(2 * jnp.pi * k * step / YEAR)) for k in SEASONS]
    transition = jax.scipy.linalg.block_diag(grown, *turns, one)
    walks = jnp.concatenate(
        [jnp.full(2 * len(SEASONS), 1.0) * v["season"], jnp.full(2, 1.0) * v["mean"]]
    )
    noise = jax.scipy.linalg.block_diag(
        jnp.linalg.cholesky(gathered), jnp.sqrt(step) * jnp.diag(walks)
    )
    matrix = jnp.concatenate([one, jnp.zeros((2, 2)), *([one] * (len(SEASONS) + 1))], axis=1)
    deviation = jnp.sqrt(errors**2 + v["floor"] ** 2)
    first = jnp.concatenate(
        [
            jnp.full(2, 300.0),
            jnp.full(2, 1.0) * strength[1] + 1e-6,
            jnp.full(2 * len(SEASONS), 100.0),
            jnp.full(2, 500.0),
        ]
    )
    return Linear(transition, noise, matrix, deviation), jnp.diag(first)


def named(names, x):
    """The positive numbers whose logarithms, from the start's, are x."""
    return {name: START[name] * jnp.exp(x[i]) for i, name in enumerate(names)}


# A weak prior: within a factor of e³ of the start, so that what the data do not show stays finite.
WIDE = 3.0


def fit(names, readings, errors):
    """Numbers of largest likelihood, their logarithms' covariance, and the log-likelihood."""
    sparse = slice((len(readings) - 1) % SPARSE, None, SPARSE)
    readings, errors = readings[sparse], errors[sparse]

    def loss(x):
        model, root = model_of(named(names, x), errors, float(STEP * SPARSE))
        found = kalman_filter(model, readings, root)
        return -found.log_likelihood + 0.5 * jnp.sum((x / WIDE) ** 2)

    slope = jax.jit(jax.jacfwd(loss))
    value = jax.jit(loss)
    # Where a trial step is beyond what the exponential holds, it is no step.
    best = scipy.optimize.minimize(
        lambda x: np.nan_to_num(float(value(x)), nan=1e9, posinf=1e9),
        np.zeros(len(names)),
        jac=lambda x: np.nan_to_num(np.asarray(slope(x))),
        method="L-BFGS-B",
        bounds=[(-2.5, 2.5) if name == "memory" else (-4.0, 4.0) for name in names],
    )
    steps = 1e-3 * np.eye(len(names))
    curve = np.stack([(slope(best.x + h) - slope(best.x - h)) / 2e-3 for h in steps])
    covariance = np.linalg.inv(0.5 * (curve + curve.T))
    return named(names, best.x), covariance, -float(value(best.x)), value, best.x


def forecasts(v, t, readings, errors, ahead=(30, 90, 180, 365)):
    """From every 90th day of 1985–1994: errors (n, 2) and predicted deviations, by days ahead."""
    model, root = model_of(v, errors)
    found = kalman_filter(model, readings, root)
    first, last = (np.searchsorted(t, mjd) for mjd in (46066, 49718))
    starts = np.arange(first, last, 90 // STEP)
    means, covs = np.asarray(found.mean), np.asarray(found.covariance)
    matrix, out = np.asarray(model.matrix), {}
    f, g = np.asarray(model.transition), np.asarray(model.noise)
    for days in ahead:
        count = days // STEP
        grown, gathered = np.eye(SIZE), np.zeros((SIZE, SIZE))
        for _ in range(count):
            grown, gathered = f @ grown, f @ gathered @ f.T + g @ g.T
        kept = starts[starts + count < len(t)]
        off = readings[kept + count] - means[kept] @ (matrix @ grown).T
        cov = matrix @ (grown @ covs[kept] @ grown.T + gathered) @ matrix.T
        spread = np.sqrt(np.diagonal(cov, axis1=1, axis2=2) + errors[kept + count] ** 2)
        out[days] = off, spread
    return out


def harmonics(t, readings, ahead=(30, 90, 180, 365), years=15):
    """What a trend and turns of 433 d, a year and half a year, fitted to the years before, miss."""

    def columns(t):
        out = [np.ones_like(t), (t - 46000) / 3650]
        for period in (433.0, YEAR, YEAR / 2):
            out += [np.cos(2 * np.pi * t / period), np.sin(2 * np.pi * t / period)]
        return np.column_stack(out)

    first, last = (np.searchsorted(t, mjd) for mjd in (46066, 49718))
    out = {days: [] for days in ahead}
    for k in range(first, last, 90 // STEP):
        past = slice(max(0, k + 1 - round(years * YEAR / STEP)), k + 1)
        c = np.linalg.lstsq(columns(t[past]), readings[past], rcond=None)[0]
        for days in ahead:
            if k + days // STEP < len(t):
                j = k + days // STEP
                out[days].append(readings[j] - (columns(t[j : j + 1]) @ c)[0])
    return {days: np.array(rows) for days, rows in out.items()}


def rms(off):
    """The root of the mean squared distance in the plane."""
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def main():
    t, readings, errors = read()
    fits = {}
    for name, names in MODELS.items():
        v, covariance, best, value, x = fits[name] = fit(names, readings, errors)
        period = float(v["period"])
        deviation = period * np.sqrt(covariance[0, 0])
        q = 1 / (2 * float(v["damping"]))
        low = 1 / (2 * float(v["damping"]) * np.exp(1.645 * np.sqrt(covariance[1, 1])))
        print(f"{name}: log-likelihood {best:.1f}, T = {period:.1f} ± {deviation:.1f} d, "
              f"Q = {q:.0f} (> {low:.0f} at 95 %)")  # fmt: skip
        print("   ", {k: float(f"{float(w):.3g}") for k, w in v.items()})
        rigid = np.array(x)
        rigid[0] = np.log(305 / START["period"])
        print(
            f"    a rigid Earth (305 d): log-likelihood lower by {best + float(value(rigid)):.0f}"
        )
    count = t.size / SPARSE
    best = max(fits, key=lambda name: fits[name][2] - 0.5 * len(MODELS[name]) * np.log(count))
    print(f"preferred by Schwarz's criterion: {best}")
    model, root = model_of(fits[best][0], errors)
    found = smooth(model, kalman_filter(model, readings, root))
    size = np.hypot(*np.asarray(found.mean)[:, :2].T)
    for begin in (41684, 44239, 47892):
        part = (t >= begin) & (t < begin + 3653)
        print(f"amplitude from MJD {begin}: {size[part].mean():.0f} mas "
              f"({size[part].min():.0f}–{size[part].max():.0f})")  # fmt: skip
    # Forecasts by numbers that were fitted to what was known before the first of them.
    past = t < 46066
    for name, names in MODELS.items():
        v = fit(names, readings[past], errors[past])[0]
        made = forecasts(v, t, readings, errors)
        other = harmonics(t, readings)
        print(name, "fitted before 1985:")
        for days, (off, spread) in made.items():
            inside = (np.abs(off) < spread).mean()
            print(f"    {days:3d} d: {rms(off):.1f} mas ({len(off)} forecasts), 1σ holds "
                  f"{100 * inside:.0f} %; harmonics {rms(other[days]):.1f} mas")  # fmt: skip


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
