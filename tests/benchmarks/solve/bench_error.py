"""Is the error that a run states its true one? Random scenes of every class, the truth in more digits.

    python tests/benchmarks/solve/bench_error.py [--scenes 200] [--seed 0] [--what states,gradients,accuracy,cost] [--only top,orbit]

Scenes: free bodies of every class (closed form, and by steps; a third beside the middle axis), heavy
tops, sleeping tops that pass the vertical, gravity gradient, wheels, damping, pulses with jumps; 1 to
1e4 rad/s, 1 to 1000 turns; orbits past the second of two primaries. Tolerances 1e-4 to 1e-13, float64
and float32. Truth: `systems/extrapolated.c` (64 bits of mantissa; 113 for the closed form and for gradients,
by differences). Scenes whose own truth is not four times surer than the error are left out, and counted.
A scene is in the regime of steps where its stated error of steps exceeds that of round-off three times.
"""

import argparse
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))
jax.config.update("jax_enable_x64", True)
from systems import extrapolated

import rigidjax as rj

CLASSES = (
    "free",
    "free by steps",
    "top",
    "vertical",
    "gradient",
    "wheel",
    "damped",
    "pulses",
    "orbit",
)
LANES = 50


def unit(a):
    return a / np.linalg.norm(a, axis=1)[:, None]


def tensors(rng, n):
    """Any tensor a body can have: generic, two equal, all equal, flat, slender."""
    second, kind = rng.dirichlet([1, 1, 1], n), rng.integers(0, 6, n)
    second[kind == 1, 1] = second[kind == 1, 0]
    second[kind == 2] = 1 / 3
    second[kind == 3, 2] *= 1e-3
    second[kind == 4, 1:] *= 1e-2
    moments = second.sum(1)[:, None] - second
    axes = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    found = np.einsum("nij,nj,nkj->nik", axes, moments, axes)
    return (found + found.transpose(0, 2, 1)) / 2


def draw(kind, rng, n, turns=1000.0):
    """The numbers of n scenes, by the names of `extrapolated.ROW`, and their starts."""
    if kind == "orbit":
        mu, near = 10 ** rng.uniform(-3, -0.4, n), 10 ** rng.uniform(-1.3, -0.3, n)
        side = unit(rng.normal(size=(n, 3)) * [1, 1, 0.3])
        v = rng.normal(size=(n, 3))
        v = unit(v - np.sum(v * side, 1)[:, None] * side * rng.uniform(0, 1, n)[:, None])
        x = near[:, None] * side + np.stack([1 - mu, 0 * mu, 0 * mu], 1)
        v = v * (np.sqrt(mu / near) * rng.uniform(0.3, 1.35, n))[:, None]
        return {"mu": mu, "time": 10 ** rng.uniform(-0.5, 1.3, n)}, np.concatenate([x, v], 1)
    rate, none = 10 ** rng.uniform(0, 4, n), np.zeros(n)
    omega, q, tensor = unit(rng.normal(size=(n, 3))), unit(rng.normal(size=(n, 4))), tensors(rng, n)
    out = {
        "time": 2 * np.pi * turns ** rng.uniform(0, 1, n) / rate,
        "gravity": np.stack([none, none, -(rate**2)], 1),
    }
    if kind.startswith("free"):
        del out["gravity"]
        middle = np.linalg.eigh(tensor)[1][:, :, 1] + 10 ** rng.uniform(
            -6, -1, (n, 1)
        ) * rng.normal(size=(n, 3))
        omega = np.where(rng.random((n, 1)) < 0.3, unit(middle), omega)
    elif kind == "vertical":
        moments = 10 ** rng.uniform(-0.5, 0.5, (n, 2))
        tensor = np.stack([np.diag([a, a, min(b, 1.9 * a)]) for a, b in moments])
        tilt, side = 10 ** rng.uniform(-6, 0, n), rng.uniform(0, 7, n)
        q = np.stack(
            [
                np.cos(tilt / 2),
                np.sin(tilt / 2) * np.cos(side),
                np.sin(tilt / 2) * np.sin(side),
                none,
            ],
            1,
        )
        omega = np.stack([*(0.3 * tilt * rng.normal(size=(2, n))), rng.choice([-1.0, 1.0], n)], 1)
        out["com"] = np.stack([none, none, 10 ** rng.uniform(-2, 0, n)], 1)
    elif kind == "gradient":
        del out["gravity"]
        out |= {
            "gradient": rate**2 * 10 ** rng.uniform(-3, 0, n),
            "towards": unit(rng.normal(size=(n, 3))),
        }
    else:
        out["com"] = 0.3 * rng.normal(size=(n, 3)) * 10 ** rng.uniform(-3, 0.3, (n, 1))
    if kind == "wheel":
        out["wheel"] = 0.5 * rng.normal(size=(n, 3)) * rate[:, None]
    if kind == "damped":
        out["damping"] = (
            np.abs(rng.normal(size=(n, 3))) * (10 ** rng.uniform(-3, 0, n) / out["time"])[:, None]
        )
    if kind == "pulses":
        out["edges"] = np.sort(rng.uniform(0, 1, (n, 7)), 1) * out["time"][:, None]
        out["torques"] = rng.normal(size=(n, 6, 3)) * (rate / out["time"])[:, None, None]
    return {"tensor": tensor, **out}, np.concatenate([q, omega * rate[:, None]], 1)


