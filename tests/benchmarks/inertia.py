"""Bodies whose inertia is known: errors, and how many 95 % intervals hold, by several methods.

    python tests/benchmarks/inertia.py [SET ...] [--data FOLDER] [--seeds 1] [--score ANSWERS.csv]
    python tests/benchmarks/inertia.py --records FOLDER

Sets: gyro, held, bicycles, throws, racket, polar, moon (all by default). Recordings that are not in this
repository are read from `--data`, or the environment variable RIGIDJAX_DATA, or `shared/data`
beside the checkout; a set that is absent is named. What is not installed is left out.

The table has a row for each set and method: how many numbers were answered, the median
and the 90 % quantile of |value − truth| / scale, the share of 95 % intervals that hold the truth, the share of
bodies that are possible (no negative moment, no moment above the sum of the others), and the
processor time of the set in s, with compiling.

To hand in answers of your own: `--records FOLDER` writes the noisy records of the held tools and
`answers.csv`, with a row for each number that is asked for (set, case, quantity); fill in value, low
and high (the ends of a 95 % interval, empty for none) and a name of your method, and run the
command with `--score answers.csv`.
"""

import argparse
import contextlib
import csv
import json
import os
import sys
import time
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

jax.config.update("jax_enable_x64", True)

from rigidjax import identify

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE / "identify"), str(HERE.parents[1] / "notebooks")]

import bench_held
import bench_throws
import bicycles
import polar_motion

OURS, PLAIN, SCIPY, MUJOCO = (
    "rigidjax",
    "least squares without limits",
    "SciPy `least_squares`",
    "`mujoco.sysid`",
)
Z = 1.959964
SIX = ("Ixx", "Iyy", "Izz", "Iyz", "Ixz", "Ixy")
PLACES = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))


class Answer(NamedTuple):
    """One number of one case by one method; the ends of its interval are nan where there is none."""

    set: str
    case: str
    quantity: str
    value: float
    low: float
    high: float
    method: str


def answers(into, case, method, names, values, low=None, high=None):
    """Append a row for each number."""
    none = np.full(len(names), np.nan)
    ends = (none, none) if low is None else (low, high)
    for name, *numbers in zip(names, values, *ends, strict=True):
        into.append((case, name, *map(float, numbers), method))


def formal(rows, side):
    """Linear least squares, and the covariance that the residual gives."""
    found, *_ = np.linalg.lstsq(rows, side, rcond=None)
    left = side - rows @ found
    return found, left @ left / (side.size - found.size) * np.linalg.inv(rows.T @ rows)


# A gyro's records of free bodies, simulated: 10 s at 10 Hz, noise 0.05 rad/s, body axes principal.

EKF, SPARSE = "EKF with the inertia as a state", "regression of derivatives (SINDy's, right terms)"
RATIOS, GYRO = ("Ix/Iz", "Iy/Iz"), 0.05


def spun(count=100):
    """Yield case, the two ratios, and noisy rates of random bodies."""
    for seed in range(count):
        random = np.random.default_rng([7, seed])
        x, y, z = random.uniform(0.5, 1.5, 3) ** 2
        moments, rate = np.array([y + z, z + x, x + y]), random.normal(size=3)
        slope = lambda _, w, i=moments: np.cross(i * w, w) / i
        run = solve_ivp(slope, (0.0, 10.0), rate, "DOP853", SPUN, rtol=1e-10, atol=1e-12)
        yield (
            f"body {seed}",
            moments[:2] / moments[2],
            run.y.T + GYRO * random.normal(size=(101, 3)),
        )


SPUN = np.linspace(0.0, 10.0, 101)


def gyro_truth(data, seeds):
    for case, ratios, _ in spun():
        yield from (((case, name), (v, v)) for name, v in zip(RATIOS, ratios, strict=True))


