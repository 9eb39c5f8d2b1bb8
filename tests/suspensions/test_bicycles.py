"""Bicycles that were hung and timed: published tensors give the measured periods, and back."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax.suspensions import Axle, TorsionBar, period

FILE = Path(__file__).parents[2] / "notebooks/data/bicycles.json"
BICYCLES = {name: one for name, one in json.loads(FILE.read_text()).items() if name != "source"}
NAMES = sorted(BICYCLES)


def geometry(m):
    """Centres of mass from plumb lines, angles of the hangings, arms, stiffness of the bar."""
    rod = m["mP"] * (m["dP"] ** 2 / 16 + m["lP"] ** 2 / 12)
    front, rear = (m[f"d{x}"] / (2 * jnp.pi * m[f"n{x}"]) for x in "FR")
    tilt = jnp.pi / 2 - jnp.deg2rad(m["gamma"])
    out = {"k": rod / (m["TtP1"] / (2 * jnp.pi)) ** 2}
    for part, wheel, ahead in (("B", rear, 0.0), ("H", front, m["w"])):
        beta = jnp.stack([tilt - jnp.deg2rad(m[f"alpha{part}{i}"]) for i in (1, 2, 3)])
        gap = jnp.stack([m[f"a{part}{i}"] for i in (1, 2, 3)])
        lines = jnp.stack([jnp.tan(beta), jnp.ones(3)], axis=1)
        side = -gap / jnp.cos(beta) - wheel + ahead * jnp.tan(beta)
        pairs = [jnp.array(pair) for pair in ((0, 1), (1, 2), (2, 0))]
        x, z = sum(jnp.linalg.solve(lines[pair], side[pair]) for pair in pairs) / 3
        arm = jnp.hypot(x - ahead, z + wheel)
        out |= {f"beta{part}": beta, f"x{part}": x, f"z{part}": z, f"l{part}": arm}
    return out | {"lF": m["lF"], "lR": m["lR"]}


HANGINGS = [(part, number) for part in "FRBH" for number in ((1,) if part in "FR" else (1, 2, 3))]
TIMED = [*(f"Tc{part}1" for part in "FRBH"), *(f"Tt{part}{number}" for part, number in HANGINGS)]


def body_of(m, found, part):
    i = {axis: found.get(f"I{part}{axis}", 0.0) for axis in ("xx", "xz", "yy", "zz")}
    # A wheel's moment about z is that about x; it hangs with x along the bar.
    i["zz"] = i["xx"] if part in "FR" else i["zz"]
    rows = [[i["xx"], 0.0, i["xz"]], [0.0, i["yy"], 0.0], [i["xz"], 0.0, i["zz"]]]
    tensor = jnp.array(rows)
    second = 0.5 * jnp.trace(tensor) * jnp.eye(3) - tensor
    return rj.MassProperties(m[f"m{part}"], jnp.zeros(3), second)


@jax.jit
def periods(m, found):
    """The periods of all hangings, from the numbers of the bodies; one program for all bicycles."""
    g = geometry(m)
    together = lambda trees: jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)
    bodies = {part: body_of(m, found, part) for part in "FRBH"}

    def compound(body, arm):
        place = jnp.stack([jnp.zeros(()), jnp.zeros(()), arm])
        return period(body, Axle([0, 1, 0], place, gravity=jnp.stack([0.0, 0.0, -m["g"]])))

    def torsion(body, beta):
        axis = jnp.stack([jnp.cos(beta), jnp.zeros(()), -jnp.sin(beta)])
        return period(body, TorsionBar(axis, g["k"]))

    arms = jnp.stack([g[f"l{part}"] for part in "FRBH"])
    angles = [g[f"beta{part}"][n - 1] if part in "BH" else jnp.zeros(()) for part, n in HANGINGS]
    hung = jax.vmap(compound)(together(bodies.values()), arms)
    turned = jax.vmap(torsion)(together([bodies[part] for part, _ in HANGINGS]), jnp.stack(angles))
    return jnp.concatenate([hung, turned])


@jax.jit
def slopes(tensors, others):
    """The periods and their derivatives by the tensors and by the other measured numbers."""
    return periods(others, tensors), jax.jacfwd(lambda *x: periods(*x[::-1]), (0, 1))(
        tensors, others
    )


def numbers(name, kind, which=0):
    return {key: value[which] for key, value in BICYCLES[name][kind].items()}


@pytest.mark.parametrize("name", NAMES)
def test_published_tensors_give_the_measured_periods(name):
    # Traced: the frame of one bicycle is flatter than any body, by seven deviations of I_yy.
    got = periods(numbers(name, "measured"), numbers(name, "published"))
    wanted = [BICYCLES[name]["measured"][key][0] for key in TIMED]
    np.testing.assert_allclose(got, wanted, rtol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_measured_periods_give_the_published_numbers_with_their_deviations(name):
    measured, width = numbers(name, "measured"), numbers(name, "measured", 1)
    published, stated = numbers(name, "published"), numbers(name, "published", 1)
    unknown = [key for key in published if key.startswith("I")]
    found = {key: 1.1 * published[key] for key in unknown}
    times = np.array([measured[key] for key in TIMED])
    for _ in range(6):  # Newton
        got, (by_tensor, by_other) = slopes(found, measured)
        matrix = np.stack([by_tensor[key] for key in unknown], axis=1)
        step = np.linalg.solve(matrix, times - np.asarray(got))
        found = {key: found[key] + move for key, move in zip(unknown, step, strict=True)}
    # How the tensors answer to each measured number: those on which the periods depend, and the
    # periods themselves.
    rows = np.stack([width[key] * np.asarray(by_other[key]) for key in measured], axis=1)
    rows = np.concatenate([rows, np.diag([width[key] for key in TIMED])], axis=1)
    deviations = np.linalg.norm(np.linalg.solve(matrix, rows), axis=1)
    for deviation, key in zip(deviations, unknown, strict=True):
        # The bars are a tenth of the published deviation, and 5 %.
        assert abs(found[key] - published[key]) < 1e-6 * stated[key], key
        np.testing.assert_allclose(deviation, stated[key], rtol=1e-6, err_msg=key)
    centres = geometry(measured)
    for key in ("xB", "zB", "xH", "zH"):
        np.testing.assert_allclose(centres[key], published[key], rtol=1e-10)