def scene(p, start):
    """What `simulate` takes of one scene."""
    if "tensor" not in p:
        return None, rj.Point(start[:3], start[3:]), rj.orbits.cr3bp(p["mu"])
    laws, t = [], rj.torques
    if "com" in p:
        laws.append(t.HeavyTop(1.0, p["com"], p["gravity"]))
    if "gradient" in p:
        laws.append(t.GravityGradient(p["gradient"], p["towards"]))
    if "wheel" in p:
        laws.append(t.Flywheel(p["wheel"]))
    if "damping" in p:
        laws.append(t.Damping(p["damping"]))
    if "edges" in p:
        laws.append(t.Pulses(p["edges"], p["torques"]))
    law = None if not laws else laws[0] if len(laws) == 1 else t.Sum(*laws)
    return rj.Inertia(p["tensor"]), rj.Attitude(start[:4], start[4:]), law


def run(kind, p, start, **how):
    solver = rj.solvers.DormandPrince8() if kind == "free by steps" else None
    body, state, law = scene(p, start)
    ts = jnp.stack([0 * p["time"], p["time"]])
    return rj.simulate(body, state, ts, law, solver=solver, throw=False, **how)


def last(sol):
    return jnp.concatenate([leaf[-1] for leaf in jax.tree.leaves(sol.ys)])


def apart(ends, truth, low):
    """Turn (rad) or place, and rate or velocity (n, 2), of states from a truth in two doubles."""
    ends, truth = np.asarray(ends, np.longdouble), np.asarray(truth, np.longdouble) + low
    if ends.shape[1] == 6:
        parts = ends[:, :3] - truth[:, :3], ends[:, 3:] - truth[:, 3:]
        return np.stack([np.sqrt(np.sum(a * a, 1)) for a in parts], 1).astype(float)
    (w, *u), (a, *b) = ends[:, :4].T, truth[:, :4].T
    u, b = np.array(u), np.array(b)
    turn = a * u - w * b - np.cross(b, u, axis=0)
    angle = 2 * np.arctan2(np.sqrt(np.sum(turn**2, 0)), np.abs(a * w + np.sum(u * b, 0)))
    rate = ends[:, 4:] - truth[:, 4:]
    return np.stack([angle, np.sqrt(np.sum(rate**2, 1))], 1).astype(float)


def batched(f, *args):
    """f of each scene, in lanes of like length."""
    many = len(jax.tree.leaves(args)[0])
    f = jax.jit(jax.vmap(f))
    cut = [jax.tree.map(lambda a: a[i : i + LANES], args) for i in range(0, many, LANES)]
    return [
        np.concatenate(parts)
        for parts in zip(*[jax.device_get(f(*part)) for part in cut], strict=True)
    ]


def drawn(kind, n, seed, dtype, turns=1000.0):
    rng = np.random.default_rng([seed, CLASSES.index(kind)])
    p, start = draw(kind, rng, n, turns)
    length = p["time"] * (np.linalg.norm(start[:, 4:], axis=1) if "tensor" in p else 1)
    order = np.argsort(length)
    p = {name: a[order].astype(dtype) for name, a in p.items()}
    return rng, p, start[order].astype(dtype), length[order]


