"""A second way for motions: the closed form at 40 digits, SciPy's DOP853, Taylor's textbook."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
from exact import twin
from scipy.integrate import solve_ivp
from scipy.integrate._ivp.dop853_coefficients import A as DOP_A, B as DOP_B
from surface import values as v
from surface.values import between, leave_out, way
from surface.values_numbers import series

import rigidjax as rj
from rigidjax import torques as laws
from rigidjax.motion.equations import AttitudeEquations
from rigidjax.solve import adaptive, fixed as fixed_steps, solvers

# The free body: moments of every kind, rates about and near each axis, on the separatrix, at rest.


def spinning(rng, i):
    """Inertia (3, 3), Ω and a time together: what is near an axis knows the axes."""
    unstable = i % 8 in (3, 4)
    s = v.moments(rng, i % 6)
    j = s.sum() - s
    order = np.argsort(j)
    a, b, c = j[order]
    w = rng.normal(size=3)
    kind = i % 8
    if kind in (1, 2, 3):
        w *= 10.0 ** rng.uniform(-12, -2)
        w[order[(0, 2, 1)[kind - 1]]] = 1.0
    elif kind == 4 and a < b < c:
        w[order[2]] = w[order[0]] * np.sqrt(a * (b - a) / (c * (c - b)))
    elif kind == 5:
        w *= 10.0 ** rng.uniform(-20, 20)
    elif kind == 6:
        w[:] = 0.0
    size = np.linalg.norm(w) or 1.0
    turns = 10.0 ** rng.uniform(-3, 1 if unstable else 6) * rng.choice([-1, 1])
    r = np.eye(3) if i % 3 == 2 else v.matrix(rng, 0)
    return symmetric(r @ np.diag(j) @ r.T), r @ w, turns / size


def symmetric(a):
    return (a + a.T) / 2


def free(i, w, t, q):
    at, omega = twin.free_body(mp.matrix(i.tolist()), list(q), list(w), t)
    return [np.array(at), np.array(omega)] * 4 + [np.array(omega)]


def our_free(i, w, t, q):
    body, start = rj.Inertia(i), rj.Attitude(q, w)
    solved = dfx.diffeqsolve(
        dfx.ODETerm(AttitudeEquations(body)), rj.solvers.FreeSolver(), 0.0 * t, t, t, start,
        saveat=dfx.SaveAt(t1=True), adjoint=dfx.ForwardMode(), max_steps=2,
    ).ys  # fmt: skip
    return [
        rj.exact.free_body(body, start, t), rj.exact.FreeBody(body, start)(t),
        jax.tree.map(lambda x: x[1], rj.exact.FreeBody(body, start).at(jnp.stack([0 * t, t]))),
        jax.tree.map(lambda x: x[0], solved), rj.exact.free_body(body, rj.Spin(w), t),
    ]  # fmt: skip


way(
    "exact.free_body exact.FreeBody exact.FreeBody.at solve.solvers.FreeSolver", our_free,
    (spinning, v.quaternion), free,
    norm=True, cost=0.5,
)  # fmt: skip


def periods(i, w):
    """Landau and Lifshitz, eqs 37.8 to 37.13, and the precession by an integral of its rate."""
    j, axes = v.eigen(i)
    w = axes.T @ w
    energy, square = v.dot(w, j * w), v.dot(j * w, j * w)
    if square < energy * j[1]:
        j, w = j[::-1], w[::-1]
    a, b, c = j
    m = (b - a) * (energy * c - square) / ((c - b) * (square - energy * a))
    rate = mp.sqrt((c - b) * (square - energy * a) / (a * b * c))
    top = (square - energy * a) / (c * (c - a))
    k = mp.ellipk(m)

    def turned(x):
        dn = 1 - m * mp.sin(x) ** 2
        along = c * c * top * dn
        return (energy - along / c) / (square - along) / mp.sqrt(dn)

    mean = mp.sqrt(square) * mp.quad(turned, [0, mp.pi / 2]) / k
    return [4 * k / rate, 2 * mp.pi / mean]


def tumbling(rng, i):
    """Of no symmetry, not near the separatrix or an axis."""
    s = (
        np.sort(rng.uniform(0.3, 1.0, 3))
        * [0.7, 1.0, 1.3]
        * 10.0 ** (rng.uniform(-20, 20) * (i % 2))
    )
    j = np.diag(s.sum() - s)
    w = rng.normal(size=3) * ([1.0, 0.1, 0.1] if i % 2 else [0.1, 0.1, 1.0])
    w = w * 10.0 ** (rng.uniform(-20, 20) * (i % 3 == 2))
    r = v.matrix(rng, 0)
    return symmetric(r @ j @ r.T), r @ w


way(
    "exact.body_period exact.precession_period",
    lambda i, w: (
        rj.exact.body_period(rj.Inertia(i), w), rj.exact.precession_period(rj.Inertia(i), w)),
    tumbling, periods, norm=True,
)  # fmt: skip

# Forced motion: SciPy on the equations, written out here.
TS = np.array([0.0, 0.4, 1.1, 2.0])


def textbook(force, i, x, u, q, w, ts=TS, m=1.0, rtol=1e-13):
    """Newton and Euler, in world and body axes; `force(t, r, x, u, w)` gives F and τ."""
    inverse = np.linalg.inv(i)

    def slope(t, y):
        x, u, q, w = y[:3], y[3:6], y[6:10], y[10:]
        a, b, c, d = q / np.linalg.norm(q)
        r = np.array([
            [1 - 2 * (c * c + d * d), 2 * (b * c - a * d), 2 * (b * d + a * c)],
            [2 * (b * c + a * d), 1 - 2 * (b * b + d * d), 2 * (c * d - a * b)],
            [2 * (b * d - a * c), 2 * (c * d + a * b), 1 - 2 * (b * b + c * c)],
        ])  # fmt: skip
        push, torque = force(t, r, x, u, w)
        a, b, c, d = q
        e, f, g = w
        dq = [
            -b * e - c * f - d * g,
            a * e + c * g - d * f,
            a * f + d * e - b * g,
            a * g + b * f - c * e,
        ]
        return np.concatenate(
            [u, push / m, np.array(dq) / 2, inverse @ (np.cross(i @ w, w) + torque)]
        )

    y0 = np.concatenate([x, u, q, w])
    found = solve_ivp(slope, (ts[0], ts[-1]), y0, "DOP853", ts, rtol=rtol, atol=1e-15)
    y = found.y.T
    q = y[:, 6:10] / np.linalg.norm(y[:, 6:10], axis=1)[:, None]
    return [y[:, :3], y[:, 3:6], q, y[:, 10:]]


def mild(rng, i):
    """An inertia of order one: what is stiff is another test's."""
    s = np.diag(rng.uniform(0.3, 1.0, 3))
    r = v.matrix(rng, 0)
    s = r @ s @ r.T
    return np.trace(s) * np.eye(3) - 0.5 * (s + s.T)


