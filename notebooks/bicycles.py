"""Bicycles that were taken apart, hung and timed: geometry, periods, classical reduction, one fit.

Parts: F front wheel, R rear wheel, B frame, H fork with handlebar. Body axes are those of the
bicycle (x forward, z down), with the origin in the middle of the wheel that the part holds.
"""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import rigidjax as rj
from rigidjax import identify
from rigidjax.suspensions import Axle, TorsionBar, period

FILE = Path(__file__).parent / "data/bicycles.json"
BICYCLES = {name: one for name, one in json.loads(FILE.read_text()).items() if name != "source"}
PARTS = "FRBH"
# Part and number of each hanging on the torsion bar.
HANGINGS = [(part, number) for part in PARTS for number in ((1,) if part in "FR" else (1, 2, 3))]
TIMED = [*(f"Tc{part}1" for part in PARTS), *(f"Tt{part}{number}" for part, number in HANGINGS)]
LINES = [f"a{part}{number}" for part in "BH" for number in (1, 2, 3)]
# Measured numbers on which periods and plumb lines depend, and the published numbers.
ERRORS = [*"mP dP lP TtP1 dF dR gamma w lF lR g".split(),
          *(f"alpha{part}{number}" for part in "BH" for number in (1, 2, 3))]  # fmt: skip
WANTED = [f"I{part}{k}" for part in "FRBH" for k in ("xx", "yy", "xz", "zz")
          if part in "BH" or k in ("xx", "yy")] + ["xB", "zB", "xH", "zH"]  # fmt: skip


def numbers(name, kind, which=0):
    """The `measured` or `published` numbers of a bicycle; with `which` 1 their deviations."""
    return {key: value[which] for key, value in BICYCLES[name][kind].items()}


def geometry(m):
    """The stiffness of the bar, the angles of the hangings, the middles of the wheels."""
    rod = m["mP"] * (m["dP"] ** 2 / 16 + m["lP"] ** 2 / 12)
    front, rear = (m[f"d{x}"] / (2 * jnp.pi * m[f"n{x}"]) for x in "FR")
    tilt = jnp.pi / 2 - jnp.deg2rad(m["gamma"])
    angles = {p: jnp.stack([jnp.deg2rad(m[f"alpha{p}{i}"]) for i in (1, 2, 3)]) for p in "BH"}
    beta = {part: tilt - alpha for part, alpha in angles.items()}
    middles = {"B": jnp.stack([0.0, -rear]), "H": jnp.stack([m["w"], -front])}
    return rod / (m["TtP1"] / (2 * jnp.pi)) ** 2, beta, middles


def plumb_line(beta, x, z):
    """How far the plumb line through the centre of mass passes the wheel's middle."""
    return -jnp.cos(beta) * z - jnp.sin(beta) * x


@jax.jit
def periods(m, bodies):
    """The periods of all hangings of the bodies of the four parts; their names are `TIMED`."""
    stiffness, beta, _ = geometry(m)
    stack = lambda parts: jax.tree.map(lambda *leaves: jnp.stack(leaves), *parts)
    gravity = jnp.stack([0.0, 0.0, -m["g"]])
    points = jnp.zeros((4, 3)).at[:2, 2].set(jnp.stack([m["lF"], m["lR"]]))
    angles = jnp.stack([beta[p][n - 1] if p in "BH" else jnp.zeros(()) for p, n in HANGINGS])
    axes = jnp.stack([jnp.cos(angles), 0 * angles, -jnp.sin(angles)], axis=1)
    swing = lambda body, point: period(body, Axle([0.0, 1.0, 0.0], point, gravity))
    twist = lambda body, axis: period(body, TorsionBar(axis, stiffness))
    return jnp.concatenate([
        jax.vmap(swing)(stack([bodies[p] for p in PARTS]), points),
        jax.vmap(twist)(stack([bodies[p] for p, _ in HANGINGS]), axes),
    ])  # fmt: skip


@jax.jit
def classical(m):
    """The authors' reduction, in closed form: each number from as many measured ones."""
    stiffness, beta, middles = geometry(m)
    out, turn = {}, lambda key: (m[key] / (2 * jnp.pi)) ** 2
    for part in PARTS:
        arm, mass = m.get(f"l{part}"), m[f"m{part}"]
        if part in "BH":  # the mean of the three points where two plumb lines meet
            rows = jnp.stack([-jnp.sin(beta[part]), -jnp.cos(beta[part])], axis=1)
            gaps = jnp.stack([m[f"a{part}{i}"] for i in (1, 2, 3)])
            pairs = [jnp.array(pair) for pair in ((0, 1), (1, 2), (2, 0))]
            com = sum(jnp.linalg.solve(rows[pair], gaps[pair]) for pair in pairs) / 3
            arm = jnp.hypot(*com)
            out[f"x{part}"], out[f"z{part}"] = com + middles[part]
            c, s = jnp.cos(beta[part]), jnp.sin(beta[part])
            moments = stiffness * jnp.stack([turn(f"Tt{part}{i}") for i in (1, 2, 3)])
            found = jnp.linalg.solve(jnp.stack([c * c, -2 * s * c, s * s], axis=1), moments)
            out |= {f"I{part}{k}": one for k, one in zip(("xx", "xz", "zz"), found, strict=True)}
        else:
            out[f"I{part}xx"] = stiffness * turn(f"Tt{part}1")
        out[f"I{part}yy"] = turn(f"Tc{part}1") * mass * m["g"] * arm - mass * arm**2
    return out


