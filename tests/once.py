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


class _Once:
    """A compiled function of the library, by `once` where it is outermost: only that takes options."""

    asked = False

    def __init__(self, usual, quick):
        functools.update_wrapper(self, usual)
        self._usual, self._quick = usual, quick

    def __call__(self, *args, **kwargs):
        given = jax.tree.leaves((args, kwargs))
        within = any(isinstance(leaf, jax.core.Tracer) for leaf in given)
        return (self._usual if within or not _Once.asked else self._quick)(*args, **kwargs)

    def __getattr__(self, name):
        return getattr(self._usual, name)


def library_programs(packages):
    """From here on `eqx.filter_jit` in modules of these packages is `filter_once`, if asked for."""
    usual = eqx.filter_jit

    def filter_jit(fun=None, **options):
        if fun is None or options or not getattr(fun, "__module__", "").startswith(packages):
            return usual(**options) if fun is None else usual(fun, **options)
        return _Once(usual(fun), filter_once(fun))

    eqx.filter_jit = filter_jit
    return usual


def ask(for_it):
    _Once.asked = for_it
