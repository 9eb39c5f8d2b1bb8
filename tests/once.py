"""`jax.jit` and `eqx.filter_jit` for large programs that run for a moment, as derivatives of runs do.

The same program as a user's down to LLVM, whose optimisations take longer than all the rest here.
Not for what is measured in units of round-off: LLVM chooses how sums are rounded.
"""

import functools

import equinox as eqx
import jax

OPTIONS = {"xla_backend_optimization_level": 0}

once = functools.partial(jax.jit, compiler_options=OPTIONS)
filter_once = functools.partial(eqx.filter_jit, compiler_options=OPTIONS)
