"""The end of a motion in more digits than JAX has: `extrapolated.c`, compiled on the spot."""

import ctypes
import functools
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

SOURCE = Path(__file__).with_suffix(".c")
# The numbers of a row, in their order, and how many each has.
ROW = {
    "mu": 1,
    "tensor": 9,
    "com": 3,
    "gravity": 3,
    "damping": 3,
    "wheel": 3,
    "gradient": 1,
    "towards": 3,
    "edges": 7,
    "torques": 18,
    "time": 1,
}


@functools.cache
def library(quad):
    """With 64 bits of mantissa, or with 113 at thirty times the time."""
    compiler = shutil.which("gcc")
    if compiler is None:
        raise RuntimeError("the truth needs a C compiler: gcc was not found")
    path = Path(tempfile.mkdtemp()) / "extrapolated.so"
    options = ["-DQUAD"] if quad else []
    libraries = ["-lquadmath", "-lm"] if quad else ["-lm"]
    subprocess.run(
        [compiler, "-O2", "-shared", "-fPIC", *options, "-o", path, SOURCE, *libraries], check=True
    )
    return ctypes.CDLL(str(path))


def ends(numbers, start, *, quad=False, tol=None):
    """States (many, 7 of a body, 6 of an orbit) at `time`, and what doubles cannot hold of them.

    `numbers` by the names of `ROW`, those that are left out zero; `start` (many, 7 or 6).
    """
    start = np.ascontiguousarray(start, dtype=np.float64)
    many, size = start.shape
    rows = np.zeros((many, sum(ROW.values())))
    begin = 0
    for name, width in ROW.items():
        rows[:, begin : begin + width] = np.reshape(
            numbers.get(name, 0.0), (-1, width) if name in numbers else (1, 1)
        )
        begin += width
    out = np.zeros((many, size, 2))
    pointer = ctypes.POINTER(ctypes.c_double)
    at = [a.ctypes.data_as(pointer) for a in (rows, start, out)]
    tol = (1e-22 if quad else 2e-17) if tol is None else tol
    library(quad).solved(
        ctypes.c_long(many), at[0], at[1], ctypes.c_int(size), at[2], ctypes.c_double(tol)
    )
    return out[..., 0], out[..., 1]