@jax.jit
def extended_kalman(rates):
    """Logarithms of the two ratios and their deviations after the last of the readings (T, 3)."""

    def slope(x):
        moments = jnp.exp(jnp.append(x[3:], 0.0))
        return jnp.append(jnp.cross(moments * x[:3], x[:3]) / moments, jnp.zeros(2))

    def ahead(x):
        for _ in range(4):
            h = 0.25 * (SPUN[1] - SPUN[0])
            a = slope(x)
            b = slope(x + h / 2 * a)
            c = slope(x + h / 2 * b)
            x = x + h / 6 * (a + 2 * b + 2 * c + slope(x + h * c))
        return x

    def step(before, reading):
        x, p = before
        f = jax.jacfwd(ahead)(x)
        x, p = ahead(x), f @ p @ f.T
        gain = jnp.linalg.solve(p[:3, :3] + GYRO**2 * jnp.eye(3), p[:3]).T
        return (x + gain @ (reading - x[:3]), p - gain @ p[:3]), None

    # It begins with the first reading, and with a sphere to half a unit of the logarithms.
    first = jnp.append(rates[0], jnp.zeros(2))
    spread = jnp.diag(jnp.array([GYRO, GYRO, GYRO, 0.5, 0.5]) ** 2)
    (x, p), _ = jax.lax.scan(step, (first, spread), rates[1:])
    return x[3:], jnp.sqrt(jnp.diagonal(p)[3:])


def regressed(rates):
    """Ratios from dΩ/dt = (c1 Ωy Ωz, c2 Ωz Ωx, …), each c by linear regression."""
    rate, w = (savgol_filter(rates, 9, 3, deriv=k, delta=SPUN[1] - SPUN[0], axis=0) for k in (1, 0))
    products = np.stack([w[:, 1] * w[:, 2], w[:, 2] * w[:, 0]], axis=1)
    c1, c2 = np.sum(products * rate[:, :2], axis=0) / np.sum(products**2, axis=0)
    # a c1 = b - 1 and b c2 = 1 - a of a = Ix/Iz, b = Iy/Iz.
    return np.linalg.solve([[c1, -1.0], [1.0, c2]], [-1.0, 1.0])


def spinning(data, seeds):
    out, spent = [], {}
    for method in (OURS, EKF, SPARSE):
        begin = time.process_time()
        for case, _, rates in spun():
            if method == OURS:
                record = identify.Recording(SPUN, (identify.Gyro(GYRO), rates))
                fit = identify.fit(identify.Model(record, identify.PrincipalRatios()), starts=1)
                ends = np.array([fit.interval(0.95)[name] for name in RATIOS]).T
                values = {quantity.name: quantity.value for quantity in fit.quantities}
                answers(out, case, method, RATIOS, [values[name] for name in RATIOS], *ends)
            elif method == EKF:
                logs, deviation = map(np.asarray, extended_kalman(rates))
                ends = np.exp(logs - Z * deviation), np.exp(logs + Z * deviation)
                answers(out, case, method, RATIOS, np.exp(logs), *ends)
            else:
                answers(out, case, method, RATIOS, regressed(rates))
        spent[method] = time.process_time() - begin
    return out, spent


# Held tools: ten numbers of a tool from the wrench of the hand, the motion known.


def tensor_of(six):
    out = np.zeros((3, 3))
    for value, (i, j) in zip(six, PLACES, strict=True):
        out[i, j] = out[j, i] = value
    return out


def wrench_rows(table):
    """The matrix (6 T, 10) from mass, mass × centre and the tensor about the sensor to the wrench."""
    get = lambda names: bench_held.columns(table, names)
    turn = Rotation.from_quat(get("qw qx qy qz"), scalar_first=True)
    spin, speeding = get("wx wy wz"), get("alx aly alz")
    felt = get("ax ay az") - turn.inv().apply(bench_held.GRAVITY)
    hat = lambda v: np.cross(v[:, None, :], np.eye(3)[None]).swapaxes(1, 2)
    basis = np.stack([tensor_of(one) for one in np.eye(6)])
    spun = np.einsum("kij,tj->tik", basis, spin)
    turning = np.einsum("kij,tj->tik", basis, speeding) + np.einsum("tij,tjk->tik", hat(spin), spun)
    out = np.zeros((len(spin), 6, 10))
    out[:, :3, 0], out[:, :3, 1:4] = felt, hat(speeding) + hat(spin) @ hat(spin)
    out[:, 3:, 1:4], out[:, 3:, 4:] = -hat(felt), turning
    return out.reshape(-1, 10)