def sized(truth):
    half = 3 if truth.shape[1] == 6 else 4
    first = np.ones(len(truth)) if half == 4 else np.linalg.norm(truth[:, :3], axis=1)
    return np.stack([first, np.linalg.norm(truth[:, half:], axis=1)], 1)


def tolerances(rng, n, dtype):
    found = 10 ** (rng.uniform(-13, -4, n) if dtype == np.float64 else rng.uniform(-5.5, -3, n))
    return np.maximum(found, 100 * np.finfo(dtype).eps).astype(dtype)


def tally(table, name, words, steps, off, true, sure, lengths):
    """Adds ratios to the table, and prints each scene that is outside of a factor of two."""
    stated = np.hypot(steps, off)
    ratio = stated / np.maximum(true, 1e-300)
    above = steps > 3 * off
    table.append((name, ratio[sure & above], ratio[sure & ~above], np.sum(~sure)))
    odd = sure & ((ratio < 0.5) | (above & (ratio > 2)))
    for i in np.argwhere(odd):
        i = tuple(i)
        print(
            f"  {name}: {words[i[0]]}, {lengths[i[0]]:.3g} rad: true {true[i]:.2g}, steps {steps[i]:.2g}, round-off {off[i]:.2g}"
        )


def states(kind, n, seed, dtype, table):
    rng, p, start, lengths = drawn(kind, n, seed, dtype)
    rtol = tolerances(rng, n, dtype)

    def one(p, start, rtol):
        sol = run(kind, p, start, rtol=rtol, atol=1e-3 * rtol)
        error = sol.error
        names = ("q", "omega") if "tensor" in p else ("x", "v")
        steps, off = (
            jnp.stack([part[name][-1] for name in names]) for part in (error.steps, error.round_off)
        )
        return last(sol), steps, off, error.lost[-1]

    ends, steps, off, lost = batched(one, p, start, rtol)
    quad = kind == "free" and dtype == np.float64
    truth, low = extrapolated.ends(p, start, quad=quad)
    again = extrapolated.ends(p, start, quad=quad, tol=1e-20 if quad else 6e-17)
    true, unsure = apart(ends, truth, low), apart(again[0], truth, low - again[1])
    alive = (np.all(true < 0.3 * sized(truth), 1) & ~lost)[:, None]
    wrongly = np.sum(~lost & np.any(true > sized(truth), 1))
    words = [f"rtol {r:.1e}" for r in rtol]
    sure = alive & (true > 4 * unsure) & np.isfinite(steps + off)
    tally(table, f"{kind}, {dtype.__name__}", words, steps, off, true, sure, lengths)
    print(
        f"  {kind}, {dtype.__name__}: lost {np.sum(~alive)}, of these not said {wrongly}",
        flush=True,
    )


