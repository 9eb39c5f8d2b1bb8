"""`ReplayAdjoint` beside plain diffrax: a body under `simulate`, and a field of one's own.

`python tests/benchmarks/solve/bench_engine.py [--quick] [TIMES …]` prints for the asymmetric heavy top at 1e-9
with so many saved times (2, 30 and 300 unless given): CPU seconds to trace and compile, and CPU time
to run, each over that of a field written by hand under `diffrax.Dopri8`. "own field" is the
same field with `DormandPrince8` and `adjoint=ReplayAdjoint()`. Medians of interleaved repeats, in
one process.
"""

import sys

import bench_loop
import diffrax as dfx
import jax
import jax.numpy as jnp

import rigidjax as rj


def own_field(ts):
    """The field written by hand, with one more argument to `diffeqsolve`."""

    def run(p, omega):
        start = jnp.concatenate([jnp.asarray(bench_loop.Q), omega])
        control = dfx.PIDController(rtol=bench_loop.RTOL, atol=bench_loop.ATOL)
        return dfx.diffeqsolve(
            dfx.ODETerm(bench_loop.by_hand), rj.solvers.DormandPrince8(), ts[0], ts[-1], None,
            start, p, saveat=dfx.SaveAt(ts=ts), stepsize_controller=control,
            adjoint=rj.solvers.ReplayAdjoint(), max_steps=100_000,
        ).ys[:, 4:]  # fmt: skip

    return run


def main():
    repeats = 3 if "--quick" in sys.argv else 9
    print(f"jax {jax.__version__}, CPU time; in brackets over plain diffrax")
    for saved in [int(word) for word in sys.argv[1:] if word.isdigit()] or [2, 30, 300]:
        ts = jnp.linspace(0.0, bench_loop.END, saved)
        run, both = own_field(ts), (0, 1)
        own = {
            "value": run,
            "gradient": jax.grad(bench_loop.number(run), both),
            f"{bench_loop.MANY} values": jax.vmap(run),
            f"{bench_loop.MANY} gradients": jax.grad(bench_loop.numbers(run), both),
        }
        for row, methods in bench_loop.cases(ts).items():
            mine = "our loop" if "Jacobian" in row else "ours"
            kept = {"diffrax": methods["diffrax"], "simulate": methods[mine]}
            if row in own:
                kept["own field"] = (own[row], methods["diffrax"][1])
            bench_loop.shown(saved, row, bench_loop.measured(kept, repeats))


if __name__ == "__main__":
    main()