def about_centre(ten):
    """Six components about the centre of mass from ten numbers about the sensor."""
    mass, first, tensor = ten[0], ten[1:4], tensor_of(ten[4:])
    tensor = tensor - (first @ first * np.eye(3) - np.outer(first, first)) / mass
    return np.array([tensor[place] for place in PLACES])


def cholesky(x):
    """Ten numbers of a possible body from ten of any size: ∫ (1, r)(1, r)ᵀ dm = L Lᵀ, log diagonal."""
    lower = np.zeros((4, 4))
    lower[np.tril_indices(4, -1)] = x[4:]
    whole = lower + np.diag(np.exp(x[:4]))
    whole = whole @ whole.T
    second = whole[1:, 1:]
    tensor = np.trace(second) * np.eye(3) - second
    return np.r_[whole[0, 0], whole[0, 1:], [tensor[place] for place in PLACES]]


def slopes(function, x):
    """Central differences (outputs, inputs)."""
    steps = 1e-6 * np.maximum(np.abs(x), 1e-3)
    sides = [(function(x + s) - function(x - s)) / s[i] / 2 for i, s in enumerate(np.diag(steps))]
    return np.stack(sides, axis=1)


def spread(function, x, covariance):
    slope = slopes(function, x)
    return Z * np.sqrt(np.einsum("ij,jk,ik->i", slope, covariance, slope))


def by_mujoco(table):
    """A function of noisy wrenches, its six components and their reach: `mujoco.sysid`, whose numbers are
    those of a possible body, on `mj_inverse` of a free body; None without it."""
    try:
        import mujoco
        from mujoco import sysid

        kind = sysid.InertiaType.Pseudo
    except (ModuleNotFoundError, ImportError, AttributeError):
        return None
    get = lambda names: bench_held.columns(table, names)
    quaternions, spin = get("qw qx qy qz"), get("wx wy wz")
    turn = Rotation.from_quat(quaternions, scalar_first=True)
    qpos = np.column_stack([np.zeros_like(spin), turn.as_quat(scalar_first=True)])
    qvel = np.column_stack(
        [np.zeros_like(spin), spin]
    )  # of the origin only its acceleration counts
    qacc = np.column_stack([turn.apply(get("ax ay az")), get("alx aly alz")])
    xml = f"""<mujoco><compiler balanceinertia="false"/><option gravity="{" ".join(map(str, bench_held.GRAVITY))}">
    <flag contact="disable"/></option><worldbody><body name="tool"><freejoint/>
    <inertial pos="0 0 0" mass="1" diaginertia="1.7e-3 1.7e-3 1.7e-3"/></body></worldbody></mujoco>"""
    spec = mujoco.MjSpec.from_string(xml)
    wide = dict(
        mass_bound_mult=[1e-3, 1e2], stretch_bound_mult=[1e-4, 1e2], shear_bound_off=[-9, 9]
    )
    param = sysid.body_inertia_param(
        spec, spec.compile(), "tool", kind, **{k: np.array(v) for k, v in wide.items()}
    )
    params = sysid.ParameterDict({param.name: param})
    begin = params.as_vector()

    def spec_at(x):
        params.update_from_vector(x)
        spec = mujoco.MjSpec.from_string(xml)
        sysid.apply_body_inertia(spec, "tool", param)
        spec.body("tool").iquat = [1, 0, 0, 0]  # it leaves NaN, which MuJoCo 4.0.0 does not compile
        return spec

    def wrench(x):
        try:
            model = spec_at(x).compile()
        except ValueError:  # a flat body, by round-off beyond: its optimiser is to turn back
            return np.full((len(qpos), 6), 1e3)
        data, out = mujoco.MjData(model), np.empty((len(qpos), 6))
        for k in range(len(qpos)):
            data.qpos[:], data.qvel[:], data.qacc[:] = qpos[k], qvel[k], qacc[k]
            mujoco.mj_inverse(model, data)
            out[k] = data.qfrc_inverse
        return np.column_stack([turn.inv().apply(out[:, :3]), out[:, 3:]])

    def six(x):
        xx, yy, zz, xy, xz, yz = np.ravel(spec_at(x).body("tool").fullinertia)
        return np.array([xx, yy, zz, yz, xz, xy])

    def fit(readings, noise):
        def residual(x, _=None, **__):
            columns = [((wrench(c) - readings) / noise).ravel() for c in np.atleast_2d(x.T)]
            return [columns[0] if x.ndim == 1 else np.stack(columns, 1)], None, None

        params.update_from_vector(begin)
        with contextlib.redirect_stdout(None):
            found, best = sysid.optimize(params, residual, verbose=False, max_iters=60)
        x = found.as_vector()
        covariance, _ = sysid.calculate_intervals(residual(x)[0], np.asarray(best.jac))
        return six(x), spread(six, x, covariance)

    return fit