@jax.jit  # traced: a reduction may give a body that is flatter than any, which is refused elsewhere
def bodies_of(m, found):
    """The bodies of the four parts from the numbers of a reduction."""
    middles = geometry(m)[2] | {"F": jnp.zeros(2), "R": jnp.zeros(2)}
    out = {}
    for part in PARTS:
        xx, yy, xz, zz = (found.get(f"I{part}{k}", 0.0) for k in ("xx", "yy", "xz", "zz"))
        tensor = jnp.array([[xx, 0.0, xz], [0.0, yy, 0.0], [xz, 0.0, zz if part in "BH" else xx]])
        at = jnp.array([found.get(f"x{part}", 0.0), found.get(f"z{part}", 0.0)]) - middles[part]
        second = 0.5 * jnp.trace(tensor) * jnp.eye(3) - tensor
        out[part] = rj.MassProperties(m[f"m{part}"], jnp.stack([at[0], 0.0, at[1]]), second)
    return out


def joint(name):
    """One model of all parts, whose bodies are possible, a function of its points that returns the
    numbers `WANTED`, and where to start: each measured number has an error.
    """
    m, width = numbers(name, "measured"), numbers(name, "measured", 1)

    def at(point):
        errors = dict(zip(ERRORS, point.values["errors"], strict=True))
        return m | {key: m[key] + width[key] * error for key, error in errors.items()}

    def lines(point):
        beta = geometry(at(point))[1]
        coms = {part: point.body[part].com for part in "BH"}
        return jnp.concatenate([plumb_line(beta[p], c[0], c[2]) for p, c in coms.items()])

    def symmetry(point):
        """What is zero in a part that is its own mirror image; a wheel is round as well."""
        out = [jnp.stack([b.com[1], b.inertia.tensor[0, 1], b.inertia.tensor[1, 2]])
               for b in point.body.values()]  # fmt: skip
        for part in "FR":
            com, tensor = point.body[part].com, point.body[part].inertia.tensor
            out += [com[::2], jnp.stack([tensor[0, 2], tensor[2, 2] - tensor[0, 0]])]
        return jnp.concatenate(out)

    measured = [
        identify.Measured(lambda point: periods(at(point), point.body),
                          [m[k] for k in TIMED], [width[k] for k in TIMED], "period"),
        identify.Measured(lines, [m[k] for k in LINES], [width[k] for k in LINES], "plumb line"),
        identify.Measured(symmetry, np.zeros(20), 1e-5, "symmetry"),
    ]  # fmt: skip
    t, still = np.arange(4.0), np.tile([1.0, 0, 0, 0], (4, 1))
    scale = rj.torques.LoggedMotion(t, np.zeros((4, 3)), still)  # each part lies on a scale
    # A possible body near each: no second moment along an axis is below a hundredth of the largest.
    guesses = {}
    for part, body in bodies_of(m, classical(m)).items():
        along, axes = np.linalg.eigh(body.second_moment)
        second = axes @ np.diag(np.maximum(along, 0.01 * along[-1])) @ axes.T
        guesses[part] = rj.MassProperties(body.mass, body.com, second)
    records, charts = {}, {}
    for part in PARTS:
        mass, wide = m[f"m{part}"], width[f"m{part}"]
        noise = [1e3, 1e3, 2 * 9.81 * wide, 1e3, 1e3, 1e3]  # of four readings, alike
        sensor = identify.ForceTorque(noise, gravity=[0.0, 0.0, -9.81])
        weight = np.tile([0, 0, 9.81 * mass, 0, 0, 0], (4, 1))
        records[part] = identify.Recording(t, (sensor, weight), inputs={"motion": scale})
        charts[part] = identify.Mass(guesses[part])
    errors = identify.Free(np.zeros(len(ERRORS)), "errors", prior=1.0)
    torque = rj.torques.Carried()
    places = {"xx": (0, 0), "yy": (1, 1), "zz": (2, 2), "xz": (0, 2)}

    def wanted(point):
        middles = geometry(at(point))[2]
        tensors = {f"I{p}{k}": b.inertia.tensor[place] for p, b in point.body.items()
                   for k, place in places.items()}  # fmt: skip
        for part in "BH":
            com = point.body[part].com[::2] + middles[part]
            tensors[f"x{part}"], tensors[f"z{part}"] = com
        return jnp.stack([tensors[key] for key in WANTED])

    model = identify.Model(records, charts, torque=torque, free=[errors], measured=measured)
    return model, wanted, model.start(guesses)


def compared(name):
    """The joint fit; of its numbers `WANTED` how far they are from the published ones, in published
    deviations, and how wide their intervals are beside the published.
    """
    model, wanted, start = joint(name)
    fit = identify.fit(model, initial=start, starts=1)
    published, stated = (
        np.array([numbers(name, "published", which)[key] for key in WANTED]) for which in (0, 1)
    )
    low, high = fit.interval_of(wanted)
    off = (np.asarray(wanted(model.unpack(fit.x))) - published) / stated
    return fit, off, (high - low) / (2 * 1.959964 * stated)