def gradients(kind, n, seed, dtype, table):
    """Of one number of the last state, by tensor, start and, of an orbit, μ."""
    rng, p, start, lengths = drawn(kind, n, seed, dtype, 10.0)
    rtol = tolerances(rng, n, dtype)
    along = rng.normal(size=start.shape)
    free = "tensor" if "tensor" in p else "mu"

    def one(p, start, rtol, along):
        def f(x, **tolerances):
            moved = {**p, free: x[free]}
            if free == "tensor":
                moved[free] = 0.5 * (x[free] + x[free].T)
            return along.astype(start.dtype) @ last(run(kind, moved, x["start"], **tolerances))

        found = rj.error_of(f, {free: p[free], "start": start}, rtol=rtol, atol=1e-3 * rtol)
        parts = found.derivative, found.derivative_error
        return *(jnp.concatenate([a["start"], jnp.ravel(a[free])]) for a in parts), found.known

    found, stated, known = batched(one, p, start, rtol, along)
    true = np.full_like(found, np.nan, dtype=float)
    size = start.shape[1]
    places = [(None, i) for i in range(size)]
    places += [(i, j) for i in range(3) for j in range(3)] if free == "tensor" else [(0, 0)]
    for column, (i, j) in enumerate(places):
        sides, ways = [], []
        for sign in (1, -1):
            moved, begun = {k: a.astype(np.float64) for k, a in p.items()}, start.astype(np.float64)
            if i is None:
                begun[:, j] += sign * 3e-12 * np.abs(begun[:, :4] if j < 4 else begun[:, 4:]).max(1)
                ways.append(begun[:, j])
            elif free == "tensor":
                pair = 0.5 * (moved[free][:, i, j] + moved[free][:, j, i])
                moved[free][:, i, j] = moved[free][:, j, i] = pair + sign * 3e-12 * np.abs(
                    moved[free]
                ).max((1, 2))
                ways.append(moved[free][:, i, j] * (1 if i == j else 2))
            else:
                moved[free] = moved[free] * (1 + sign * 3e-12)
                ways.append(moved[free])
            sides.append(extrapolated.ends(moved, begun, quad=True, tol=1e-25))
        # The numbers that were taken, not those that were meant; what two doubles differ by is exact.
        (high, low), (high2, low2) = sides
        change = np.sum(along * ((high - high2) + (low - low2)), 1)
        true[:, column] = change / (ways[0] - ways[1])
    norm = lambda a: np.linalg.norm(np.asarray(a, float), axis=1)[:, None]
    wrong, size = norm(found - true), norm(true)
    # Differences of 3e-12, in 113 bits.
    sure = (wrong < 0.3 * size) & (wrong > 3e-16 * size) & known[:, None]
    words = [f"rtol {r:.1e}" for r in rtol]
    # The regime by the tolerance: a function's error has its parts together.
    fine = (rtol[:, None] > 1e5 * np.finfo(dtype).eps) & (kind != "free")
    parts = np.where(fine, norm(stated), 0), np.where(fine, 0, norm(stated))
    tally(table, f"gradient of {kind}, {dtype.__name__}", words, *parts, wrong, sure, lengths)


def accuracies(kind, n, seed, dtype, table):
    rng, p, start, lengths = drawn(kind, n, seed, dtype)
    asked = 10 ** (rng.uniform(-12, -3, n) if dtype == np.float64 else rng.uniform(-5, -2, n))
    asked = asked.astype(dtype)

    def one(p, start, asked):
        sol = run(kind, p, start, accuracy=asked)
        error = sol.error
        return (
            last(sol),
            error.relative[-1],
            jnp.max(jnp.stack([error.round_off[k][-1] / error.sizes[k] for k in error.sizes])),
        )

    ends, stated, off = batched(one, p, start, asked)
    truth, low = extrapolated.ends(p, start)
    true = np.max(apart(ends, truth, low) / sized(truth), 1)
    yes, had = stated <= asked, true <= asked
    table.append(
        (
            f"{kind}, {dtype.__name__}",
            yes & had,
            yes & ~had,
            ~yes & had,
            ~yes & had & (off < 0.1 * asked),
            (stated / np.maximum(true, 1e-300))[yes & (off < 0.1 * stated)],
        )
    )
    for i in np.flatnonzero(yes & ~had | ~yes & had & (off < 0.1 * asked)):
        print(
            f"  {kind}, {dtype.__name__}: asked {asked[i]:.1e}, stated {stated[i]:.1e}, true {true[i]:.1e}, {lengths[i]:.3g} rad"
        )


