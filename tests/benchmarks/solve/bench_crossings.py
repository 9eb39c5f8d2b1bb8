"""What a Poincaré section costs: 200 heavy tops, 1000 crossings each, and their motion alone.

python tests/benchmarks/solve/bench_crossings.py [tops] [crossings]
"""

import sys
import time

import jax
import jax.numpy as jnp

import rigidjax as rj

TOPS, CROSSINGS = (int(a) for a in (*sys.argv[1:], *("200", "1000")[len(sys.argv) - 1 :]))
BODY = rj.Inertia.from_principal(1.0, 1.4, 0.8)
TOP = rj.torques.HeavyTop(1.0, [0.1, 0.0, 0.3], [0.0, 0.0, -9.81])


def rate(t, state, body):
    return state.omega[0]


def start(omega):
    return rj.Attitude(rj.quaternion.exp(jnp.array([1.2, 0.0, 0.0])), omega)


def section(omega):
    found = rj.crossings(
        BODY, start(omega), 0.0, 1e5, rate, TOP, direction=1, max_crossings=CROSSINGS
    )
    return found.times, found.num_steps


def motion(omega, end):
    return rj.simulate(BODY, start(omega), jnp.stack([jnp.zeros(()), end]), TOP).stats["num_steps"]


def timed(f, *args):
    f = jax.jit(jax.vmap(f))
    jax.block_until_ready(f(*args))
    seconds = []
    for _ in range(3):
        begin = time.process_time()
        out = jax.block_until_ready(f(*args))
        seconds.append(time.process_time() - begin)
    return sorted(seconds)[1], out


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    omegas = jnp.stack(
        [jnp.full(TOPS, 0.5), jnp.linspace(-1, 1, TOPS), jnp.linspace(3.0, 6.0, TOPS)], 1
    )
    seconds, (times, passes) = timed(section, omegas)
    alone, steps = timed(motion, omegas, times[:, -1])
    print(f"{TOPS} × {CROSSINGS} crossings: {seconds:.2f} s of processor, the motion {alone:.2f} s")
    print(
        f"passes a crossing: {passes.mean() / CROSSINGS:.1f}, steps: {steps.mean() / CROSSINGS:.1f}"
    )
