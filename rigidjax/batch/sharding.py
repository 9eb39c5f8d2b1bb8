"""Map a function of one body over many: in shares for devices, in chunks that fit the cache."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, Literal, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import AxisType, Mesh, PartitionSpec as P
from jaxtyping import Array, PyTree

from rigidjax import _checks
from rigidjax.rotation.barrier import platform

AXIS = "bodies"
# No device: JAX's default one.
Devices = Literal["all"] | Sequence[jax.Device] | None
# Bytes of an array with one number for each body of a chunk. The arrays of a step then stay in the
# first-level cache, which holds 32 KB on many cores.
_ROW = 512
# JAX takes this option of XLA only at the outermost jit, and it exists only on CPU.
_WIDE = {"xla_cpu_prefer_vector_width": 512}


def compiler_options() -> dict[str, Any]:
    """Return options for `jax.jit(f, compiler_options=…)` around calls of `rigidjax.batch`.

    The options enable 512-bit vectors on CPU, which give 1.5 to 2 times the speed on cores with
    AVX-512; on other backends there are none. `rollout` and `simulate` use them by themselves if
    they are called outside of any transformation. JAX takes options only at the outermost `jit`: if
    that is your own, give them there.

    >>> bool(jax.jit(lambda x: x + 1, compiler_options=compiler_options())(1.0) == 2)
    True
    """
    return dict(_WIDE) if platform() == "cpu" else {}


class CompiledFunction:
    """Call a compiled function; it has the `compiler_options` if its last argument is known.

    Where that argument is traced, the call stands within another `jit`, where JAX takes no options.
    """

    def __init__(self, function: Callable[..., Any]):
        self.function = function
        self._without_options = eqx.filter_jit(function)

    @functools.cached_property
    def _with_options(self) -> Callable[..., Any]:
        # Made at the first call, since the question which backend there is starts the backend.
        options, jit = compiler_options(), cast(Any, eqx.filter_jit)
        return jit(self.function, compiler_options=options) if options else self._without_options

    def __call__(self, *args: Any) -> Any:
        known = _checks.is_known(args[-1])
        return (self._with_options if known else self._without_options)(*args)


def mesh_of(devices: Devices) -> Mesh | None:
    """Return a mesh of one axis over `devices` (see `rollout`); `None` for the default device."""
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
            f"devices: {foreign[0]} belongs to another process; each process computes its share of "
            "the bodies on its own devices (rigidjax.batch.distributed)"
        )
    # Axes are Auto: with Explicit axes the types of arrays carry the sharding, which `lax.map` does
    # not accept.
    return Mesh(np.array(devices), (AXIS,), axis_types=(AxisType.Auto,))


def chunk_of(chunk: int | None, dtype: np.dtype, count: int) -> int:
    """Return the number of bodies that are computed at a time, out of `count`.

    This is `chunk`; for `None` as many as fill the cache on CPU, and all on other backends.
    """
    if chunk is None:
        small = _ROW // np.dtype(dtype).itemsize
        chunk = small if platform() == "cpu" else count
    if not isinstance(chunk, int) or chunk < 1:
        raise ValueError(f"chunk: wanted a positive number of bodies, got {chunk!r}")
    return min(chunk, count)


def map_bodies(
    function: Callable[[Any, Any], Any],
    shared: PyTree,
    per_body: PyTree,
    chunk: int,
    mesh: Mesh | None,
) -> PyTree:
    """Return `function(shared, row)` for the row of each body, stacked along a new first axis.

    Arrays of `per_body` have a leading axis of bodies. `chunk` bodies are computed at a time on
    each device of `mesh`. Devices exchange nothing.
    """
    count = jax.tree.leaves(per_body)[0].shape[0]
    parts = 1 if mesh is None else mesh.devices.size
    share = -(-count // parts)
    chunk = min(chunk, share)
    if chunk == share and platform() != "cpu":
        # XLA gives each thread of a GPU two or four elements of an array of even length, and the
        # numbers of two or four bodies do not fit into the registers of a thread.
        chunk += 1 - chunk % 2
    room = -(-count // (chunk * parts)) * chunk * parts

    def map_share(shared: PyTree, rows: PyTree) -> PyTree:
        def call(row: PyTree) -> PyTree:
            # With these barriers XLA makes the same program of each chunk, so that a body has the
            # same results, to the last bit, in every chunk.
            return lax.optimization_barrier(function(*lax.optimization_barrier((shared, row))))

        return lax.map(call, rows, batch_size=chunk)

    def pad(a: Array) -> Array:
        # The empty places repeat the last body.
        return a if room == count else jnp.concatenate([a, jnp.repeat(a[-1:], room - count, 0)])

    rows = jax.tree.map(pad, per_body)
    if mesh is None:
        out = map_share(shared, rows)
    else:
        # With check_vma=True a loop is refused if its carry starts as a constant, which all devices
        # share, and ends with values that differ between devices.
        out = jax.shard_map(
            map_share, mesh=mesh, in_specs=(P(), P(AXIS)), out_specs=P(AXIS), check_vma=False
        )(shared, rows)
    return jax.tree.map(lambda a: a[:count], out)
