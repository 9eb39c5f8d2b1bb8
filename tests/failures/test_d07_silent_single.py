"""Row D7: without 64 bits switched on, float64 numbers become float32; that is said, once."""

import os
import subprocess
import sys

PROGRAM = """
import warnings
import numpy as np
with warnings.catch_warnings(record=True) as heard:
    warnings.simplefilter("always")
    import rigidjax as rj
    body = rj.Inertia.from_principal(1.0, 2.0, 3.0)
    before = len([w for w in heard if "float32" in str(w.message)])
    for _ in range(2):
        start = rj.Spin(np.array([0.0, 1.0, 0.01]))
        out = rj.simulate(body, start, np.linspace(0.0, 1.0, 3))
    said = [str(w.message) for w in heard if "float32" in str(w.message)]
assert before == 0, said
assert len(said) == 1 and "jax_enable_x64" in said[0], said
assert out.ys.omega.dtype == np.float32

# Row D8: two times that float32 takes for one.
try:
    rj.simulate(body, start, [1.7e9, 1.7e9 + 1])
    raise AssertionError("not refused")
except ValueError as error:
    assert "increasing times" in str(error) and "float32, which cannot tell" in str(error), error

# A recording keeps its times as a fit uses them.
rates = rj.identify.Gyro(), np.ones((80, 3), np.float32)
try:
    rj.identify.Recording(1.7e9 + np.linspace(0.0, 10.0, 80), rates)
    raise AssertionError("not refused")
except ValueError as error:
    assert "float32 changes the step of 0.127 s" in str(error), error
with warnings.catch_warnings(record=True) as heard:
    warnings.simplefilter("always")
    rj.identify.Recording(1e4 + np.linspace(0.0, 10.0, 80), rates)
    assert not heard, heard
    rj.identify.Recording(1e6 + np.linspace(0.0, 10.0, 80), rates)
assert "count time from a later origin" in str(heard[0].message), heard
"""


def test_one_warning_for_numbers_that_lose_half_their_digits():
    environment = {k: v for k, v in os.environ.items() if k != "JAX_ENABLE_X64"}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, env=environment
    )
    assert done.returncode == 0, done.stderr
