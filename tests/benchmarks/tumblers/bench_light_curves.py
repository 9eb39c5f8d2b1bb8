"""What light curves of tumbling ellipsoids cost: 5000 bodies at 1000 times, by the closed form.

python tests/benchmarks/tumblers/bench_light_curves.py [bodies] [times]
"""

import sys
import time

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp

import rigidjax as rj
from rigidjax.identify import SensorInput
from rigidjax.tumblers import Brightness

BODIES, TIMES = (int(a) for a in (*sys.argv[1:], *("5000", "1000")[len(sys.argv) - 1 :]))


def curve(moments, omega, ts):
    body = rj.Inertia(jnp.diag(moments))
    motion = rj.exact.FreeBody(body, rj.Attitude([1.0, 0, 0, 0], omega))
    sensor = Brightness([1.0, 0, 0], [0.8, 0.6, 0.0], noise=0.02)

    def at(t):
        return sensor.predict(SensorInput(t, motion(t), body, lambda t, y, args: y))

    return jax.vmap(at)(ts)


def timed(f, *args):
    """Median of five runs, s of this process, and of the first one beyond it."""
    spent = []
    for _ in range(6):
        began = time.process_time()
        jax.block_until_ready(f(*args))
        spent.append(time.process_time() - began)
    middle = sorted(spent[1:])[2]
    return middle, spent[0] - middle


keys = jax.random.split(jax.random.key(0), 2)
second = jax.random.uniform(keys[0], (BODIES, 3), minval=0.2, maxval=1.0)
moments = second.sum(axis=1, keepdims=True) - second
omega = jax.random.normal(keys[1], (BODIES, 3))
run = jax.jit(jax.vmap(curve, (0, 0, None)), compiler_options=rj.batch.compiler_options())
warm, first = timed(run, moments, omega, jnp.linspace(0.0, 100.0, TIMES))
print(
    f"{BODIES} bodies at {TIMES} times in {warm:.2f} s of one core "
    f"({warm / BODIES / TIMES * 1e9:.0f} ns each), compiled in {first:.1f} s"
)