def tools(data, seeds):
    """Yield case, table, noisy wrench and noise of the held tools, at twice the least noise."""
    folder = data / "held_tools"
    noise = 2 * bench_held.NOISE
    for number, name in enumerate(sorted(json.loads((folder / "truth.json").read_text()))):
        table = np.genfromtxt(folder / f"{name}.csv", delimiter=",", names=True)
        exact = bench_held.columns(table, "fx fy fz tx ty tz")
        for seed in range(seeds):
            random = np.random.default_rng([number, 2, seed])
            yield f"{name} {seed}", table, exact + noise * random.normal(size=exact.shape), noise


def held_truth(data, seeds):
    known = json.loads((data / "held_tools" / "truth.json").read_text())
    for name in sorted(known):
        one = bench_held.truth_of(known[name])
        for seed in range(seeds):
            yield from (((f"{name} {seed}", key), (one[key], one["I3"])) for key in SIX)


def held(data, seeds):
    out, spent, all_tools = [], {}, list(tools(data, seeds))
    for method in (OURS, PLAIN, SCIPY, MUJOCO):
        begin = time.process_time()
        for case, table, readings, noise in all_tools:
            if method == MUJOCO:
                if fit := by_mujoco(table):
                    six, reach = fit(readings, noise)
                    answers(out, case, method, SIX, six, six - reach, six + reach)
                continue
            if method == OURS:
                motion = bench_held.motion_of(table, None)
                fit, _ = bench_held.fitted(table["t"], motion, readings, noise)
                ends = np.array([fit.interval(0.95)[name] for name in SIX]).T
                six = [fit.body.inertia.tensor[place] for place in PLACES]
                answers(out, case, method, SIX, six, *ends)
                continue
            weight = np.tile(1 / noise, len(readings))
            rows = weight[:, None] * wrench_rows(table)
            side = weight * readings.ravel()
            if method == PLAIN:
                x, covariance = formal(rows, side)
                numbers = about_centre
            else:
                # By the normal equations: the ten numbers enter linearly.
                q, r = np.linalg.qr(rows)
                begun = np.r_[np.log([1.0, 0.05, 0.05, 0.05]), np.zeros(6)]
                errors = lambda x, q=q, r=r: r @ cholesky(x) - q.T @ side
                best = least_squares(errors, begun, x_scale="jac", max_nfev=2000)
                x = best.x
                covariance = np.linalg.pinv(best.jac.T @ best.jac)
                numbers = lambda x: about_centre(cholesky(x))
            six, reach = numbers(x), spread(numbers, x, covariance)
            answers(out, case, method, SIX, six, six - reach, six + reach)
        spent[method] = time.process_time() - begin
    return out, spent


