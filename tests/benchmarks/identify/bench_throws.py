"""The throws of `shared/data/tudelft_throw` as one problem of four bodies with one sensor.

    python tests/benchmarks/identify/bench_throws.py [EVERY] [END] [--white | --correlated] [--whole]
    python tests/benchmarks/identify/bench_throws.py [EVERY] [END] --copies COUNT

The recipe. All throws together: each group has a body of its own (six numbers) and a drag of its
own; all share the gyro (bias, scale an axis, three skew terms) and the wheel's tilt; each throw has
a first rate, a delay of the wheel's log, and a bias that deviates from the shared one by 0.02
rad/s. Noise is estimated for each body. No object's truth enters: the proof body's moments fix the
scale of the wheel. Then each throw alone, with the sensor as it was found and the drag of its body
as sure as it was found. Intervals: the fit's, and what the lever arms (regression on the
accelerometer) scatter from throw to throw. Notebook 15 does the same from the logs on.

EVERY keeps each so many samples (default 1: 1 kHz), END is the last time, s (default 0.53).

--white and --correlated: then each throw alone also has an unknown torque of that kind, its numbers
free (`identify.refit`). Device, wheel and objects are then all of such fits: the device and the
proof body are the means of theirs. With --whole all throws of a body are one problem instead.

--copies: simulated copies of the whole experiment instead, whose truth is the joint fit: each throw
has the residuals of another throw of its body, with a random sign; lever arms scatter as they do.
"""

import importlib.util
import sys
import time
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import stdtrit

jax.config.update("jax_enable_x64", True)

import rigidjax as rj
from rigidjax import identify

_spec = importlib.util.spec_from_file_location(
    "throws", Path(__file__).parents[2] / "identify" / "throws.py"
)
throws = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(throws)

DEVICE, PROOF, *OBJECTS = (
    "calibration_device_only",
    "calibration_proof_body",
    "object_empty",
    "object_a",
)
MASSES = {DEVICE: throws.DEVICE, PROOF: throws.PROOF} | {
    name: throws.OBJECTS[name][0] for name in OBJECTS
}
TRUTH = {PROOF: throws.PROOF_MOMENTS} | {name: throws.OBJECTS[name][1] for name in OBJECTS}
# How far a throw's bias is from the sensor's, rad/s.
OWN_BIAS = 0.02


LAW = throws.law(tilt=[0.0, 0.0])


def record(path, every, end):
    log, speed = throws.columns(path, throws.WINDOW[0]), throws.speed(path)
    gyro = identify.Gyro(bias=[0.0] * 3, scale=[1.0] * 3, skew=[0.0] * 3)
    rates = np.stack([log["wx"], log["wy"], log["wz"]], axis=1)
    kept = np.flatnonzero(log["t"] <= end + 1e-9)[::every]
    return identify.Recording(log["t"][kept], (gyro, rates[kept]), inputs={"speed": speed})


def free(own_bias, drag):
    return [
        identify.Free(lambda s: s.sensors[0].bias, "bias", scale=0.05, **own_bias),
        identify.Free(lambda s: s.torque.parts[0].momentum.delay, "delay", scale=1e-3, each=True),
        identify.Free(lambda s: s.torque.parts[1].coefficient, "drag", scale=1e-5, **drag),
    ]


SENSOR = [
    identify.Free(lambda s: s.sensors[0].scale, "scale", scale=0.01),
    identify.Free(lambda s: s.sensors[0].skew, "skew", scale=0.01),
    identify.Free(lambda s: s.torque.parts[0].momentum.tilt, "tilt", scale=0.01),
]


def together(records):
    charts = {name: identify.Tensor(3e-4) for name in records}
    moves = [*free({"spread": OWN_BIAS}, {"each": "body"}), *SENSOR]
    problem = identify.Model(records, charts, torque=LAW, free=moves, noise_each="body")
    return identify.fit(problem, starts=1)


def alone(name, row, joint):
    """One throw with the sensor of the joint fit; its bias and drag about the shared ones."""
    return some(name, [row], joint)


