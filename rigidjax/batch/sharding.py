"""Many bodies in chunks that fit the cache, and in shares for devices, whatever is computed."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import AxisType, Mesh, PartitionSpec as P

from rigidjax import _checks
from rigidjax.rotation.barrier import platform

AXIS = "bodies"
# Bytes of one number of every body in a chunk: the arrays of a step then stay in the first cache,
# of 32 KB on many cores.
_ROW = 512
# JAX's names of what XLA calls prefer_vector_width; only for the outermost jit, only on CPU.
_WIDE = {"xla_cpu_prefer_vector_width": 512}


def compiler_options() -> dict[str, Any]:
    """Options for `jax.jit(f, compiler_options=…)` around code that calls `rigidjax.batch`.

    They enable 512-bit vectors on CPU: 1.5 to 2 times the speed on cores with AVX-512. `rollout`
    and `simulate` use them outside of any transformation. JAX takes options only at the outermost
    `jit`: give them there if it is your own. They are empty unless the backend is CPU.

    >>> bool(jax.jit(lambda x: x + 1, compiler_options=compiler_options())(1.0) == 2)
    True
    """
    return dict(_WIDE) if platform() == "cpu" else {}


class Compiled:
    """A function compiled with `compiler_options`; without, if its last argument is traced."""

    def __init__(self, function: Callable[..., Any]):
        self.function = function
        self._within = eqx.filter_jit(function)

    @functools.cached_property
    def _alone(self) -> Callable[..., Any]:
        # Made when first called: asking which backend there is starts it.
        options, jitted = compiler_options(), cast(Any, eqx.filter_jit)
        return jitted(self.function, compiler_options=options) if options else self._within

    def __call__(self, *args: Any) -> Any:
        return (self._alone if _checks.known(args[-1]) else self._within)(*args)


def mesh_of(devices: Any) -> Mesh | None:
    """A mesh of one axis over `devices`, as for `rollout`; `None` for JAX's default device."""
    if devices is None:
        return None
    if devices == "all":
        devices = jax.local_devices()
    if not isinstance(devices, Sequence) or isinstance(devices, str) or not devices:
        raise ValueError(
            f'devices: wanted None, "all" or a sequence of jax.devices(), got {devices!r}'
        )
    foreign = [d for d in devices if getattr(d, "process_index", None) != jax.process_index()]
    if foreign:
        raise ValueError(
            f"devices: {foreign[0]} is not of this process; each process works on its own share of "
            "the bodies (rigidjax.batch.distributed)"
        )
    # Auto: under Explicit the types of arrays inside would carry the sharding, and lax.map refuses.
    return Mesh(np.array(devices), (AXIS,), axis_types=(AxisType.Auto,))


def chunk_of(chunk: int | None, dtype: Any, count: int) -> int:
    """The number of bodies computed at a time: a full cache on CPU, all of them elsewhere."""
    if chunk is None:
        small = _ROW // np.dtype(dtype).itemsize
        chunk = small if platform() == "cpu" else count
    if not isinstance(chunk, int) or chunk < 1:
        raise ValueError(f"chunk: wanted a positive number of bodies, got {chunk!r}")
    return min(chunk, count)


def over_bodies(
    one: Callable[[Any, Any], Any], shared: Any, each: Any, chunk: int, mesh: Mesh | None
) -> Any:
    """`one(shared, a body's part of each)` for all bodies, stacked along a new first axis.

    Arrays of `each` have a leading axis of bodies. Devices exchange nothing.
    """
    count = jax.tree.leaves(each)[0].shape[0]
    parts = 1 if mesh is None else mesh.devices.size
    share = -(-count // parts)
    chunk = min(chunk, share)
    if chunk == share and platform() != "cpu":
        # XLA gives each thread of a GPU two or four elements of an array of even length: the
        # numbers of as many bodies then do not fit its registers.
        chunk += 1 - chunk % 2
    room = -(-count // (chunk * parts)) * chunk * parts

    def some(shared: Any, each: Any) -> Any:
        def alone(row: Any) -> Any:
            # Fences, so that each chunk gets the same program, to the last bit.
            return lax.optimization_barrier(one(*lax.optimization_barrier((shared, row))))

        return lax.map(alone, each, batch_size=chunk)

    def padded(a: Any) -> Any:
        # The last body again in the empty places.
        return a if room == count else jnp.concatenate([a, jnp.repeat(a[-1:], room - count, 0)])

    filled = jax.tree.map(padded, each)
    if mesh is None:
        out = some(shared, filled)
    else:
        # check_vma: a loop's carry that starts as a constant is not of the varying type it ends as.
        out = jax.shard_map(
            some, mesh=mesh, in_specs=(P(), P(AXIS)), out_specs=P(AXIS), check_vma=False
        )(shared, filled)
    return jax.tree.map(lambda a: a[:count], out)