# Bicycles: no independent truth; the published numbers are the authors' own reduction.

AUTHORS = "the authors' reduction (classical)"
INERTIAS = [k for k in bicycles.WANTED if k[0] == "I"]


def bicycles_truth(data, seeds):
    for name in bicycles.BICYCLES:
        known = bicycles.numbers(name, "published")
        for key in INERTIAS:
            most = max(abs(v) for k, v in known.items() if k[:2] == key[:2])
            yield (f"{name} {key[1]}", f"I{key[2:]}"), (known[key], most)


def hung(data, seeds):
    out, spent = [], dict.fromkeys((OURS, AUTHORS), 0.0)
    for name in bicycles.BICYCLES:
        begin = time.process_time()
        model, wanted, start = bicycles.joint(name)
        fit = identify.fit(model, initial=start, starts=1)
        ends = np.array(fit.interval_of(wanted)).T
        values = np.asarray(wanted(model.unpack(fit.x)))
        middle = time.process_time()
        classical = bicycles.classical(bicycles.numbers(name, "measured"))
        spent[OURS] += middle - begin
        spent[AUTHORS] += time.process_time() - middle
        for key, value, (low, high) in zip(bicycles.WANTED, values, ends, strict=True):
            if key in INERTIAS:
                case, quantity = f"{name} {key[1]}", (f"I{key[2:]}",)
                answers(out, case, OURS, quantity, [value], [low], [high])
                answers(out, case, AUTHORS, quantity, [classical[key]])
    return out, spent


# Throws of a box with a wheel inside, alone and with a proof body and two objects.


def throws_truth(data, seeds):
    for name, truth in bench_throws.TRUTH.items():
        for path in throw_paths(data, name):
            case = path.stem.replace("_log", " ")
            yield from (((case, q), (v, v)) for q, v in zip(("I1", "I2", "I3"), truth, strict=True))


def throw_paths(data, name):
    bench_throws.throws.FOLDER = data / "tudelft_throw"
    return bench_throws.throws.paths(name)


def momentum_rows(spin, rate):
    """The matrix (3 T, 6) from six components of J to J dΩ/dt + Ω × J Ω."""
    basis = np.stack([tensor_of(one) for one in np.eye(6)])
    turned = np.cross(spin[:, None], np.einsum("kij,tj->tki", basis, spin))
    rows = np.einsum("kij,tj->tki", basis, rate) + turned
    return rows.swapaxes(1, 2).reshape(-1, 6)


def euler_regression(path):
    """Six components of a tensor and their covariance: d(J Ω + h)/dt = 0, linear in J, smoothed."""
    throws = bench_throws.throws
    log = throws.columns(path, throws.WINDOW[0])
    read = np.stack([log[name] for name in ("wx", "wy", "wz", "flywheel")], axis=1)
    rate, speed = (savgol_filter(read, 25, 3, deriv=k, delta=1e-3, axis=0) for k in (1, 0))
    spin, wheel, axis = speed[:, :3], throws.WHEEL * speed[:, 3:], np.array([0.0, 0.0, 1.0])
    rows = momentum_rows(spin, rate[:, :3])
    side = -throws.WHEEL * rate[:, 3:] * axis - np.cross(spin, wheel * axis)
    return formal(rows, side.ravel())


