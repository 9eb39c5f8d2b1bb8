"""Compute elliptic functions and integrals: Jacobi's functions, Legendre's and Carlson's integrals.

The parameter is m = k², as in SciPy and mpmath. Its complement m1 = 1 − m is an optional argument,
because the difference 1 − m loses its digits as m → 1 and finally rounds to 0. Results have the
dtype of the arguments (float32 or float64), and the shapes of the arguments are broadcast.
Derivatives of every order, in forward and reverse mode and with respect to every argument, are
functions of the same families: no iteration is differentiated, and the dtype fixes the length of
every loop. **Raises:** `TypeError` for half precision, `ValueError` for shapes that do not
broadcast, and if m + m1 ≠ 1.
"""

from rigidjax._names import define_dir_and_getattr
from rigidjax.elliptic.carlson import rc as rc, rd as rd, rf as rf, rj_ as rj_
from rigidjax.elliptic.jacobi import am as am, sncndn as sncndn
from rigidjax.elliptic.legendre import (
    ellipe as ellipe,
    ellipeinc as ellipeinc,
    ellipf as ellipf,
    ellipk as ellipk,
    ellippi as ellippi,
    ellippiinc as ellippiinc,
)

__all__ = [
    "am", "ellipe", "ellipeinc", "ellipf", "ellipk", "ellippi", "ellippiinc", "rc", "rd", "rf",
    "rj_", "sncndn",
]  # fmt: skip

define_dir_and_getattr(__name__)
