"""Elliptic functions and integrals: the public face, `rj.elliptic`.

Jacobi's functions (`jacobi.py`), Legendre's integrals (`legendre.py`), Carlson's (`carlson.py`).
Everything takes the parameter m = k², as SciPy and mpmath do, and optionally its complement
m1 = 1 − m, without which nothing can be right as m → 1: 1 − m rounds to 0 there.

All functions follow their arguments' dtype (float32 or float64), broadcast, and work under `jit`
and `vmap`. Derivatives of every order, forward and reverse, in every argument, are written down
as functions of the same families; no iteration is differentiated, and all loops have a length
fixed by the dtype.
"""

from rigidjax._names import show
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

show(__name__)