TOP = (mild, v.quaternion, v.ordinary, v.ordinary, between(0.1, 0.5, 3))
ZERO = np.zeros(3)


def top_force(c, d):
    return lambda t, r, x, u, w: (ZERO, np.cross(c, r.T @ np.array([0, 0, -9.8])) - d * w)


def law_of(c, d):
    return laws.Sum(laws.HeavyTop(1.0, c, [0.0, 0.0, -9.8]), laws.Damping(d))


def our_tops(solver, tight=1e-11):
    def run(i, q, w, c, d):
        out = rj.simulate(
            rj.Inertia(i), rj.Attitude(q, w), TS, law_of(c, d), solver=solver, rtol=tight,
            atol=1e-14, throw=False,
        )  # fmt: skip
        return out.ys

    return run


def tops(i, q, w, c, d):
    return textbook(top_force(c, d), i, ZERO, ZERO, q, w)[2:]


# Errors of an adaptive run add up over its steps, some dozens, each below the tolerance.
for names, solver in (
    ("simulate solve.solvers.DormandPrince8 solve.Solution", None),
    ("simulate solve.solvers.Tsitouras5", solvers.Tsitouras5()),
    ("solve.solvers.Projected", rj.solvers.Projected(dfx.Dopri8())),
):
    way(f"{names}", our_tops(solver), TOP, tops, plain=True, rtol=1e-9, cost=2)


def far(i, q, w, c, d):
    """Between the saved times, and the laws with states: a wheel whose motor is constant."""
    ts = np.array([0.0, 0.7, 1.3])
    whole = textbook(top_force(c, d), i, ZERO, ZERO, q, w, ts)
    return [whole[2][1], whole[3][1]]


way(
    "solve.Solution.evaluate",
    lambda i, q, w, c, d: rj.simulate(
        rj.Inertia(i), rj.Attitude(q, w), TS, law_of(c, d), rtol=1e-11, atol=1e-14, throw=False,
    ).evaluate(0.7),
    TOP, far, plain=True, rtol=1e-9, cost=2,
)  # fmt: skip