def thrown(data, seeds):
    out, names, bench = [], ("I1", "I2", "I3"), bench_throws
    bench.throws.FOLDER = data / "tudelft_throw"
    begin = time.process_time()
    records, levers = bench.given(1, 0.53)
    joint = bench.together(records)
    cases = {n: [p.stem.replace("_log", " ") for p in bench.throws.paths(n)] for n in records}
    for name in bench.TRUTH:
        beside = bench.shared(joint, levers, name, joint.body[name].tensor)
        for row, case in enumerate(cases[name]):
            _, middle, reach = bench.judged(name, row, joint, levers, beside)
            ends = np.exp(middle - reach), np.exp(middle + reach)
            answers(out, case, OURS, names, np.exp(middle), *ends)
    ours = time.process_time() - begin
    begin = time.process_time()
    found = {n: [euler_regression(p) for p in bench.throws.paths(n)] for n in records}
    mean = {n: tensor_of(np.mean([x for x, _ in found[n]], axis=0)) for n in found}
    device = mean[bench.DEVICE]
    factor = bench.factor_of(mean[bench.PROOF], device, levers)
    for name in bench.TRUTH:
        moments = lambda six, name=name: np.asarray(
            bench.moments(name, tensor_of(six), device, factor, levers)
        )
        for case, (six, covariance) in zip(cases[name], found[name], strict=True):
            value, reach = moments(six), spread(moments, six, covariance)
            answers(out, case, PLAIN, names, value, value - reach, value + reach)
    return out, {OURS: ours, PLAIN: time.process_time() - begin}


# A tennis racket: flat, so that I1 + I2 = I3.

FLAT = "(I1 + I2)/I3"


def tosses(data, count=60):
    """Yield case, times and rates of the first readings of each toss."""
    path = data / "tennis_racket" / "tosses.csv"
    with path.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    for toss in dict.fromkeys((row["round"], row["toss"]) for row in rows):
        mine = [row for row in rows if (row["round"], row["toss"]) == toss][:count]
        table = np.array([[float(row[k]) for k in ("t", "wx", "wy", "wz")] for row in mine])
        yield " ".join(toss), table[:, 0], table[:, 1:]


def racket_truth(data, seeds):
    for case, *_ in tosses(data):
        yield (case, FLAT), (1.0, 1.0)


def flatness(tensor):
    """(I1 + I2)/I3 of the moments of a symmetric matrix."""
    moments = jnp.linalg.eigvalsh(tensor)
    return (moments[0] + moments[1]) / moments[2]


def flat_by_regression(t, rates):
    """`flatness` and its reach: dΩ/dt and Ω smoothed, J dΩ/dt + Ω × J Ω = 0 linear in J, of trace 3."""
    step = np.median(np.diff(t))
    rate, spin = (savgol_filter(rates, 9, 3, deriv=k, delta=step, axis=0) for k in (1, 0))
    rows = momentum_rows(spin, rate)
    # Izz = 3 - Ixx - Iyy.
    free = rows - np.outer(rows[:, 2], [1, 1, 1, 0, 0, 0])
    x, covariance = formal(np.delete(free, 2, axis=1), -3 * rows[:, 2])
    of = lambda x: np.atleast_1d(flatness(tensor_of([*x[:2], 3 - x[0] - x[1], *x[2:]])))
    return of(x), spread(of, x, covariance)


def tossed(data, seeds):
    out, spent = [], {}
    begin = time.process_time()
    for case, t, rates in tosses(data):
        record = identify.Recording(t, (identify.Gyro(), rates))
        fit = identify.fit(identify.Model(record, identify.Ratios()))
        # Of each ratio: at the limit of flat bodies the sum has no slope, and `interval_of` no width.
        low, high = np.sum([fit.interval(0.95)[name] for name in ("I1/I3", "I2/I3")], axis=0)
        answers(out, case, OURS, [FLAT], [flatness(fit.body.tensor)], [low], [high])
    spent[OURS] = time.process_time() - begin
    begin = time.process_time()
    for case, t, rates in tosses(data):
        value, reach = flat_by_regression(t, rates)
        answers(out, case, PLAIN, [FLAT], value, value - reach, value + reach)
    return out, spent | {PLAIN: time.process_time() - begin}


# The Earth's free precession. Wilson and Vicente (1990), from other and longer records: 433.0 d.

