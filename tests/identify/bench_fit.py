"""How long a fit takes: one throw, 0.7 s at 1 kHz, twelve free numbers; beside SciPy with numba.

    python tests/identify/bench_fit.py

Ours: Levenberg–Marquardt with exact Jacobians, warm (compiled once, other readings each time). The
peer: `scipy.optimize.least_squares` (method lm) with finite differences through a Runge–Kutta of
order 4 at the same steps, its loop compiled by numba where that is installed, else not timed.
Medians of seven interleaved repeats. Also: compile time, and many starts in one vmap.
"""

import time

import jax
import numpy as np
from scipy.optimize import least_squares

jax.config.update("jax_enable_x64", True)

import rigidjax as rj
from rigidjax import identify

COUNT, STEP, SIGMA, WHEEL = 700, 1e-3, 0.02, 1.7e-6
T = np.arange(COUNT) * STEP
SPEED = -1300.0 * 0.5 * (np.tanh((T - 0.2) / 0.03) - np.tanh((T - 0.45) / 0.05))
MOMENTS = np.diag([4.1e-4, 1.3e-4, 4.6e-4]) + 1e-5 * (np.ones((3, 3)) - np.eye(3))
DRAG, OMEGA = np.array([2e-5, 1e-5, 3e-5]), np.array([11.0, 1.5, -2.0])
RATE = np.gradient(SPEED, STEP)


def law(drag):
    wheel = rj.torques.Flywheel(
        rj.torques.Wheel(WHEEL, [0.0, 0.0, 1.0], rj.torques.Series(T, SPEED))
    )
    return rj.torques.Sum(wheel, rj.torques.Damping(drag))


def problem(readings):
    record = identify.Recording(T, (identify.Gyro(SIGMA), readings), torque=law([0.0, 0.0, 0.0]))
    free = [identify.Free(lambda r: r.torque.parts[1].coefficient, "drag", scale=1e-5)]
    return identify.Problem(record, identify.Tensor(3e-4), free=free)


def peer():
    """`least_squares` on the same twelve numbers, or None without numba."""
    try:
        import numba
    except ModuleNotFoundError:
        return None

    @numba.njit(cache=False)
    def rate(w, h, dh, inertia, inverse, drag):
        p0 = inertia[0, 0] * w[0] + inertia[0, 1] * w[1] + inertia[0, 2] * w[2]
        p1 = inertia[1, 0] * w[0] + inertia[1, 1] * w[1] + inertia[1, 2] * w[2]
        p2 = inertia[2, 0] * w[0] + inertia[2, 1] * w[1] + inertia[2, 2] * w[2] + h
        a = p1 * w[2] - p2 * w[1] - drag[0] * w[0]
        b = p2 * w[0] - p0 * w[2] - drag[1] * w[1]
        c = p0 * w[1] - p1 * w[0] - drag[2] * w[2] - dh
        return np.array(
            [
                inverse[0, 0] * a + inverse[0, 1] * b + inverse[0, 2] * c,
                inverse[1, 0] * a + inverse[1, 1] * b + inverse[1, 2] * c,
                inverse[2, 0] * a + inverse[2, 1] * b + inverse[2, 2] * c,
            ]
        )

    @numba.njit(cache=False)
    def motion(w, inertia, inverse, drag, h, dh, step):
        out = np.empty((h.size, 3))
        out[0] = w
        for i in range(h.size - 1):
            hm, dm = 0.5 * (h[i] + h[i + 1]), 0.5 * (dh[i] + dh[i + 1])
            k1 = rate(w, h[i], dh[i], inertia, inverse, drag)
            k2 = rate(w + 0.5 * step * k1, hm, dm, inertia, inverse, drag)
            k3 = rate(w + 0.5 * step * k2, hm, dm, inertia, inverse, drag)
            k4 = rate(w + step * k3, h[i + 1], dh[i + 1], inertia, inverse, drag)
            w = w + step / 6.0 * (k1 + 2 * k2 + 2 * k3 + k4)
            out[i + 1] = w
        return out

    def residual(x, readings):
        inertia = 3e-4 * np.array([[x[0], x[3], x[4]], [x[3], x[1], x[5]], [x[4], x[5], x[2]]])
        inverse = np.linalg.inv(inertia)
        w = motion(10 * x[6:9], inertia, inverse, 1e-5 * x[9:], WHEEL * SPEED, WHEEL * RATE, STEP)
        return ((w - readings) / SIGMA).ravel()

    def fit(readings, start):
        return least_squares(residual, start, args=(readings,), method="lm")

    return fit


def main():
    body = rj.Inertia(MOMENTS)
    clean = np.asarray(rj.simulate(body, rj.Spin(OMEGA), T, law(DRAG)).ys.omega)
    rng = np.random.default_rng(0)
    draws = [clean + SIGMA * rng.normal(size=clean.shape) for _ in range(8)]
    began = time.perf_counter()
    first = identify.fit(problem(draws[0]), starts=1)
    print(f"first call, with compiling: {time.perf_counter() - began:.1f} s, {first.status}")
    other = peer()
    start = np.r_[np.diag(MOMENTS) * 1.1 / 3e-4, 0.0, 0.0, 0.0, draws[0][0] / 10, 0.0, 0.0, 0.0]
    if other is not None:
        other(draws[0], start)
    ours, theirs = [], []
    for readings in draws[1:]:
        began = time.perf_counter()
        found = identify.fit(problem(readings), starts=1)
        ours.append(time.perf_counter() - began)
        if other is not None:
            began = time.perf_counter()
            out = other(readings, start)
            theirs.append(time.perf_counter() - began)
    print(f"warm fit: {np.median(ours) * 1e3:.0f} ms, {found.status}, moments {found.body.moments}")
    if theirs:
        print(
            f"scipy + numba: {np.median(theirs) * 1e3:.0f} ms ({out.nfev} evaluations), cost {out.cost}"
        )
        print(f"ratio theirs / ours: {np.median(theirs) / np.median(ours):.2f}")
    free = identify.Recording(T[::10], (identify.Gyro(SIGMA), draws[0][::10]))
    ratios = identify.Problem(free, identify.PrincipalRatios())
    identify.fit(ratios, starts=1000, together=1000)
    began = time.perf_counter()
    identify.fit(ratios, starts=1000, together=1000)
    print(f"1000 starts in one vmap, 70 samples, free motion: {time.perf_counter() - began:.1f} s")


if __name__ == "__main__":
    main()