# A Rigid under drag and gravity.
def fallen(s, x, u, q, w, c):
    i = np.trace(s) * np.eye(3) - s

    def force(t, r, x, u, w):
        drag = -0.3 * np.linalg.norm(u) * u
        return drag + 2.0 * np.array([0, 0, -9.8]), np.cross(c, r.T @ drag)

    return textbook(force, i, x, u, q, w, m=2.0)


way(
    "simulate (Rigid)",
    lambda s, x, u, q, w, c: rj.simulate(
        rj.MassProperties(2.0, jnp.zeros(3), s), rj.Rigid(x, u, q, w), TS,
        laws.Sum(laws.UniformGravity([0.0, 0, -9.8]), laws.Drag(0.3, c)), rtol=1e-11, atol=1e-14,
        throw=False,
    ).ys,
    (lambda rng, i: 0.5 * np.trace(m := mild(rng, i)) * np.eye(3) - m, v.ordinary, v.ordinary,
     v.quaternion, v.ordinary, v.ordinary),
    fallen, plain=True, rtol=1e-9, cost=2,
)  # fmt: skip


# Fixed steps by the textbook: stages of a tableau, the quaternion made unit after each step.
def stepped(a, b, number, step):
    def run(i, q, w, c, d):
        def slope(q, w):
            # Of a stage, whose q is not unit: the polynomial of a unit one.
            turned = v.eye() - 2 * q[0] * v.hat(q[1:]) + 2 * v.hat(q[1:]) @ v.hat(q[1:])
            g = turned @ np.array([0, 0, mp.mpf(-9.8)])
            return v.times(q, [0, *w]) / 2, v.solve(i, np.cross(i @ w, w) + np.cross(c, g) - d * w)

        for _ in range(number):
            ks = []
            for row in a:
                move = lambda y, n, row=row, ks=ks: (
                    y
                    + mp.mpf(step)
                    * sum((x * k[n] for x, k in zip(row, ks, strict=False) if x), 0 * y)
                )
                ks.append(slope(move(q, 0), move(w, 1)))
            q, w = (
                y + mp.mpf(step) * sum(x * k[n] for x, k in zip(b, ks, strict=True))
                for n, y in enumerate((q, w))
            )
            q = q / v.norm(q)
        return [q, w]

    return run


HALF = mp.mpf(1) / 2
KUTTA = (
    [[], [HALF], [0, HALF], [0, 0, 1]],
    [mp.mpf(1) / 6, mp.mpf(1) / 3, mp.mpf(1) / 3, mp.mpf(1) / 6],
)
_TSIT = dfx.Tsit5.tableau
TSIT = ([[], *[list(row) for row in _TSIT.a_lower[:-1]]], list(_TSIT.b_sol[:-1]))
DOP = ([list(row[:n]) for n, row in enumerate(DOP_A[:12])], list(DOP_B))


def our_steps(solver, number, step):
    def run(i, q, w, c, d):
        field = AttitudeEquations(rj.Inertia(i), law_of(c, d))
        ends = fixed_steps(
            solver, field, jnp.array([0.0, number * step]), rj.Attitude(q, w), number
        )
        states = jax.tree.map(lambda x: x[None], rj.Attitude(q, w))
        rolled = rj.batch.rollout(rj.Inertia(i), states, step, number, law_of(c, d), solver=solver)
        last = jax.tree.map(lambda x: x[-1], ends), jax.tree.map(lambda x: x[0], rolled)
        return last

    return run


for name, (a, b), solver in (
    ("RungeKutta4", KUTTA, solvers.RungeKutta4()),
    ("Tsitouras5", TSIT, solvers.Tsitouras5()),
    ("DormandPrince8", DOP, solvers.DormandPrince8()),
):
    run = stepped(a, b, 3, 0.125)
    # Published coefficients have their own digits: so many ulps of the sum of a step.
    way(
        f"solve.solvers.{name} solve.fixed batch.rollout", our_steps(solver, 3, 0.125), TOP,
        lambda *x, run=run: run(*x) * 2, norm=True, ulps=64, cost=2,
    )  # fmt: skip


