"""Cost of the closed form against a solver: `python tests/benchmarks/exact/bench_free_body.py`. Ratios count."""

import statistics
import time

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)

import rigidjax.exact as exact
from rigidjax.body.inertia import Inertia
from rigidjax.motion import Attitude
from rigidjax.motion.equations import AttitudeEquations


def closed(tensor, omega, t):
    out = exact.free_body(Inertia(tensor), Attitude(jnp.array([1.0, 0, 0, 0]), omega), t)
    return jnp.concatenate([out.q, out.omega])


def solved(tensor, omega, t):
    sol = diffrax.diffeqsolve(
        diffrax.ODETerm(AttitudeEquations(Inertia(tensor))),
        diffrax.Dopri8(),
        0.0,
        t,
        0.01,
        Attitude(jnp.array([1.0, 0, 0, 0]), omega),
        stepsize_controller=diffrax.PIDController(1e-12, 1e-12),
        max_steps=None,
    )
    return jnp.concatenate([sol.ys.q[0], sol.ys.omega[0]])


def gradient(tensor, omega, t):
    return jax.grad(lambda *a: closed(*a).sum(), (0, 1))(tensor, omega, t)


def of_moments(moments):
    """One number of an attitude, of which the second derivative by the moments is taken."""
    return closed(jnp.diag(moments), jnp.array([0.3, 1.0, -0.2]), jnp.asarray(10.0))[1]


def second_derivatives():
    """Print the cost of a Hessian by the moments, and of 1000 products with a vector at once."""
    moments = jnp.array([1.0, 1.6, 2.2])
    hessian = jax.jacfwd(jax.grad(of_moments))
    lines = len(jax.jit(hessian).lower(moments).as_text().splitlines())
    program, seconds = compiled(hessian, moments)
    run = cost(program, moments, inner=50)
    print(f"Hessian by three moments: {lines} lines, {seconds:.1f} CPU s to compile, {run:.0f} us")
    many = moments * jnp.linspace(1.0, 1.1, 1000)[:, None]
    product = jax.vmap(lambda m, v: jax.jvp(jax.grad(of_moments), (m,), (v,))[1])
    program, seconds = compiled(product, many, many)
    run = cost(program, many, many, repeats=5) / 1000
    print(f"1000 products with a vector: {seconds:.1f} CPU s to compile, {run:.1f} us each")


def compiled(function, *arguments):
    start = time.process_time()
    out = jax.jit(function).lower(*arguments).compile()
    return out, time.process_time() - start


def cost(call, *arguments, repeats=7, inner=1):
    jax.block_until_ready(call(*arguments))
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        for _ in range(inner):
            out = call(*arguments)
        jax.block_until_ready(out)
        times.append((time.perf_counter() - start) / inner)
    return 1e6 * statistics.median(times)


def scipy_form(u, m):
    from scipy.special import ellipj, ellipkinc

    start = time.perf_counter()
    ellipj(u, m), ellipkinc(u, m)
    return 1e6 * (time.perf_counter() - start) / len(u)


def main():
    n, r = 10_000, np.random.default_rng(0)
    tensors = jax.vmap(jnp.diag)(jnp.asarray(np.sort(r.uniform(1, 2, (n, 3)), axis=1)))
    omegas = jnp.asarray(r.normal(size=(n, 3)))
    t = jnp.full(n, 100.0)
    one = (tensors[0], omegas[0], t[0])
    single, first = compiled(closed, *one)
    graded, second = compiled(gradient, *one)
    print(f"compile, CPU s: value {first:.1f}, gradient {second:.1f}")
    single, graded = jax.jit(closed), jax.jit(gradient)
    print(
        f"one body, us: value {cost(single, *one, inner=500):.1f}, gradient {cost(graded, *one, inner=200):.1f}"
    )
    batch, slopes = jax.jit(jax.vmap(closed)), jax.jit(jax.vmap(gradient))
    b, g = cost(batch, tensors, omegas, t) / n, cost(slopes, tensors, omegas, t, repeats=5) / n
    print(f"batch of {n}, us a body: value {b:.2f}, gradient {g:.2f}")
    one_body = jax.jit(jax.vmap(closed, (None, None, 0)))
    print(
        f"one body, {n} times, us a time: {cost(one_body, one[0], one[1], jnp.linspace(0, 1e3, n)) / n:.2f}"
    )
    print(
        f"SciPy ellipj + ellipkinc, us a body: {scipy_form(r.uniform(0, 10, n), r.uniform(0, 1, n)):.2f}"
    )
    solver = jax.jit(solved)
    for end in (1.0, 10.0, 100.0, 1000.0):
        end = jnp.asarray(end)
        a, d = (
            cost(single, one[0], one[1], end, inner=200),
            cost(solver, one[0], one[1], end, repeats=5),
        )
        print(
            f"T = {float(end):6.0f}: Dopri8 1e-12 / closed form: one {d / a:.0f}, batch {d / b:.0f} (solver one at a time)"
        )


if __name__ == "__main__":
    main()
    second_derivatives()
