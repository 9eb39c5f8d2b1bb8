"""Gravity on a `Spin` is an error that a type checker sees, and one in words at run time."""

import shutil
import subprocess
import sys

import pytest

import rigidjax as rj

HEAD = """import rigidjax as rj
body = rj.Inertia.from_principal(1.0, 2.0, 3.0)
top = rj.torques.HeavyTop(1.0, [0.0, 0, 1], [0.0, 0, -9.81])
spin, at = rj.Spin([0.0, 1, 0]), rj.Attitude([1.0, 0, 0, 0], [0.0, 1, 0])
"""
RIGHT = """
q = rj.simulate(body, at, [0.0, 1.0], top).ys.q
omega = rj.simulate(body, spin, [0.0, 1.0], rj.torques.Damping([1.0, 1, 1])).ys.omega
rj.simulate(body, at, [0.0, 1.0], rj.torques.Sum(top, rj.torques.Damping([1.0, 1, 1])))
rj.simulate(body, at, [0.0, 1.0], lambda t, state, body: -state.omega)
rj.simulate(None, rj.Point([1.0, 0, 0], [0.0, 1, 0]), [0.0, 1.0], rj.orbits.hill(0.1))
"""
WRONG = ["rj.simulate(body, spin, [0.0, 1.0], top)", "rj.simulate(body, spin, [0.0, 1.0]).ys.q"]


def test_at_run_time():
    start, top = rj.Spin([0.0, 1, 0]), rj.torques.HeavyTop(1.0, [0.0, 0, 1], [0.0, 0, -9.81])
    with pytest.raises(TypeError, match="HeavyTop needs a state with HasAttitude"):
        rj.simulate(rj.Inertia.from_principal(1.0, 2.0, 3.0), start, [0.0, 1.0], top)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("pyright") is None, reason="pyright is not installed")
def test_before_it_runs(tmp_path):
    def complaints(text):
        path = tmp_path / "snippet.py"
        path.write_text(HEAD + text)
        done = subprocess.run(
            ["pyright", "--pythonpath", sys.executable, str(path)], capture_output=True, text=True
        )
        return done.stdout

    assert "0 errors" in complaints(RIGHT)
    found = complaints("\n".join(WRONG))
    assert "2 errors" in found
    assert '"HeavyTop" cannot be assigned to parameter "torque"' in found
    assert 'attribute "q" for class "Spin"' in found
