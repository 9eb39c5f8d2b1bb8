"""Where methods fail, in pictures: `python tests/failures/gallery.py [FILE.png]`.

Error against the step in turns, the distance from the middle axis, the tolerance, the time of a
chaotic motion, the distance from gimbal lock and from half a turn. Figures are also printed.
"""

import sys
import warnings

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

from rigidjax.motion.equations import AttitudeEquations

jax.config.update("jax_enable_x64", True)

import rigidjax as rj
from rigidjax.solve import fixed

EQUAL = dfx.ConstantStepSize()


def angle(a, b):
    return float(rj.quaternion.angle(rj.quaternion.multiply(rj.quaternion.conjugate(a), b)))


class Nothing(rj.torques.AbstractTorque):
    feels = rj.motion.HasSpin
    rate_free = True

    def __call__(self, t, state, body):
        return jnp.zeros_like(state.omega)


def large_steps(axis):
    """D3, D19: 200 steps of a heavy top; error of the energy against h|Ω|."""
    body = rj.Inertia.from_principal(1.0, 1.8, 2.5)
    law = rj.torques.HeavyTop(1.0, [0.0, 0.1, 0.4], [0.0, 0.0, -1.0])
    field = AttitudeEquations(body, law)
    start = rj.Attitude([1.0, 0, 0, 0], [0.3, 0.5, 1.0])
    size = float(jnp.linalg.norm(start.omega))
    steps = np.logspace(-1.5, 1, 22) / size
    runs = {
        "RungeKutta4": lambda ts: fixed(rj.solvers.RungeKutta4(), field, ts, start, 2),
        "Tsitouras5": lambda ts: fixed(rj.solvers.Tsitouras5(), field, ts, start, 2),
        "DormandPrince8": lambda ts: fixed(rj.solvers.DormandPrince8(), field, ts, start, 2),
        "Splitting2": lambda ts: fixed(rj.solvers.Splitting2(), field, ts, start, 2),
        "Splitting4": lambda ts: fixed(rj.solvers.Splitting4(), field, ts, start, 2),
    }
    for name, run in runs.items():
        ready = jax.jit(lambda ts, run=run: rj.drift(ts, run(ts), body, law)["energy"])
        away = np.array([float(ready(2 * h * jnp.arange(101.0))) for h in steps])
        away[~np.isfinite(away)] = np.nan
        axis.loglog(steps * size, away, "o-", ms=3, label=name)
        broken = steps[~(away < 1)] * size
        first = f"{broken[0]:.2g}" if broken.size else "never"
        print(f"large steps, {name}: dE/E at h|Ω| ≈ 1: {away[np.argmin(abs(steps * size - 1))]:.1e}; "
              f"beyond 1 from {first}")  # fmt: skip
    axis.set(title="D3, D19: 200 steps of a heavy top", xlabel="h |Ω|, rad", ylabel="max |ΔE|/T")
    axis.legend(fontsize=7)


def middle_axis(axis):
    """D4: when the first flip comes, by tolerance and distance δ from the axis."""
    body = rj.Inertia.from_principal(1.0, 2.0, 3.0)
    deltas = np.array([1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-14])
    right = np.array(
        [9.4255178968436496622, 17.402483478546878418, 25.378872335690177766, 33.355261075340701009,
         41.331649814973493878, 49.308038554606284377, 57.284427294239074875]
    )  # fmt: skip

    def late(delta, t, torque, **how):
        start = rj.Spin(jnp.stack([jnp.zeros_like(delta), jnp.ones_like(delta), delta]))
        out = rj.simulate(body, start, jnp.stack([0 * t, t]), torque, throw=False, **how)
        omega = out.ys.omega[-1]
        return omega[1] / (omega[0] * omega[2])

    cases = {
        "closed form": (None, {}),
        "rtol = atol = 1e-6": (Nothing(), dict(rtol=1e-6, atol=1e-6)),
        "rtol 1e-6, atol 1e-16": (Nothing(), dict(rtol=1e-6, atol=1e-16)),
        "defaults, 1e-9, 1e-12": (Nothing(), {}),
        "rtol 1e-12, atol 1e-26": (Nothing(), dict(rtol=1e-12, atol=1e-26)),
    }
    for name, (law, how) in cases.items():
        found = jax.vmap(lambda d, t, law=law, how=how: late(d, t, law, **how))(
            jnp.asarray(deltas), jnp.asarray(right)
        )
        axis.loglog(deltas, np.maximum(np.abs(found), 1e-16), "o-", ms=3, label=name)
        print(f"middle axis, {name}: {np.array2string(np.abs(np.asarray(found)), precision=1)} s")
    axis.set(title="D4: error of the time of the first flip", xlabel="δ, rad/s", ylabel="s")
    axis.legend(fontsize=7)