WAVE = "sinusoids by SciPy `least_squares`"


def polar_truth(data, seeds):
    yield ("Earth", "period"), (433.0, 433.0)


def wandered(data, seeds):
    out, names = [], ("period",)
    t, readings, errors = polar_motion.read()
    begin = time.process_time()
    found, covariance, *_ = polar_motion.fit(polar_motion.MODELS["red"], readings, errors)
    reach = np.exp(Z * np.sqrt(covariance[0, 0]))
    period = float(found["period"])
    answers(out, "Earth", OURS, names, [period], [period / reach], [period * reach])
    middle = time.process_time()

    def left(x):
        """What a trend, a year, half a year and a turn of x days leave."""
        turns = [
            2 * np.pi * (t - 46000) / p for p in (x[0], polar_motion.YEAR, polar_motion.YEAR / 2)
        ]
        columns = np.stack([t**0, t - 46000, *(f(a) for a in turns for f in (np.cos, np.sin))], 1)
        return (readings - columns @ np.linalg.lstsq(columns, readings, rcond=None)[0]).ravel()

    best = least_squares(left, [430.0], x_scale=1.0)
    deviation = np.sqrt(2 * best.cost / (readings.size - 17) / (best.jac.T @ best.jac)[0, 0])
    answers(out, "Earth", WAVE, names, best.x, best.x - Z * deviation, best.x + Z * deviation)
    return out, {OURS: middle - begin, WAVE: time.process_time() - middle}


# The Moon: six years of DE421's attitude, its shape from the attitude alone.


def moon_truth(data, seeds):
    from rigidjax.datasets import moon

    known = moon.Moon(moon.EPOCH, moon.EPOCH + 1).constants
    for name, key in (("β", "LBET"), ("γ", "LGAM")):
        yield ("Moon", name), (known[key], known[key])


def librated(data, seeds):
    from rigidjax.datasets import moon

    begin = time.process_time()
    read = moon.Moon(moon.EPOCH, moon.EPOCH + 6)
    ts = jnp.arange(0.0, 6 * 365.25, 20.0) * moon.DAY
    seen = jax.vmap(lambda t: read.attitude(t).q)(ts)
    sensor = identify.AttitudeSensor(np.radians(1 / 3.6e6))
    model = identify.Model(
        identify.Recording(ts, (sensor, seen)),
        read.chart(core=True),
        torque=read.torque(core=True, tide=True, figure=True),
        integrator=identify.Adaptive(1e-9, 1e-15),
    )
    start = model.start(read.body(core=True), read.attitude(0.0).omega)
    fit = identify.fit(model, initial=start, starts=1)
    low, high = np.array([fit.interval(0.95)[name] for name in "βγ"]).T
    out = []
    answers(out, "Moon", OURS, "βγ", np.exp(read.chart(core=True).logs(fit.body)), low, high)
    return out, {OURS: time.process_time() - begin}


class Set(NamedTuple):
    """A set: what there is to know, the methods of this file, and what it needs."""

    truth: object
    run: object
    needs: str  # a folder of the data, or a package


SETS = {
    "gyro": Set(gyro_truth, spinning, ""),
    "held": Set(held_truth, held, "held_tools"),
    "bicycles": Set(bicycles_truth, hung, ""),
    "throws": Set(throws_truth, thrown, "tudelft_throw"),
    "racket": Set(racket_truth, tossed, "tennis_racket"),
    "polar": Set(polar_truth, wandered, ""),
    "moon": Set(moon_truth, librated, "de421"),
}


def is_there(name, data):
    needs = SETS[name].needs
    return not needs or (data / needs).exists() or find_spec(needs) is not None


