"""How many 95 % intervals hold where a noise or a width is estimated from few errors.

`python tests/benchmarks/identify/bench_few.py` prints one line a scene; 100 simulated experiments each.
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.spatial.transform import Rotation

import rigidjax as rj
from rigidjax import identify

TIMES = jnp.linspace(0.0, 4.0, 100)
RATE, BIAS = [1.0, 0.3, 1.2], [0.05, -0.03, 0.02]


class Fading(rj.torques.AbstractTorque):
    """Damping with one coefficient for all axes."""

    feels: ClassVar[type] = rj.motion.HasSpin
    coefficient: Array = eqx.field(converter=jnp.asarray)

    def __call__(self, t, state, body):
        return -self.coefficient * state.omega


def attitudes(random, few, states):
    """A gyro with a bias, and `few` attitudes, both of unknown noise: ten intervals' truths."""
    errors = Rotation.from_rotvec(0.01 * random.normal(size=(100, 3)))
    turned = Rotation.from_quat(np.asarray(states.q), scalar_first=True) * errors
    rates = np.asarray(states.omega) + BIAS + 0.02 * random.normal(size=(100, 3))
    seen = np.isin(np.arange(100), np.linspace(0, 99, few).astype(int))
    record = identify.Recording(
        TIMES,
        (identify.AttitudeSensor(), turned.as_quat(scalar_first=True), seen),
        (identify.Gyro(bias=[0.0, 0, 0]), rates),
    )
    bias = identify.Free(lambda s: s.sensors[1].bias, "bias", scale=0.1)
    found = identify.fit(identify.Model(record, identify.Ratios(), free=[bias]), starts=1)
    return list(zip(found.interval().values(), [0.4, 0.8, *RATE, *BIAS], strict=True))


def widths(random, count, width):
    """A sphere whose damping differs between `count` recordings: the interval of the mean."""
    times, records = np.linspace(0.0, 2.0, 40), []
    for _ in range(count):
        own = 0.3 + width * random.normal()
        rates = np.exp(-own * times)[:, None] * [1.0, 2.0, 0.0]
        gyro = identify.Gyro(0.01), rates + 0.01 * random.normal(size=(40, 3))
        records.append(identify.Recording(times, gyro))
    free = [identify.Free(lambda s: s.torque.coefficient, "c", scale=0.1, spread="estimated")]
    sphere = identify.Known(rj.Inertia.from_principal(1.0, 1.0, 1.0))
    found = identify.fit(identify.Model(records, sphere, torque=Fading(0.2), free=free), starts=1)
    return [(found.interval()["c"], 0.3)]


def main():
    jax.config.update("jax_enable_x64", True)
    body = rj.Inertia.from_principal(1.0, 2.0, 2.5)
    states = rj.simulate(body, rj.Attitude([1.0, 0, 0, 0], RATE), TIMES).ys
    scenes = {f"{few} attitudes": lambda r, few=few: attitudes(r, few, states) for few in (3, 4, 6)}
    for width in (0.05, 0.005):
        for count in (3, 5, 8):
            what = f"{count} recordings, width {width}"
            scenes[what] = lambda r, c=count, w=width: widths(r, c, w)
    for name, scene in scenes.items():
        pairs = [pair for seed in range(100) for pair in scene(np.random.default_rng(seed))]
        held = np.mean([low < truth < high for (low, high), truth in pairs])
        print(f"{name}: {100 * held:.1f} % of {len(pairs)} intervals hold", flush=True)


if __name__ == "__main__":
    main()
