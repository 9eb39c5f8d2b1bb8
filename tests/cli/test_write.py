"""`identify --write`: from a log to the body in a file, as a newcomer meets it."""

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rigidjax as rj
from rigidjax.cli.command import main
from rigidjax.identify.answer.answers import Answer

TENSOR = np.array([[3.0, 0.1, -0.2], [0.1, 2.5, 0.3], [-0.2, 0.3, 1.7]]) * 1e-5
MODEL = """<mujoco><worldbody>
  <!-- by hand -->
  <body name="drone">
    <inertial pos="0 0 0.002" mass="0.0319" diaginertia="16e-6 16e-6 30e-6"/>
    <body name="camera"><geom size="0.01"/></body>
  </body>
</worldbody></mujoco>
"""
# The log's axes in those of the drone.
MOUNT = Rotation.from_euler("XYZ", [0.3, -0.5, 1.2])


@pytest.fixture(scope="module")
def log():
    """A throw of the drone, whose gyro is mounted askew."""
    rng, ts = np.random.default_rng(3), np.arange(0.0, 2.0, 0.01)
    inside = MOUNT.as_matrix().T @ TENSOR @ MOUNT.as_matrix()
    motion = rj.simulate(rj.Inertia(inside), rj.Spin([6.0, 2.0, -4.0]), ts)
    rates = np.asarray(motion.ys.omega) + 1e-3 * rng.normal(size=(ts.size, 3))
    rows = "\n".join(",".join(map(str, row)) for row in np.column_stack([ts, rates]))
    return "t,wx,wy,wz\n" + rows


@pytest.fixture(scope="module")
def found():
    ts = np.linspace(0.0, 10.0, 60)
    motion = rj.simulate(rj.Inertia.from_principal(1.0, 2.0, 2.5), rj.Spin([1, 0.1, 1.0]), ts)
    record = rj.identify.Recording(ts, (rj.identify.Gyro(0.01), motion.ys.omega))
    return rj.identify.fit(rj.identify.Model(record, rj.identify.PrincipalRatios()), starts=1)


@pytest.fixture
def folder(tmp_path, log, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("throw.csv").write_text(log)
    Path("drone.xml").write_text(MODEL)
    return tmp_path


def run(*options):
    return main(["identify", "throw.csv", "--write", "drone.xml", "--starts", "1", *options])


def test_a_body_goes_from_a_log_into_the_file_and_only_by_yes(folder, capsys):
    mount = ["--mount", "0", "0", "0.1", *map(str, MOUNT.as_quat(scalar_first=True))]
    assert run(*mount) == 0
    said = capsys.readouterr().out
    assert Path("drone.xml").read_text() == MODEL
    assert "drone.xml is not changed: --yes changes it" in said
    assert "only ratios are known: the sum of the moments stays that of the file, 6.2e-05" in said
    old, new = (line for line in said.splitlines() if "<inertial " in line)
    assert old[0] == "-" and new[0] == "+" and 'mass="0.0319"' in new
    # The first is the error of the new body, and the noise is 1e-3 rad/s on each axis.
    (line,) = (line for line in said.splitlines() if line.startswith("held-out error"))
    new, before = (float(one.split()[0]) for one in line.split(": ")[1].split(", "))
    assert 1.5e-3 < new < 2.1e-3 and before > 1.0
    assert run(*mount, "--yes") == 0
    assert "drone.xml is changed" in capsys.readouterr().out
    text = Path("drone.xml").read_text()
    assert "<!-- by hand -->" in text and '<body name="camera"><geom size="0.01"/></body>' in text
    body = rj.body.read_inertials("drone.xml")["drone"]
    wanted = TENSOR / TENSOR.trace() * 62e-6
    np.testing.assert_allclose(body.inertia.tensor, wanted, atol=2e-7)
    assert (body.mass, body.com[2]) == (0.0319, 0.002)


def test_without_trust_it_is_said(folder, capsys, monkeypatch, found):
    """The fit leaves a part of the readings, and the body of the file is no real one."""
    Path("drone.xml").write_text(MODEL.replace("30e-6", "90e-6"))
    unsure = dataclasses.replace(found.assessment, explanation=Answer("leaves a part", ("why",)))
    unsure, asked = dataclasses.replace(found, assessment=unsure), []
    monkeypatch.setattr(rj.identify, "fit", lambda _, **how: asked.append(how["before"]) or unsure)
    assert run("--yes") == 1 and asked == [None]
    said = capsys.readouterr().out
    assert "rad/s by the new body, none (no real body) by that of the file\n" in said
    assert "this body is not to be trusted: search: found; model: leaves a part" in said
    assert "drone.xml is changed" in said and Path("drone.xml").read_text() != MODEL


def test_a_body_of_which_the_log_shows_a_part_is_not_written(folder, capsys, monkeypatch, found):
    unseen = dataclasses.replace(
        found.uncertainty, covariance=found.covariance.at[0, 0].set(jnp.inf)
    )
    unseen = dataclasses.replace(found, uncertainty=unseen)
    monkeypatch.setattr(rj.identify, "fit", lambda *_, **__: unseen)
    assert run("--yes") == 2
    assert "drone.xml is not changed: the log does not determine" in capsys.readouterr().err
    assert Path("drone.xml").read_text() == MODEL


WRONG = [
    (["--write", "drone.xml", "--body", "dron"], "drone.xml: no body 'dron'; there are drone, camera"),
    (["--write", "drone.xml", "--body", "camera"], "'camera': wanted an <inertial>, got none; its mass must stand in"),
    (["--write", "drones.xml"], "drones.xml: no such file"),
    (["--write", "throw.csv"], "--write: throw.csv is already the FILE"),
    (["--write", "two.toml"], "two.toml: wanted --body NAME; there are a, b"),
    (["--write", "drone.xml", "--mount", *"0001111"], "--mount: wanted a unit quaternion QW QX QY QZ, got one of length 2"),
    (["--body", "drone"], "--body, --mount, --yes: wanted a --write FILE beside them"),
    (["--yes"], "--yes: wanted a --write FILE beside them"),
]  # fmt: skip


@pytest.mark.parametrize(("options", "words"), WRONG)
def test_mistakes_are_told_before_the_fit(options, words, folder, capsys, monkeypatch):
    monkeypatch.setattr(rj.identify, "fit", None)
    Path("two.toml").write_text("a = {mass = 1, J = [1, 1, 1]}\nb = {mass = 1, J = [1, 1, 1]}\n")
    try:
        code = main(["identify", "throw.csv", *options])
    except SystemExit as error:
        code = error.code
    assert code == 2 and words in capsys.readouterr().err
    assert Path("drone.xml").read_text() == MODEL