def possible(body):
    """Whether the numbers of one body, by name, are those of a possible one; None where they do not say."""
    if FLAT in body:
        return body[FLAT] >= 1 - 1e-9
    if "I1" in body:
        moments = np.sort([body[name] for name in ("I1", "I2", "I3")])
    elif "Ix/Iz" in body:
        moments = np.sort([*(body[name] for name in RATIOS), 1.0])
    elif "Ixx" in body:
        six = [body.get(name, 0.0) for name in SIX]
        six[2] = body.get("Izz", six[0])  # a round wheel
        moments = np.linalg.eigvalsh(tensor_of(six))
    else:
        return None
    return bool(moments[0] >= 0 and moments[2] <= (moments[0] + moments[1]) * (1 + 1e-9))


def score(rows, truth, spent):
    """Print a line of the table for each set and method."""
    print(
        "| set | method | numbers | median error | 90 % below | intervals that hold | possible | s |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for name, method in dict.fromkeys((row.set, row.method) for row in rows):
        mine = [row for row in rows if (row.set, row.method) == (name, method)]
        known = [truth[row[:3]] for row in mine]
        off = np.array([abs(r.value - v) / s for r, (v, s) in zip(mine, known, strict=True)])
        stated = [(r, v) for r, (v, _) in zip(mine, known, strict=True) if not np.isnan(r.low)]
        held = [row.low <= value <= row.high for row, value in stated]
        bodies = {}
        for row in mine:
            bodies.setdefault(row.case, {})[row.quantity] = row.value
        can = [one for one in map(possible, bodies.values()) if one is not None]
        share = lambda some: f"{sum(some)} of {len(some)}" if some else "–"
        print(
            f"| {name} | {method} | {len(mine)} | {np.median(off):.2g} | {np.quantile(off, 0.9):.2g} | {share(held)} "
            f"| {share(can)} | {spent.get((name, method), np.nan):.2g} |".replace(
                "| nan |", "| – |"
            )
        )


def main(words):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sets", nargs="*", choices=[*SETS, []], metavar="SET")
    beside = HERE.parents[2] / "shared" / "data"
    parser.add_argument("--data", type=Path, default=os.environ.get("RIGIDJAX_DATA", beside))
    parser.add_argument("--seeds", type=int, default=1, help="noisy records of each held tool")
    parser.add_argument("--score", type=Path, help="answers of another method, CSV")
    parser.add_argument("--records", type=Path, help="write records and empty answers there")
    told = parser.parse_args(words)
    data, truth, rows, spent = Path(told.data), {}, [], {}
    for name in told.sets or SETS:
        if not is_there(name, data):
            print(f"{name}: {SETS[name].needs} is neither in {data} nor installed: left out")
            continue
        known = SETS[name].truth(data, told.seeds)
        truth |= {(name, *key): value for key, value in known}
        if told.records or told.score:
            continue
        found, times = SETS[name].run(data, told.seeds)
        rows += [Answer(name, *row) for row in found]
        spent |= {(name, method): one for method, one in times.items()}
        print(f"{name}: {len(found)} numbers", flush=True)
    if told.records:
        told.records.mkdir(parents=True, exist_ok=True)
        if is_there("held", data):
            for case, table, readings, _ in tools(data, told.seeds):
                names = "t x y z qw qx qy qz wx wy wz ax ay az alx aly alz"
                columns = np.column_stack([bench_held.columns(table, names), readings])
                head = ",".join(f"{names} fx fy fz tx ty tz".split())
                path = told.records / f"{case.replace(' ', '_')}.csv"
                np.savetxt(path, columns, "%.12g", ",", header=head, comments="")
        with (told.records / "answers.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(Answer._fields)
            writer.writerows((*key, "", "", "", "") for key in truth)
        return
    if told.score:
        with told.score.open(encoding="utf-8") as file:
            for row in csv.DictReader(file):
                if row["value"]:
                    numbers = (float(row[k] or "nan") for k in ("value", "low", "high"))
                    key = row["set"], row["case"], row["quantity"]
                    rows.append(Answer(*key, *numbers, row["method"] or told.score.stem))
    score(rows, truth, spent)


if __name__ == "__main__":
    main(sys.argv[1:])