# Splittings and Magnus: against the equations, at steps whose error is below the bar by theory.
def long_run(solver, law, second, steps, rtol, name):
    def run(i, q, w, c, d):
        field = AttitudeEquations(rj.Inertia(i), law(c, d))
        found = fixed_steps(solver, field, jnp.array([0.0, 1.0]), rj.Attitude(q, w), steps)
        return jax.tree.map(lambda x: x[-1], found)

    def right(i, q, w, c, d):
        found = textbook(second(c, d), i, ZERO, ZERO, q, w, np.array([0.0, 1.0]))
        return [found[2][-1], found[3][-1]]

    way(f"solve.solvers.{name}", run, TOP, right, plain=True, rtol=rtol, cost=2)


def gravity(c, d):
    return laws.HeavyTop(1.0, c, [0.0, 0.0, -9.8])


def gravity_force(c, d):
    return lambda t, r, x, u, w: (ZERO, np.cross(c, r.T @ np.array([0, 0, -9.8])))


# (rate · step)^order, with rates to ten, and a hundred for the derivatives of the torque.
for name, steps, order in (("Splitting2", 4000, 2), ("Splitting4", 400, 4), ("Splitting6", 200, 6)):
    long_run(
        getattr(solvers, name)(), gravity, gravity_force, steps, 100 * (10 / steps) ** order, name
    )
long_run(
    solvers.Magnus4(), lambda c, d: laws.Damping(d),
    lambda c, d: lambda t, r, x, u, w: (ZERO, -d * w), 400, 100 * (10 / 400) ** 4, "Magnus4",
)  # fmt: skip
leave_out(
    "diffrax's protocol of a solver, which `simulate` and `diffeqsolve` call: their rows",
    *(f"solve.solvers.{solver}.{what}" for solver in ("Magnus4", "RungeKutta4", "Tsitouras5",
      "DormandPrince8", "Splitting2", "Splitting4", "Splitting6")
      for what in ("order", "init", "step", "func")),
    *(f"solve.solvers.FreeSolver.{what}" for what in ("error_order", "func", "init", "order", "step")),
    "solve.solvers.ReplayAdjoint", "solve.solvers.ReplayAdjoint.loop",
    *(f"solve.solvers.Projected.{what}" for what in (
        "error_order", "func", "init", "order", "step", "strong_order", "term_structure",
        "interpolation_cls", "term_compatible_contr_kwargs", "scan_kind", "root_finder",
        "root_find_max_steps")),
)  # fmt: skip


# Many bodies: each by SciPy.
def pair(i, q, w, c, d):
    return [np.stack([i, 1.5 * i]), np.stack([q, q]), np.stack([w, -0.5 * w])]


def many(i, q, w, c, d):
    found = [
        textbook(top_force(c, d), *(a, ZERO, ZERO, b, e))[2:]
        for a, b, e in zip(*pair(i, q, w, c, d), strict=True)
    ]
    return [np.stack(x) for x in zip(*found, strict=True)] * 2


def our_many(i, q, w, c, d):
    bodies = rj.Inertia(jnp.stack([i, 1.5 * i]))
    states = rj.Attitude(jnp.stack([q, q]), jnp.stack([w, -0.5 * w]))
    out = rj.batch.simulate(bodies, states, TS, law_of(c, d), rtol=1e-11, atol=1e-14)
    each = jax.vmap(
        lambda body, y: (
            adaptive(
                solvers.DormandPrince8(),
                AttitudeEquations(body, law_of(c, d)),
                jnp.asarray(TS),
                y,
                rtol=1e-11,
                atol=1e-14,
            ).ys
        )
    )(bodies, states)
    return out.ys, each


way(
    "batch.simulate batch.Batch solve.adaptive", our_many, TOP, many, plain=True, rtol=1e-9, cost=4,
)  # fmt: skip
way(
    "batch.Steps batch.rollout (and one body after another)",
    lambda i, q, w, c, d: [
        rj.batch.simulate(bodies, states, rj.batch.Steps(0.125, 4), law_of(c, d)).ys
        for bodies, states in [(rj.Inertia(jnp.stack([i, 1.5 * i])), rj.Attitude(
            jnp.stack([q, q]), jnp.stack([w, -0.5 * w])))]
    ],
    TOP,
    lambda i, q, w, c, d: [
        np.stack(x)[:, None]
        for x in zip(*(
            stepped(*KUTTA, 4, 0.125)(a, b, e, c, d)
            for a, b, e in ((i, q, w), (3 * i / 2, q, -w / 2))), strict=True)
    ],
    norm=True, ulps=64, cost=4,
)  # fmt: skip