def costs(kind, n, seed, dtype, table):
    """CPU time of each scene alone: `sol.error` over a run, an accuracy over the best tolerance."""
    rng, p, start, _ = drawn(kind, n, seed, dtype)
    rtol = tolerances(rng, n, dtype)
    asked = 10 ** (rng.uniform(-12, -3, n) if dtype == np.float64 else rng.uniform(-5, -2, n))
    plain = jax.jit(lambda p, y, rtol: last(run(kind, p, y, rtol=rtol, atol=1e-3 * rtol)))

    @jax.jit
    def with_error(p, start, rtol):
        sol = run(kind, p, start, rtol=rtol, atol=1e-3 * rtol)
        return last(sol), sol.error.total

    @jax.jit
    def to(p, start, asked):
        sol = run(kind, p, start, accuracy=asked)
        return last(sol), sol.error.relative[-1]

    def timed(f, *args):
        jax.block_until_ready(f(*args))
        spans = []
        for _ in range(3):
            begun = time.process_time()
            out = jax.block_until_ready(f(*args))
            spans.append(time.process_time() - begun)
        return min(spans), out

    grid = np.maximum(10 ** -np.arange(2.0, 14.0, 0.25), 20 * np.finfo(dtype).eps).astype(dtype)
    truth, low = extrapolated.ends(p, start)
    ratios, reached = [], []
    for i in range(n):
        mine, begin = {name: a[i] for name, a in p.items()}, start[i]
        ratios.append(
            timed(with_error, mine, begin, rtol[i])[0] / timed(plain, mine, begin, rtol[i])[0]
        )
        ends = np.stack([plain(mine, begin, tolerance) for tolerance in grid])
        true = np.max(apart(ends, truth[i : i + 1], low[i : i + 1]) / sized(truth)[i], 1)
        if not (had := true <= asked[i]).any():
            continue
        best, _ = timed(plain, mine, begin, grid[np.argmax(had)])
        span, (_, stated) = timed(to, mine, begin, dtype(asked[i]))
        if stated <= asked[i]:
            reached.append(span / best)
    table.append((f"{kind}, {dtype.__name__}", np.array(ratios), np.array(reached)))


def show_costs(what, table):
    print(
        "\n| cost, median and quartiles | `sol.error` over a run | an accuracy over the best tolerance |"
    )
    print("| --- | --- | --- |")
    table.append(("all", *(np.concatenate([row[i] for row in table]) for i in (1, 2))))
    for name, *parts in table:
        three = [
            "{1:.2f} ({0:.2f}–{2:.2f})".format(*np.quantile(part, [0.25, 0.5, 0.75]))
            if part.size
            else "–"
            for part in parts
        ]
        print(f"| {name} | " + " | ".join(three) + " |")


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scenes", type=int, default=200, help="of each class and dtype")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--what", default="states,gradients,accuracy")
    parser.add_argument("--only", default=",".join(CLASSES))
    given = parser.parse_args()
    for what in given.what.split(","):
        table, begun = [], time.perf_counter()
        doing = {
            "states": states,
            "gradients": gradients,
            "accuracy": accuracies,
            "cost": costs,
        }[what]
        for dtype in (np.float64, np.float32):
            for kind in given.only.split(","):
                if what not in ("accuracy", "cost") or kind != "free":
                    doing(kind, given.scenes, given.seed, dtype, table)
        show = {"accuracy": show_accuracy, "cost": show_costs}.get(what, show_ratios)
        show(what, table)
        print(
            f"({what}: {given.scenes} scenes of each row, {time.perf_counter() - begun:.0f} s)\n",
            flush=True,
        )


def show_ratios(what, table):
    print(
        f"\n| {what} | steps: numbers | median | within 2 | ≥ half | round-off: numbers | median | ≥ half | left out |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    table.append(
        (
            "all",
            *(np.concatenate([row[i] for row in table]) for i in (1, 2)),
            sum(row[3] for row in table),
        )
    )
    for name, above, below, left in table:
        share = lambda a, what: f"{100 * np.mean(what(a)):.2f} %" if a.size else "–"
        middle = lambda a: f"{np.median(a):.2f}" if a.size else "–"
        half = share(above, lambda a: a >= 0.5), share(below, lambda a: a >= 0.5)
        within = share(above, lambda a: (a >= 0.5) & (a <= 2))
        print(
            f"| {name} | {above.size} | {middle(above)} | {within} | {half[0]} | {below.size} | {middle(below)} | {half[1]} | {left} |"
        )


def show_accuracy(what, table):
    print(
        "\n| accuracy | said yes, and so | said yes, not so | said no, was had | of these 10 times above round-off | stated over true, median and quartiles |"
    )
    print("| --- | --- | --- | --- | --- | --- |")
    table.append(("all", *(np.concatenate([row[i] for row in table]) for i in range(1, 6))))
    for name, *parts, ratios in table:
        three = np.quantile(ratios, [0.25, 0.5, 0.75]) if ratios.size else np.full(3, np.nan)
        counts = " | ".join(str(np.sum(part)) for part in parts)
        print(f"| {name} | {counts} | " + "{1:.1f} ({0:.1f}–{2:.1f}) |".format(*three))


if __name__ == "__main__":
    main()
