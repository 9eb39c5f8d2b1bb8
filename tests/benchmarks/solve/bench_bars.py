"""The bars of speed that were set for adaptive and equal steps, and what is measured today.

    python tests/benchmarks/solve/bench_bars.py [--repeats 9]

One table: each row says what is compared, the bar, and the ratio measured here. Adaptive runs are
those of `bench_loop.py` (heavy top at 1e-9, with 2 and with 30 saved times, beside a field written
by hand under plain `diffrax.Dopri8`), equal steps those of `bench_batch.py` (beside C++ compiled on
the spot, where there is a compiler), new processes are started apart. CPU time, medians of
interleaved repeats; some eight minutes. A quiet machine repeats the ratios to about ± 20 %.
"""

import argparse
import importlib.util
import os
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

HERE = Path(__file__).parent
NEW = """
import time
begun = time.process_time()
import jax, diffrax
jax.config.update("jax_enable_x64", True)
others = time.process_time()
import rigidjax as rj
imported = time.process_time()
import jax.numpy as jnp
body, ts = rj.Inertia.from_principal(1.6, 2.0, 3.0), jnp.linspace(0.0, 10.0, 2)
top = rj.torques.HeavyTop(1.0, [0.1, 0.2, 0.9], [0.0, 0.0, -9.81])
def last(omega):
    start = rj.Attitude([1.0, 0.0, 0.0, 0.0], omega)
    return rj.simulate(body, start, ts, top).ys.omega[-1] @ jnp.ones(3)
omega = jnp.array([0.5, 1.0, 6.0])
jax.block_until_ready((WHAT)(omega))
print(imported - others, time.process_time())
"""


def load(path):
    """A bench beside this one, with no arguments of ours."""
    given, sys.argv = sys.argv, [str(path), "--quick"]
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    sys.argv = given
    return module


def say(name, bar, *found):
    shown = " / ".join("–" if value is None else f"{value:.2f}" for value in found)
    print(f"| {name} | {bar} | {shown} |", flush=True)


def adaptive(loop, repeats):
    """The rows of runs whose steps are chosen, with 2 and with 30 saved times."""
    for saved in (2, 30):
        found = {}
        for row, methods in loop.cases(jnp.linspace(0.0, loop.END, saved)).items():
            found[row] = loop.measured(methods, repeats)

        def over(row, which, who="ours", beside=None, found=found):
            beside = found[row]["diffrax"] if beside is None else beside
            return found[row][who][which] / beside[which]

        compiling, running, many = 0, 1, loop.MANY
        value, gradient = "value", "gradient"
        batch = f"{many} values", f"{many} gradients"
        at = f"{saved} saved times: "
        say(f"{at}compile, value / gradient", "1.0 / 0.6",
            over(value, compiling), over(gradient, compiling))  # fmt: skip
        say(f"{at}run one, value / gradient", "0.6 / 0.75",
            over(value, running), over(gradient, running))  # fmt: skip
        say(f"{at}run {many}, value / gradient", "0.15 / 0.25",
            *(over(row, running) for row in batch))  # fmt: skip
        say(f"{at}gradient over value, one / {many}", "5 / 5",
            over(gradient, running, beside=found[value]["ours"]),
            over(batch[1], running, beside=found[batch[0]]["ours"]))  # fmt: skip
        say(f"{at}our method inside diffeqsolve, compile of a gradient", "1.5",
            over(gradient, compiling, "inside diffeqsolve"))  # fmt: skip
        say(f"{at}closed form, compile, value / gradient", "1.0 / 0.6",
            over(value, compiling, "closed form"),
            over(gradient, compiling, "closed form"))  # fmt: skip
        for count in (13, 6):
            row = f"Jacobian by {count}"
            say(f"{at}{row}, over diffrax / over the value", "0.4 / 8" if count == 13 else "–",
                over(row, running), over(row, running, beside=found[value]["ours"]))  # fmt: skip
        for name, (hand, mine, args) in loop.particles(saved).items():
            each = []
            for of in (lambda f: f, lambda f: jax.grad(loop.number(f))):
                pair = {"diffrax": (of(hand), args), "ours": (of(mine), args)}
                taken = loop.measured(pair, repeats)
                each.append(taken["ours"][1] / taken["diffrax"][1])
            say(f"{at}{name}, run, value / gradient", "1.1 / 1.1", *each)


def medians(calls, repeats):
    """Median seconds of each call, in turn, after one that compiles."""
    taken = {name: [] for name in calls}
    for name in calls:
        calls[name]()
    for _ in range(repeats):
        for name, call in calls.items():
            taken[name].append(call())
    return {name: float(np.median(some)) for name, some in taken.items()}


def equal(batch, repeats):
    """The rows of equal steps."""
    import rigidjax as rj

    count = 10_000
    bodies, states = batch.data(count)
    run = lambda *more, of=(bodies, states): batch.timed(
        lambda: rj.batch.rollout(*of, batch.H, batch.STEPS, *more)
    )
    cpp = batch.compiled_cpp()
    calls = {"free": run(), "top": run(batch.TOP)}
    if cpp is not None:
        calls["C++"] = lambda: cpp(count)
    found = medians(calls, repeats)
    speeds = (found["C++"] / found[name] if cpp else None for name in ("free", "top"))
    say("rollout, speed over C++, free / heavy top", "0.6 / 0.4", *speeds)
    few = batch.data(1024)
    for name, torque in (("free", None), ("heavy top", batch.TOP)):

        def loss(tensor, states, torque=torque):
            end = rj.batch.rollout(rj.Inertia(tensor), states, batch.H, batch.STEPS, torque)
            return jnp.sum(end.q**2 * jnp.arange(1.0, 5.0)[None]) + jnp.sum(end.omega)

        options = rj.batch.compiler_options()
        value = jax.jit(loss, compiler_options=options)
        both = jax.jit(jax.value_and_grad(loss, (0, 1)), compiler_options=options)
        calls = {
            "value": batch.timed(lambda value=value: value(few[0].tensor, few[1])),
            "both": batch.timed(lambda both=both: both(few[0].tensor, few[1])),
        }
        found = medians(calls, repeats)
        say(
            f"rollout, gradient over value, 1024 × 1000, {name}",
            "5",
            found["both"] / found["value"],
        )


def started(what):
    """CPU s of a new process, import included, and what our import takes beside the others'."""
    code = NEW.replace("WHAT", what)
    taken = []
    for _ in range(3):
        out = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=os.environ
        )
        taken.append([float(word) for word in out.stdout.split()])
    return np.median(taken, axis=0)


def new_processes():
    """The rows of first answers; those of fits are in `tests/benchmarks/identify/bench_fit.py`."""
    beyond, value = started("last")
    _, gradient = started("jax.grad(last)")
    say("new process: first forced value / gradient, CPU s", "4 / 7", value, gradient)
    say("`import rigidjax` beyond jax and diffrax, CPU s", "0.4", beyond)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=9)
    repeats = parser.parse_args().repeats
    begun = time.perf_counter()
    print(f"load of the machine: {os.getloadavg()}; jax {jax.__version__}\n")
    print("| over plain diffrax where nothing else is said | bar | today |\n| --- | --- | --- |")
    new_processes()
    adaptive(load(HERE / "bench_loop.py"), repeats)
    equal(load(HERE.parent / "batch" / "bench_batch.py"), repeats)
    print(f"\n{time.perf_counter() - begun:.0f} s")


if __name__ == "__main__":
    main()