def tolerances(axis):
    """D6: DETEST B5 against the tolerance, in both precisions."""
    scale = np.array([1 / np.sqrt(0.51 * 3), 1 / np.sqrt(0.51), 1 / np.sqrt(3)])
    c = np.array([scale[0], scale[1], scale[0] / scale[1]])
    right = np.array([-0.93965707987292039619, -0.34211777540007490653, 0.74141265961999530078])
    for dtype in (jnp.float64, jnp.float32):
        body = rj.Inertia(jnp.diag(jnp.array([2.0, 3.0, 1.0], dtype)))
        start = rj.Spin(jnp.asarray(np.array([0.0, 1.0, 1.0]) / c, dtype))
        rtols, away = 10.0 ** -np.arange(2, 15), []
        for rtol in rtols:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                out = rj.simulate(body, start, jnp.array([0.0, 20.0], dtype), Nothing(), rtol=float(rtol),
                                  atol=float(1e-3 * rtol))  # fmt: skip
            away.append(np.abs(c * np.asarray(out.ys.omega[-1], float) - right).max())
        axis.loglog(rtols, np.maximum(away, 1e-17), "o-", ms=3, label=np.dtype(dtype).name)
        print(f"tolerances, {np.dtype(dtype).name}: least {min(away):.1e}; at 1e-12 {away[10]:.1e}")
    axis.loglog(rtols, rtols, ":", color="0.6", label="error = rtol")
    axis.set(title="D6: DETEST B5 below round-off", xlabel="rtol asked for", ylabel="error of Ω")
    axis.invert_xaxis()
    axis.legend(fontsize=7)


def chaos(axis):
    """D14: gradients through a chaotic top, and the growth that says so."""
    body = rj.Inertia.from_principal(1.0, 1.6, 2.2)
    law = rj.torques.HeavyTop(1.0, [1.0, 0.4, 0.7], [0.0, 0.0, -1.0])
    q = np.array([0.29457358, 0.51677653, 0.16788989, 0.78611794])
    start = rj.Attitude(q / np.linalg.norm(q), [1.40904798, 2.72002574, -1.26857553])
    ts = jnp.linspace(0.0, 120.0, 13)

    def slopes(tol):
        def states(omega):
            return rj.simulate(
                body, rj.Attitude(start.q, omega), ts, law, rtol=tol, atol=1e-3 * tol,
                adjoint=dfx.ForwardMode(),
            ).ys.omega  # fmt: skip

        return np.asarray(jax.jit(jax.jacfwd(states))(start.omega))

    best = slopes(1e-13)
    for tol in (1e-6, 1e-9):
        away = np.linalg.norm(slopes(tol) - best, axis=(1, 2)) / np.linalg.norm(best, axis=(1, 2))
        axis.semilogy(ts[1:], away[1:], "o-", ms=3, label=f"gradient's error, rtol {tol:.0e}")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            grown = rj.simulate(body, start, ts, law, rtol=tol, atol=1e-3 * tol).growth
        axis.semilogy(ts[1:], np.asarray(grown)[1:] * tol, "--", label=f"growth × {tol:.0e}")
        gone = np.flatnonzero(np.asarray(grown) * tol > 1)
        said = f"warned from t = {float(ts[gone[0]]):g}" if gone.size else "no warning"
        bad = np.flatnonzero(away[1:] > 0.1)
        wrong = (
            f"wrong by 10 % from t = {float(ts[1 + bad[0]]):g}" if bad.size else "right throughout"
        )
        print(f"chaos, rtol {tol:.0e}: {wrong}; {said}")
    axis.axhline(1.0, color="0.6", lw=0.8)
    axis.set(title="D14: a chaotic top", xlabel="t, s", ylabel="relative", ylim=(1e-10, 1e6))
    axis.legend(fontsize=7)


