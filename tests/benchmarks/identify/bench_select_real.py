"""Select the terms of real recordings: `python bench_select_real.py FOLDER [SET …]`.

FOLDER has the folders tudelft_throw, tennis_racket, nanodrone and crazyflie, of which files without
a licence are not part of this project. Of each SET (`throws`, `racket`, `nanodrone`, `crazyflie`)
the path of the selection is printed, and the errors that the model chosen by hand makes on the same
held-out part. Of the nano-drone also those of open-loop predictions on two runs kept apart.
"""

import csv
import dataclasses
import importlib.util
import sys
import time
from collections import defaultdict
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)

import rigidjax as rj
from rigidjax import identify, torques
from rigidjax.motion.torques.base import AbstractForce


def free(where, name, **options):
    """Return a dictionary with one candidate of one `Free`."""
    return {name: identify.Free(where, name, **options)}


def shown(name, model, candidates, by_hand, starts=2):
    """Print a selection beside the fit by hand, and return both fits."""
    begin = time.process_time()
    found = identify.select(model, candidates, starts=starts)
    took = time.process_time() - begin
    print(f"== {name}: {took:.0f} CPU s\n{found}\n{found.fit.status}")
    hand = identify.fit(by_hand, starts=starts)
    for word, one in (("selected", found.fit), ("by hand", hand)):
        pairs = () if one.held_out is None else one.held_out.pairs
        print(f"{word}: held out", [f"{p.held_out:.4g}" for p in pairs], "fitted",
              [f"{x:.4g}" for x in one.rms])  # fmt: skip
    sys.stdout.flush()
    return found, hand


def racket(folder):
    """A phone on a tennis racket: first 0.6 s of a toss of each of two rounds."""
    rows = defaultdict(list)
    with (folder / "tennis_racket" / "tosses.csv").open() as file:
        for row in csv.DictReader(file):
            rows[row["round"], row["toss"]].append([float(row[k]) for k in ("t", "wx", "wy", "wz")])
    law = torques.QuadraticDamping([0.0] * 3)
    move = [
        identify.Free(lambda s: s.torque.coefficient, "drag", scale=0.01),
        identify.Free(lambda s: s.sensors[0].bias, "bias", scale=0.05),
    ]
    for round_ in ("2", "3"):
        data = np.array(next(v for k, v in rows.items() if k[0] == round_))[:60]
        record = identify.Recording(data[:, 0], (identify.Gyro(), data[:, 1:]))
        biased = identify.Recording(data[:, 0], (identify.Gyro(bias=[0.0] * 3), data[:, 1:]))
        hand = identify.Model(biased, identify.Ratios(), torque=law, free=move)
        shown(f"racket, round {round_}", identify.Model(record, identify.Ratios()), None, hand)


def throws(folder):
    """All throws of a box with a flywheel and the empty object, each fourth sample."""
    path = Path(__file__).parents[2] / "identify" / "throws.py"
    spec = importlib.util.spec_from_file_location("throws", path)
    box = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(box)
    box.FOLDER = folder / "tudelft_throw"
    gyro = identify.Gyro(bias=[0.0] * 3, scale=[1.0] * 3, skew=[0.0] * 3)
    records = []
    for path in box.paths("object_empty"):
        log, speed = box.columns(path, box.WINDOW[0]), box.speed(path)
        rates = np.stack([log["wx"], log["wy"], log["wz"]], axis=1)
        records.append(
            identify.Recording(log["t"][::4], (gyro, rates[::4]), inputs={"speed": speed})
        )
    wheel = box.law(tilt=[0.0, 0.0]).parts[0]
    zero = [0.0] * 3
    law = torques.Sum(
        wheel, torques.Damping(zero), torques.QuadraticDamping(zero), torques.ConstantTorque(zero)
    )
    candidates = {
        **free(lambda s: s.torque.parts[0].momentum.delay, "delay", scale=1e-3, each=True),
        **free(lambda s: s.torque.parts[0].momentum.tilt, "tilt", scale=0.01),
        **free(lambda s: s.torque.parts[1].coefficient, "drag", scale=1e-5),
        **free(lambda s: s.torque.parts[2].coefficient, "quadratic drag", scale=1e-6),
        **free(lambda s: s.torque.parts[3].torque, "push", scale=1e-4),
        **free(lambda s: s.sensors[0].bias, "bias", scale=0.05),
        **free(lambda s: s.sensors[0].scale, "scale", scale=0.01, prior=0.02),
        **free(lambda s: s.sensors[0].skew, "skew", scale=0.01, prior=0.02),
    }
    model = identify.Model(records, identify.Tensor(3e-4), torque=law)
    hand = [candidates[name] for name in ("delay", "tilt", "drag", "bias", "scale", "skew")]
    shown("throws", model, candidates, dataclasses.replace(
        identify.Model(records, identify.Tensor(3e-4), torque=law, free=hand)))  # fmt: skip


class Reaction(AbstractForce):
    """The torque about z of rotors that speed up, from this sample's speeds and the next one's."""

    feels = rj.motion.HasPose
    spins: jax.Array
    inertia: jax.Array  # of each rotor, kg m²
    step: float
    now: torques.Input = torques.Input("now")
    soon: torques.Input = torques.Input("soon")

    def __call__(self, t, state, body):
        faster = (self.soon(t) - self.now(t)) / self.step
        turn = self.inertia * jnp.sum(self.spins * faster)
        return torques.Wrench(jnp.zeros(3), jnp.stack([0.0 * turn, 0.0 * turn, turn]))


def nanodrone(folder):
    """Windows of eleven flights; those of two flights are kept apart."""
    sys.path.insert(0, str(Path(__file__).parent))
    import bench_nanodrone as drone

    runs = {path.stem: path for path in sorted((folder / "nanodrone").glob("*.csv"))}
    train = identify.Windows.join(
        *(drone.cut(path, 50, 100) for name, path in runs.items() if name not in drone.HELD_OUT)
    )
    turning = Reaction(jnp.asarray(drone.SPINS), jnp.zeros(()), 0.01)
    law = torques.Sum(drone.GUESS, turning)
    base = ("thrust", "drag")
    place = lambda k: lambda s: getattr(s.torque.parts[0], k)
    candidates = {
        k: identify.Free(place(k), k, scale=size)
        for k, size in drone.SIZES.items()
        if k not in base
    }
    candidates |= free(lambda s: s.torque.parts[0].speeds.ahead, "ahead")
    candidates |= free(lambda s: s.torque.parts[1].inertia, "rotor inertia", scale=1e-9)
    always = [identify.Free(place(k), k, scale=drone.SIZES[k]) for k in base]
    model = identify.Model(train, drone.Root(), torque=law, free=always)
    hand = identify.Model(train, drone.Root(), torque=drone.GUESS, free=drone.FREE)
    found, other = shown("nano-drone", model, candidates, hand, starts=1)
    test = identify.Windows.join(*(drone.cut(runs[name], 50, 1) for name in drone.HELD_OUT))
    for word, one in (("selected", found.fit), ("by hand", other)):
        errors = identify.predict_windows(one, test).mean_norm
        print(word, {kind: f"{e.sum():.2f}" for kind, e in errors.items()}, flush=True)


SETS = {"racket": racket, "throws": throws, "nanodrone": nanodrone}

if __name__ == "__main__":
    for name in sys.argv[2:] or SETS:
        SETS[name](Path(sys.argv[1]))