def some(name, rows, joint):
    """Throws of one body; each has a bias and a delay of its own."""
    at = joint.model.body_names.index(name) + np.asarray(rows)
    scenes = jax.tree.map(lambda a: a[at[0]] if eqx.is_array(a) else a, joint.model.scenes(joint.x))
    gyro = eqx.tree_at(lambda g: g.bias, scenes.sensors[0], joint.values["bias"])
    torque = eqx.tree_at(lambda law: law.parts[0].momentum.delay, scenes.torque, jnp.zeros(()))
    chosen = [
        eqx.tree_at(lambda r: r.readings[0].sensor, joint.model.recordings[row], gyro) for row in at
    ]
    # As sure as the joint fit is of the drag, of all axes the one that it is least sure of.
    drag = max(
        q.deviation for q in joint.quantities if q.name in [f"drag {a} [{name}]" for a in "xyz"]
    )
    moves = free({"prior": OWN_BIAS, "each": True}, {"prior": drag})
    problem = identify.Model(chosen, identify.Tensor(3e-4), torque=torque, free=moves)
    start = problem.start(joint.body[name])
    pairs = [(m.index.start, m.slots[1].own) for m in (problem, joint.model)]
    for mine, theirs in zip(*pairs, strict=True):
        start = start.at[mine].set(joint.x[theirs[at]])
    return identify.fit(problem, starts=1, initial=start)


def with_torque(found, law):
    """The fit of throws, an unknown torque integrated out; nothing else is new."""
    ts = found.model.recordings[0].t
    # First guesses: all of the misfit is what the torque does to the rate in the time of the throw,
    # and the torque lasts as long as the errors are autocorrelated.
    momentum = jnp.mean(found.noise[0]) * jnp.trace(found.body.tensor) / 3
    density = momentum**2 / (ts[-1] - ts[0])
    process = {
        "white": lambda: rj.torques.RandomTorque(density),
        "correlated": lambda: rj.torques.CorrelatedTorque(
            density, found.correlation * (ts[1] - ts[0])
        ),
    }[law]()
    return identify.refit(identify.LogDensity(found, process))


def drawn(best, key, count=1000):
    """Tensors (count, 3, 3) drawn from the posterior of one throw."""
    if best.effective_count >= 100:
        x = jax.random.choice(key, best.draws, (count,), p=best.weights)
    else:
        x = jax.random.multivariate_normal(key, best.x, best.covariance, (count,))
    return jax.vmap(lambda one: best.density.unpack(one).body.tensor)(x)


def throws_with_torque(law, joint, records, levers, whole=False):
    """Print the figures of throws with an unknown torque: each alone, and the mean of a body's; or
    those of all throws of a body as one problem (`whole`). Returns which intervals of means (or of
    those problems) hold.
    """
    keys = iter(jax.random.split(jax.random.key(0), joint.model.count))
    totals = {}
    for name, rows in records.items():
        each = [[*range(len(rows))]] if whole else [[row] for row in range(len(rows))]
        found = [with_torque(some(name, rows, joint), law) for rows in each]
        totals[name] = jnp.stack([drawn(best, next(keys)) for best in found])
        densities = [float(best.point.process.density[0]) for best in found]
        evidence = sum(evidence_of(best) for best in found)
        print(
            f"{name}, {law} torque: {sum(bool(best.converged) for best in found)} of {len(found)} "
            f"converged, independent draws {min(float(best.effective_count) for best in found):.0f} and "
            f"more, log evidence {evidence:.0f}, density {np.median(densities):.1e} N² m² s"
        )
        if law == "correlated":
            print(f"  time {np.median([float(best.point.process.time) for best in found]):.4f} s")
    device, proof = (jnp.mean(totals[name], axis=0) for name in (DEVICE, PROOF))

    def log_moments(name, total, device, proof, levers):
        factor = factor_of(proof, device, levers)
        return jnp.log(moments(name, total, device, factor, levers))

    factors = jax.vmap(lambda p, d: factor_of(p, d, levers))(proof, device)
    print(f"  the wheel's inertia times {factors.mean():.4f} ± {1.96 * factors.std():.4f}")

    def judge(name, total):
        """Errors and reaches (3,) of log moments of draws (m, 3, 3) of a tensor."""
        of = jax.vmap(lambda *parts: log_moments(name, *parts, levers))
        low, high = np.quantile(np.asarray(of(total, device, proof)), (0.025, 0.975), axis=0)
        means = [jnp.mean(part, axis=0) for part in (total, device, proof)]
        known = of_levers(lambda d: log_moments(name, *means, d), levers)
        return 0.5 * (low + high) - np.log(TRUTH[name]), np.hypot((high - low) / 2, known)

    all_errors, alone_held, mean_held = [], [], []
    for name in TRUTH:
        error, reach = judge(name, jnp.mean(totals[name], axis=0))
        mean_held.append(show(f"{name}, {'all' if whole else 'mean of'} its throws", error, reach))
        print(f"  errors % {np.round(100 * error, 2)}, 95 % ±% {np.round(100 * reach, 2)}")
        if whole:
            continue
        errors, reaches = map(np.array, zip(*(judge(name, t) for t in totals[name]), strict=True))
        alone_held.append(show(f"{name}, {len(errors)} throws", errors, reaches).ravel())
        print(f"  mean errors % {np.round(100 * errors.mean(axis=0), 2)}")
        all_errors.append(np.abs(errors).ravel())
    if whole:
        print(f"in all: {np.sum(mean_held)} of {np.size(mean_held)} intervals hold")
    else:
        summary(all_errors, alone_held, mean_held, "the means")
    return np.ravel(mean_held)


