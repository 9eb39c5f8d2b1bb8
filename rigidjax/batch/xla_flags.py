"""The one process-wide setting that speeds up long runs of single bodies on CPU."""

import os
from typing import NamedTuple

import jax

_OPTION = "xla_cpu_small_while_loop_byte_threshold"
_FLAG = f"--xla_backend_extra_options={_OPTION}=10000000"
# The versions of the measurement: `python tests/batch/bench_batch.py --flag`.
CHECKED = ("0.12.0.1",)


class CpuFlags(NamedTuple):
    """The result of `cpu_flags`.

    **Fields:** `xla_flags` the value for the environment variable `XLA_FLAGS`, with its present
    contents; `set` whether the flag is there; `checked` versions of jaxlib it was measured on;
    `jaxlib` the one in use.
    """

    xla_flags: str
    set: bool
    checked: tuple[str, ...]
    jaxlib: str

    def __str__(self) -> str:
        state = "set" if self.set else "not set"
        known = "" if self.jaxlib in self.checked else f"; not checked on jaxlib {self.jaxlib}"
        return f"export XLA_FLAGS='{self.xla_flags}'    # {state}{known}"


def cpu_flags() -> CpuFlags:
    """The flag to export before Python starts, for loops over one or few bodies on CPU.

    XLA compiles a small loop as one kernel; this undocumented option sets the limit of small. It
    helps if the loop's state is larger than a kilobyte and the arrays are short: on jaxlib 0.12.0.1
    a `rollout` of one free body took 0.45 of the time; of many bodies it is as fast without. It
    acts on the whole process, and only if it is there before JAX first looks for devices. This
    function sets nothing. **Returns** a `CpuFlags`.

    >>> print(cpu_flags().xla_flags.split()[-1])
    --xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=10000000
    """
    import jaxlib

    given = os.environ.get("XLA_FLAGS", "")
    there = _OPTION in given
    wanted = given if there else f"{given} {_FLAG}".strip()
    return CpuFlags(wanted, there, CHECKED, getattr(jaxlib, "__version__", jax.__version__))