# Transition matrices, crossings, events: motions with a closed form.
def spread(j, d, w, t):
    """A ball that is slowed down: each rate by itself; free: turns of a turn."""
    ts = [0 * t, t]
    slow = [np.diag([mp.exp(-x * s / j) for x in d]) for s in ts]
    turned = []
    for s in ts:
        block = np.zeros((6, 6), object)
        block[:3, :3], block[3:, 3:] = series(-w * s, 0), v.eye()
        block[:3, 3:] = s * series(-w * s, 1)
        turned.append(block)
    return [np.stack(slow), np.stack(turned)]


def our_spread(j, d, w, t):
    ball, ts = rj.Inertia(j * jnp.eye(3)), jnp.stack([0.0 * t, t])
    tight = dict(rtol=1e-12, atol=1e-14, throw=False)
    return [
        rj.simulate(ball, rj.Spin(w), ts, laws.Damping(d), **tight).transition_matrix(),
        rj.simulate(ball, rj.Attitude(jnp.array([1.0, 0, 0, 0]), w), ts, throw=False
                    ).transition_matrix(),
    ]  # fmt: skip


way(
    "solve.Solution.transition_matrix", our_spread,
    (between(0.5, 2.0), between(0.1, 0.5, 3), v.ordinary, between(0.5, 2.0)), spread, rtol=1e-10,
    cost=2,
)  # fmt: skip


class Level:
    """Ω₁ at zero."""

    def __call__(self, t, state, body):
        return state.omega[0]


def circling(a, c, rate, spin, phase):
    """A symmetric top: Ω₁ = A cos(λt + φ), λ = (c − a)/a Ω₃: its zeros from 0 to where K are."""
    speed = (c - a) / a * spin
    first = (mp.pi / 2 - phase) / speed
    times = [first + k * mp.pi / speed for k in range(3)]
    w = [np.array([0 * rate, rate * (-1) ** k, spin]) for k in range(3)]
    # On the way down first, then up: of both and of those alone.
    return [np.array(times), np.stack(w), np.array(times[:1]), np.array(times[1:2]), times[0], w[0]]


def our_circling(a, c, rate, spin, phase):
    top = rj.Inertia.from_principal(a, a, c)
    start = rj.Spin(jnp.stack([rate * jnp.cos(phase), rate * jnp.sin(phase), spin]))
    end = 2.8 * jnp.pi / ((c - a) / a * spin)
    found = rj.crossings(top, start, 0.0, end, Level(), max_crossings=3)
    pushed = [
        rj.crossings(top, start, 0.0, end, Level(), laws.ConstantTorque(jnp.zeros(3)),
                     direction=way, max_crossings=1, rtol=1e-12, atol=1e-14).times
        for way in (-1, 1)
    ]  # fmt: skip
    out = rj.simulate(top, start, jnp.stack([0.0 * end, end]), event=rj.Event(Level()), throw=False)
    return found.times, found.states, *pushed, out.event_time, out.event_state


way(
    "crossings solve.Crossings Event", our_circling,
    (between(0.8, 1.0), between(1.3, 1.6), between(0.5, 2.0), between(1.0, 3.0), between(0.1, 1.4)),
    circling, rtol=1e-10, cost=2,
)  # fmt: skip


# Exponents of a linear field are its own, once the frame has turned to its axes: e^(-30) here.
def decay(t, y, args):
    return jnp.array([0.3, -0.2, -0.7]) * y


def exponents(x):
    return rj.lyapunov_exponents(
        decay, x, 40.0, intervals=80, transient=60, rtol=1e-11, atol=1e-13, max_steps=100
    ).values


way(
    "lyapunov_exponents solve.Exponents", exponents, between(0.1, 1.0, 3),
    lambda x: np.array([0.3, -0.2, -0.7]) + 0 * x, plain=True, rtol=1e-9, cost=2,
)  # fmt: skip
leave_out(
    "options of a compiler: no numbers",
    "batch.compiler_options",
    "set_xla_flags",
)
leave_out("shares of a run's own statistics: `drift` and `lyapunov_exponents` are rows",
          "solve.Solution.drift", "solve.Solution.growth")  # fmt: skip
leave_out("holds what the rows of `adaptive` and of `BodyInFrame` compare", "solve.AdaptiveRun",
          "frames.FrameWrench")  # fmt: skip
leave_out("a truth value beside `times`: the row of `crossings`", "solve.Crossings.full")
leave_out(
    "errors, held against true ones: tests/solve/answer/test_error.py",
    *("error_of", "solve.Error", "solve.FunctionError", "solve.FunctionError.known"),
    *(
        "solve.Solution.error",
        *(f"solve.Error.{n}" for n in ("known_until", "lost", "relative", "total")),
    ),
)