def gimbal(axis):
    """R8: angles and back, near the pole of 3-1-3: the rotation is kept, the Jacobian grows."""
    gaps = np.logspace(-12, -0.5, 40)

    def back(gap):
        r = rj.euler.to_matrix(
            jnp.stack([jnp.asarray(0.4, gap.dtype), gap, jnp.asarray(0.3, gap.dtype)]), "ZXZ"
        )
        return jnp.abs(rj.euler.to_matrix(rj.euler.from_matrix(r, "ZXZ"), "ZXZ") - r).max()

    def slope(gap):
        turn = jnp.stack([jnp.asarray(0.4, gap.dtype), gap, jnp.asarray(0.3, gap.dtype)])
        r = rj.euler.to_matrix(turn, "ZXZ")
        return jnp.abs(jax.jacfwd(lambda m: rj.euler.from_matrix(m, "ZXZ"))(r)).max()

    for dtype in (jnp.float64, jnp.float32):
        trip = np.asarray(jax.jit(jax.vmap(back))(jnp.asarray(gaps, dtype)))
        axis.loglog(
            gaps, np.maximum(trip, 1e-17), "-", label=f"R there and back, {np.dtype(dtype).name}"
        )
        print(f"gimbal, {np.dtype(dtype).name}: R there and back {trip.max():.1e}")
    size = np.asarray(jax.jit(jax.vmap(slope))(jnp.asarray(gaps)))
    axis.loglog(gaps, size, "--", label="largest derivative of an angle")
    print(
        f"gimbal: derivative at 1e-3: {np.interp(1e-3, gaps, size):.1e}, finite {np.isfinite(size).all()}"
    )
    axis.set(title="R8: near gimbal lock (3-1-3)", xlabel="θ, rad")
    axis.legend(fontsize=7)


def half_turn(axis):
    """R1, R3, R4: log of exp and its Jacobian, near 0 and near π."""
    gaps = np.logspace(-15, 0, 46)
    direction = jnp.array([0.6, 0.0, -0.8])
    for dtype in (jnp.float64, jnp.float32):
        trip = lambda v: rj.quaternion.log(rj.quaternion.exp(v))
        one = jnp.eye(3, dtype=dtype)
        v = (np.pi - gaps[:, None]) * np.asarray(direction)[None]
        v = jnp.asarray(v[np.linalg.norm(v.astype(dtype), axis=1) < np.pi], dtype)
        value = np.asarray(jax.jit(jax.vmap(trip))(v), float)
        away = np.minimum(np.abs(value - v).max(axis=1), np.abs(value + np.asarray(v)).max(axis=1))
        slope = np.abs(np.asarray(jax.jit(jax.vmap(jax.jacrev(trip)))(v)) - one).max(axis=(1, 2))
        shown = gaps[-len(v) :]
        axis.loglog(shown, np.maximum(away, 1e-17), "-", label=f"value, {np.dtype(dtype).name}")
        axis.loglog(
            shown, np.maximum(slope, 1e-17), "--", label=f"Jacobian, {np.dtype(dtype).name}"
        )
        print(
            f"half turn, {np.dtype(dtype).name}: value {away.max():.1e}, Jacobian {slope.max():.1e}"
        )
    axis.set(
        title="R3, R4: log(exp v) near half a turn",
        xlabel="π − |v|",
        ylabel="error",
        ylim=(1e-17, 1),
    )
    axis.legend(fontsize=7)


def main(path="gallery.png"):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 3, figsize=(16, 9), layout="constrained")
    for axis, make in zip(
        axes.flat, (large_steps, middle_axis, tolerances, chaos, gimbal, half_turn), strict=True
    ):
        make(axis)
        axis.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
