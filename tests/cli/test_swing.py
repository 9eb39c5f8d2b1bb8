"""A moment of inertia from a period, by the command line."""

import math
import re

import numpy as np
import pytest

import rigidjax as rj
from rigidjax.cli.command import main

G = 9.80665


def said(capsys, *words):
    assert main(["swing", "--suspension", *words]) == 0
    lines = capsys.readouterr().out.splitlines()
    answer = "\n".join(line for line in lines if line.startswith(("moment", "about")))
    return [
        float(n) for n in re.findall(r"(?<![\w])\d+\.?\d*(?:e-?\d+)?(?= kg| …|$)", answer, re.M)
    ]


@pytest.mark.parametrize(("kind", "number"), [("bifilar", 2), ("trifilar", 3)])
def test_strings_give_back_the_moment_of_a_known_body(kind, number, capsys):
    plate = rj.shapes.box(1.2, [0.3, 0.2, 0.02])
    hung = rj.suspensions.Strings(number, 0.12, 0.1, 0.4)
    period = float(rj.suspensions.period(plate, hung, 0.6))
    size = f"{kind} --mass 1.2 --radius 0.1 --radius-above 0.12 --length 0.4 --amplitude 0.6"
    found = said(capsys, *f"{size} --period {period!r}".split())
    np.testing.assert_allclose(found[0], plate.inertia.tensor[2, 2], rtol=1e-5)
    found = said(
        capsys, *f"{size} --period {period!r} --sigma period=1e-3 --sigma length=2e-4".split()
    )
    # dI/I = 2 dT/T and, to first order, dI/I = −dl/l.
    width = 1.96 * found[0] * math.hypot(2e-3 / period, 2e-4 / 0.4)
    np.testing.assert_allclose([found[0] - found[1], found[2] - found[0]], width, rtol=0.05)


def test_an_axle_and_a_torsion_bar(capsys):
    period = 2 * math.pi * math.sqrt((0.02 + 0.5 * 0.3**2) / (0.5 * G * 0.3))
    found = said(capsys, *f"axle --mass 0.5 --arm 0.3 --period {period!r}".split())
    np.testing.assert_allclose(found, [0.02, 0.065], rtol=1e-5)
    found = said(capsys, *"torsion --stiffness 0.4 --period 2.0".split())
    np.testing.assert_allclose(found, [0.4 / math.pi**2], rtol=1e-5)


@pytest.mark.parametrize(
    ("words", "answer"),
    [
        ("axle --mass 0.5 --period 1.0", "--suspension axle needs --arm"),
        ("axle --mass 0.5 --arm 0.3 --period 0.1", "no moment of inertia has so short a period"),
        ("torsion --stiffness 0.4 --period 2.0 --sigma mass=0.1", "wanted NAME=NUMBER"),
        (
            "torsion --stiffness 0.4 --period 2.0 --amplitude 4",
            "amplitude: wanted an angle below π",
        ),
    ],
)
def test_mistakes_are_told(words, answer, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["swing", "--suspension", *words.split()])
    assert ended.value.code == 2 and answer in capsys.readouterr().err


def test_a_log_of_a_gyro(tmp_path, capsys):
    """A pendulum that comes to rest, seen by a gyro with a bias in axes of its own."""
    axis, side = np.array([0.48, -0.6, 0.64]), np.array([0.8, 0.0, -0.6])
    club = rj.shapes.box(0.8, [0.05, 0.1, 0.5]).shift(0.25 * side)
    law = rj.suspensions.Axle(axis, np.zeros(3), G * side, friction=rj.suspensions.Friction(4e-3))
    ts = np.linspace(0.0, 15.0, 500)
    rate = np.asarray(rj.simulate(club, rj.Turn(0.7, 0.0), ts, law).ys.rate)
    random = np.random.default_rng(2)
    read = np.rad2deg(rate[:, None] * axis + 0.1 * random.normal(size=(500, 3)) + 0.02)
    log = tmp_path / "swing.csv"
    head = dict(delimiter=",", header="t,wx,wy,wz", comments="")
    np.savetxt(log, np.c_[ts, read], **head)
    words = f"axle --mass 0.8 --arm 0.25 --log {log} --unit deg/s".split()
    moment = float(axis @ club.inertia.tensor @ axis)
    found, low, high, about = said(capsys, *words)
    assert low < moment < high and abs(about - found - 0.05) < 1e-6
    assert high - low < 0.02 * moment
    # An arm that is less sure: I = m g d/ω² − m d², at a fixed ω.
    _, least, most, _ = said(capsys, *words, "--sigma", "arm=0.001")
    wide = np.hypot(high - low, 2 * 1.96 * 0.001 * (about / 0.25 - 2 * 0.8 * 0.25))
    np.testing.assert_allclose(most - least, wide, rtol=0.01)