def evidence_of(best):
    """The logarithm of the integral of the posterior density, by Laplace's method."""
    return float(best.log_density) + 0.5 * np.linalg.slogdet(2 * np.pi * best.covariance)[1]


def summary(errors, alone_held, together_held, together):
    errors, held = np.concatenate(errors), np.concatenate(alone_held)
    print(
        f"in all: mean {100 * errors.mean():.2f} %, worst {100 * errors.max():.2f} %; intervals of "
        f"single throws that hold {held.sum()} of {held.size}, of {together} "
        f"{np.sum(together_held)} of {np.size(together_held)}"
    )
    return errors, held, np.ravel(together_held)


def shift(mass, d):
    return mass * (jnp.sum(d * d) * jnp.eye(3) - d[:, None] * d[None, :])


def moments(name, total, device, factor, levers):
    """Principal moments, kg mm², of what was measured with the device, ascending."""
    between = levers[name] - levers[DEVICE]
    other = -(MASSES[DEVICE] / MASSES[name]) * between
    tensor = factor * (total - device) - shift(MASSES[DEVICE], between)
    return jnp.linalg.eigvalsh(tensor - shift(MASSES[name], other)) * 1e6


def factor_of(proof, device, levers):
    """By what factor the wheel's inertia is off: what makes the trace of the proof body's right."""
    between = levers[PROOF] - levers[DEVICE]
    distance = MASSES[DEVICE] * (1.0 + MASSES[DEVICE] / MASSES[PROOF]) * jnp.sum(between**2)
    return (1e-6 * sum(TRUTH[PROOF]) + 2.0 * distance) / jnp.trace(proof - device)


def of_levers(function, levers, rows=None):
    """Half-widths of 95 % intervals of `function(levers)` by their scatter from throw to throw."""
    slopes, rows = jax.jacfwd(function)(levers), rows or {n: throws.levers(n) for n in levers}
    # The variance of a median is π/2 times that of a mean.
    scatter = {n: np.pi / 2 * np.cov(rows[n].T) / len(rows[n]) for n in levers}
    parts = {n: np.einsum("ij,jk,ik->i", slopes[n], scatter[n], slopes[n]) for n in levers}
    total = sum(parts.values())
    # Degrees of freedom by Welch and Satterthwaite (1946, doi:10.2307/3002019).
    freedom = total**2 / sum(part**2 / (len(rows[n]) - 1) for n, part in parts.items())
    return stdtrit(freedom, 0.975) * np.sqrt(total)


@partial(jax.jit, static_argnums=0)
def log_moments(name, total, bodies, levers):
    device = bodies[DEVICE].tensor
    return jnp.log(
        moments(name, total, device, factor_of(bodies[PROOF].tensor, device, levers), levers)
    )


def shared(joint, levers, name, total):
    """Half-widths for the log moments of a tensor by what it takes from the joint fit."""
    total = jnp.asarray(total)
    low, high = joint.interval_of(lambda point: log_moments(name, total, point.body, levers))
    known = of_levers(lambda d: log_moments(name, total, joint.body, d), levers)
    return np.hypot((high - low) / 2, known)


def of_all(name, joint, levers, rows=None):
    """Middles and half-widths of the log moments of a body in the joint fit."""
    low, high = joint.interval_of(
        lambda point: log_moments(name, point.body[name].tensor, point.body, levers)
    )
    total = joint.body[name].tensor
    known = of_levers(lambda d: log_moments(name, total, joint.body, d), levers, rows)
    return 0.5 * (low + high), np.hypot((high - low) / 2, known)


def judged(name, row, joint, levers, beside):
    """The fit of one throw; middles and half-widths of its log moments, those of `shared` beside."""
    one = alone(name, row, joint)
    low, high = one.interval_of(
        lambda point: log_moments(name, point.body.tensor, joint.body, levers)
    )
    return one, 0.5 * (low + high), np.hypot((high - low) / 2, beside)


