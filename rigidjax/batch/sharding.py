"""Map a function of one body over many bodies, divided among devices and into chunks.

A chunk is the bodies that a device computes at a time; on CPU its arrays fit into the cache.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, cast

import diffrax as dfx
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
# The type of the argument `devices`: `None` is JAX's default device, and "all" stands for all
# devices of this process.
Devices = Literal["all"] | Sequence[jax.Device] | None
# The size, in bytes, of an array with one number for each body of a chunk. With this size the
# arrays of a step stay in the first-level cache, which holds 32 KB on many cores.
_ROW = 512
# On a GPU a chunk may use this share of the memory for the record from which derivatives in reverse
# mode are computed. These derivatives themselves need about as much again.
_SHARE = 0.25
# The record of fewer bodies than this takes about a gigabyte or less; its size is not computed.
_FEW = 10_000
# JAX takes this option of XLA only at the outermost jit, and it exists only on CPU.
_WIDE = {"xla_cpu_prefer_vector_width": 512}


def compiler_options() -> dict[str, Any]:
    """Return the best options for `jax.jit(f, compiler_options=…)` of an `f` that calls
    `rigidjax.batch`.

    The options enable 512-bit vectors on CPU, which give 1.5 to 2 times the speed on cores with
    AVX-512; on other backends the dict is empty. If `rollout` and `simulate` are called outside of
    any transformation, they use the options without being asked. JAX takes options only at the
    outermost `jit`: if you wrap the call in a `jit` of your own, give the options there.

    >>> bool(jax.jit(lambda x: x + 1, compiler_options=compiler_options())(1.0) == 2)
    True
    """
    return dict(_WIDE) if platform() == "cpu" else {}


class CompiledFunction:
    """Call a function under `jit`, with the options of `compiler_options` unless the last argument
    is traced: JAX takes options only at the outermost `jit`.
    """

    def __init__(self, function: Callable[..., Any]):
        self.function = function
        self._plain = eqx.filter_jit(function)

    @functools.cached_property
    def _with_options(self) -> Callable[..., Any]:
        """Return the function under `jit`, with the options if there are any."""
        # The options are looked up at the first call of the function and not at import, because
        # `compiler_options` starts JAX's backend.
        options, jit = compiler_options(), cast(Any, eqx.filter_jit)
        return jit(self.function, compiler_options=options) if options else self._plain

    def __call__(self, *args: Any) -> Any:
        known = _checks.is_known(args[-1])
        return (self._with_options if known else self._plain)(*args)


def mesh_of(devices: Devices) -> Mesh | None:
    """Return a mesh of one axis over devices of this process, or `None` for the default device."""
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
    # The axis is `Auto`: with an `Explicit` axis the types of arrays contain the sharding, which
    # `lax.map` does not accept.
    return Mesh(np.array(devices), (AXIS,), axis_types=(AxisType.Auto,))


class Division(NamedTuple):
    """Describe how the bodies of a batch are divided among devices and into chunks."""

    chunk: int  # the number of bodies that each device computes at a time
    mesh: Mesh | None  # the devices, which exchange nothing, or None for the default device
    progress_meter: dfx.AbstractProgressMeter  # which is moved after each chunk


def divide_batch(
    chunk: int | None,
    devices: Devices,
    progress_meter: dfx.AbstractProgressMeter | None,
    dtype: np.dtype,
    num_bodies: int,
) -> Division:
    """Return how a batch is divided, by checked arguments of `rollout` and its dtype."""
    if progress_meter is not None and devices is not None:
        raise ValueError(
            "progress_meter: wanted devices=None, since several devices would move one meter; got "
            f"devices={devices!r}"
        )
    meter = dfx.NoProgressMeter() if progress_meter is None else progress_meter
    if not isinstance(meter, dfx.AbstractProgressMeter):
        raise TypeError(
            "progress_meter: wanted a diffrax.AbstractProgressMeter such as "
            f"diffrax.TextProgressMeter(), got {type(meter).__name__}"
        )
    return Division(chunk_size(chunk, dtype, num_bodies), mesh_of(devices), meter)


def chunk_size(chunk: int | None, dtype: np.dtype, num_bodies: int) -> int:
    """Return the number of bodies that a device computes at a time, at most all: `chunk`, or, for
    `None`, on CPU as many as fill the cache.
    """
    if chunk is None:
        small = _ROW // np.dtype(dtype).itemsize
        chunk = small if platform() == "cpu" else num_bodies
    if not isinstance(chunk, int) or chunk < 1:
        raise ValueError(f"chunk: wanted a positive number of bodies, got {chunk!r}")
    return min(chunk, num_bodies)


def share_of(division: Division, per_body: PyTree) -> int:
    """Return the number of bodies that each device computes."""
    count = jax.tree.leaves(per_body)[0].shape[0]
    return -(-count // (1 if division.mesh is None else division.mesh.devices.size))


def fit_chunk(
    division: Division, function: Callable[[Any, Any], Any], shared: PyTree, per_body: PyTree
) -> Division:
    """Return the division with chunks that fit the memory of a GPU, if all bodies of a device would
    be computed at once, for the arguments of `map_bodies`.

    The memory is that of the record from which derivatives in reverse mode are computed. Its size
    for one body is found without running anything. On CPU, and for a few thousand bodies, the
    `division` is returned unchanged.
    """
    share = share_of(division, per_body)
    if platform() == "cpu" or share < _FEW or division.chunk < share:
        return division
    row = jax.tree.map(lambda a: a[0], per_body)
    record = jax.eval_shape(lambda *args: jax.vjp(function, *args)[1], shared, row)
    size = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(record))
    fitting = _SHARE * memory_of(division.mesh) / size
    if fitting >= share:
        return division
    # The length of a chunk is odd for the reason given in `map_bodies`.
    return division._replace(chunk=max(1, int(fitting) - 1 + int(fitting) % 2))


def memory_of(mesh: Mesh | None) -> float:
    """Return how many bytes JAX may use on a device, or infinity if it does not know."""
    default: Any = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]
    chosen = default if isinstance(default, jax.Device) else jax.devices()[0]
    device = chosen if mesh is None else mesh.devices.flat[0]
    return (device.memory_stats() or {}).get("bytes_limit", np.inf)


def map_bodies(
    function: Callable[[Any, Any], Any],
    shared: PyTree,
    per_body: PyTree,
    division: Division,
) -> PyTree:
    """Return `function(shared, row)` of every body, stacked along a new first axis, where `row` is
    one row of the arrays `per_body`.
    """
    chunk, mesh, meter = division
    count = jax.tree.leaves(per_body)[0].shape[0]
    parts = 1 if mesh is None else mesh.devices.size
    share = share_of(division, per_body)
    chunk = min(chunk, share)
    if chunk == share and platform() != "cpu":
        # The length of the chunk is made odd: of an array of even length XLA gives each thread of a
        # GPU two or four elements, and the numbers of two or four bodies do not fit into the
        # registers of a thread.
        chunk += 1 - chunk % 2
    room = -(-count // (chunk * parts)) * chunk * parts

    def map_share(shared: PyTree, rows: PyTree) -> PyTree:
        def call(row: PyTree) -> PyTree:
            # With these barriers XLA makes the same program of each chunk, so that a body has the
            # same results, to the last bit, in every chunk.
            return lax.optimization_barrier(function(*lax.optimization_barrier((shared, row))))

        chunks = jax.tree.map(lambda a: a.reshape(-1, chunk, *a.shape[1:]), rows)
        total = jax.tree.leaves(chunks)[0].shape[0]

        def call_chunk(state: PyTree, numbered: tuple[Array, PyTree]) -> tuple[PyTree, PyTree]:
            number, rows = numbered
            out = jax.vmap(call)(rows)
            return meter.step(state, (number + 1) / total), out

        state, out = lax.scan(call_chunk, meter.init(), (jnp.arange(total), chunks))
        meter.close(state)
        return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), out)

    def pad(a: Array) -> Array:
        # The rows that fill the last chunk repeat the last body.
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