def copies(joint, levers, count):
    """Print how many intervals of the joint fit hold in simulated copies of the experiment."""
    rng = np.random.default_rng(0)
    errors, of = np.asarray(joint.residuals[0]), np.array(joint.model.body_names)
    clean = np.asarray(joint.model.records.readings[0].values) - errors
    rows = {name: throws.levers(name) for name in levers}
    truth = {n: log_moments(n, joint.body[n].tensor, joint.body, levers) for n in TRUTH}
    held, reaches = [], []
    for _ in range(count):
        readings = clean.copy()
        for name in levers:
            mine = np.flatnonzero(of == name)
            sign = rng.choice([-1.0, 1.0], mine.size)[:, None, None]
            readings[mine] += sign * errors[rng.permutation(mine)]
        problem = eqx.tree_at(
            lambda p: p.records.readings[0].values, joint.model, jnp.asarray(readings)
        )
        found = identify.fit(problem, starts=1, initial=joint.x)
        scattered = {
            n: levers[n] + rng.multivariate_normal(np.zeros(3), np.cov(r.T), len(r))
            for n, r in rows.items()
        }
        middle = {n: jnp.asarray(np.median(r, axis=0)) for n, r in scattered.items()}
        ends = {n: of_all(n, found, middle, scattered) for n in TRUTH}
        held.append([np.abs(ends[n][0] - truth[n]) <= ends[n][1] for n in TRUTH])
        reaches.append([ends[n][1] for n in TRUTH])
    print(f"of {count} copies {100 * np.mean(held):.1f} % of {np.size(held)} intervals hold")
    for k, name in enumerate(TRUTH):
        each = np.mean(held, axis=0)[k], np.mean(reaches, axis=0)[k]
        print(f"  {name}: {np.round(100 * each[0], 1)} %, ±% {np.round(100 * each[1], 2)}")


def show(name, errors, reach):
    held = np.abs(errors) <= reach
    size = 100 * np.abs(errors)
    print(
        f"{name}: mean |error| {size.mean():.2f} %, worst {size.max():.2f} %; 95 % intervals (mean "
        f"±{100 * reach.mean():.2f} %) hold {held.sum()} of {held.size}"
    )
    return held


def given(every, end):
    """Recordings of each body, and levers."""
    records = {name: [record(path, every, end) for path in throws.paths(name)] for name in MASSES}
    levers = {name: jnp.asarray(throws.lever(name)) for name in MASSES}
    return records, levers


def main(every=1, end=0.53, laws=(), whole=False, count=0):
    """Print the figures; returns them: errors of single throws, which intervals hold."""
    records, levers = given(every, end)
    began = time.perf_counter()
    joint = together(records)
    print(f"{joint.model.count} throws together: {time.perf_counter() - began:.1f} s")
    print(f"status: {joint.status}")
    for name, value in joint.values.items():
        if name in ("bias", "scale", "skew", "tilt"):
            print(f"  {name}", np.array2string(np.asarray(value), precision=4))
    factor = factor_of(joint.body[PROOF].tensor, joint.body[DEVICE].tensor, levers)
    print(f"  the wheel's inertia times {factor:.4f}; noise {np.unique(joint.noise[0]).round(4)}")
    together_held, alone_held, all_errors = [], [], []
    if count:
        return copies(joint, levers, count)
    for name, truth in TRUTH.items():
        middle, reach = of_all(name, joint, levers)
        error = middle - np.log(truth)
        together_held.append(show(f"{name}, together", error, reach))
        print(f"  errors % {np.round(100 * error, 2)}, 95 % ±% {np.round(100 * reach, 2)}")
        errors, reaches, words = [], [], []
        beside = shared(joint, levers, name, joint.body[name].tensor)
        for row in range(len(records[name])):
            one, middle, reach = judged(name, row, joint, levers, beside)
            errors.append(middle - np.log(truth))
            reaches.append(reach)
            words.append(one.explanation.word)
        print("  status:", ", ".join(f"{words.count(word)} {word}" for word in sorted(set(words))))
        alone_held.append(
            show(f"{name}, {len(errors)} throws", np.array(errors), np.array(reaches)).ravel()
        )
        all_errors.append(np.abs(errors).ravel())
    found = summary(all_errors, alone_held, together_held, "the joint fit")
    for law in laws:
        throws_with_torque(law, joint, records, levers, whole)
    return found


if __name__ == "__main__":
    words, count = sys.argv[1:], 0
    if "--copies" in words:
        at = words.index("--copies")
        count = int(words[at + 1])
        del words[at : at + 2]
    numbers = [text for text in words if not text.startswith("--")]
    main(
        *(kind(text) for kind, text in zip((int, float), numbers, strict=False)),
        laws=[text[2:] for text in words if text in ("--white", "--correlated")],
        whole="--whole" in words,
        count=count,
    )
