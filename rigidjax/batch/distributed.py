"""Several hosts: each works on its own share of the bodies; only results are sent.

The results of a share are the same bits as on one process alone.
"""

import os
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils

from rigidjax import _checks
from rigidjax._names import show


def connect(address: str, processes: int, process: int, *, patience: int = 20) -> None:
    """Join the other processes; call it before anything else of JAX.

    **Arguments:** `address` "host:port" of process 0; `processes` their number; `process` the index
    of this one, from 0; `patience` s after which a process without an answer counts as dead: every
    process then ends, with a message and a non-zero exit code.

    **Raises:** `ValueError` for an index out of range; `RuntimeError` if JAX is in use already or
    the others do not answer.

    >>> connect("localhost:1234", 2, 2)
    Traceback (most recent call last):
    ValueError: process: wanted a number from 0 to 1, got 2
    """
    if processes < 1 or not 0 <= process < processes:
        raise ValueError(f"process: wanted a number from 0 to {processes - 1}, got {process}")
    if ":" not in address:
        raise ValueError(f'address: wanted "host:port" of process 0, got {address!r}')
    jax.distributed.initialize(
        address, processes, process, initialization_timeout=3 * patience,
        heartbeat_timeout_seconds=patience, shutdown_timeout_seconds=patience,
    )  # fmt: skip


def share(tree: Any) -> Any:
    """This process's rows of a tree of arrays, ⌈N / processes⌉ or fewer.

    **Arguments:** `tree` of arrays with a leading axis of bodies; leave out what all bodies share.

    **Raises:** `ValueError` for fewer bodies than processes.

    >>> share(jnp.arange(5)).shape
    (5,)
    """
    many, here = jax.process_count(), jax.process_index()
    leaves = jax.tree.leaves(tree)
    if not all(np.ndim(leaf) > 0 and hasattr(leaf, "shape") for leaf in leaves):
        raise TypeError("share: wanted a tree of arrays with a leading axis of bodies")
    counts = {leaf.shape[0] for leaf in leaves}
    if len(counts) != 1:
        raise ValueError(f"share: wanted one number of bodies, got {sorted(counts)}")
    count = counts.pop()
    if count < many:
        raise ValueError(f"share: {count} bodies for {many} processes; start fewer processes")
    edges = [count * i // many for i in range(many + 1)]
    return jax.tree.map(lambda leaf: leaf[edges[here] : edges[here + 1]], tree)


def gather(tree: Any, checkpoint: str | os.PathLike[str] | None = None) -> Any:
    """All processes' rows, on every process, in order.

    **Arguments:** `tree` arrays with this process's rows, as from `share`; `checkpoint` a folder to
    `save` them to first. **Returns** the tree with the rows of all, in host memory.

    **Raises:** `TypeError` for traced arrays; `RuntimeError` if another process has ended. This
    process should end then: JAX's arrays are of no use any more.

    >>> gather(jnp.arange(3)).tolist()
    [0, 1, 2]
    """

    def rows_of_all(leaf: Any) -> np.ndarray:
        # Shares differ by a row at most: fill up, send, cut.
        rows = np.asarray(leaf)
        counts = np.asarray(multihost_utils.process_allgather(jnp.asarray(rows.shape[0])))
        most = int(counts.max())
        filled = np.concatenate([rows, np.repeat(rows[-1:], most - rows.shape[0], axis=0)])
        sent = np.asarray(multihost_utils.process_allgather(jnp.asarray(filled)))
        return np.concatenate([part[:n] for part, n in zip(sent, counts, strict=True)])

    return _together(rows_of_all, _known(tree, "gather"), checkpoint)


def total(tree: Any, checkpoint: str | os.PathLike[str] | None = None) -> Any:
    """The sum over all processes, on every process, with the same bits.

    **Arguments:** `tree` arrays, the same shapes everywhere; `checkpoint` as for `gather`.

    **Raises:** as `gather`.

    >>> total(jnp.ones(2)).tolist()
    [1.0, 1.0]
    """
    add = lambda leaf: multihost_utils.process_allgather(jnp.asarray(leaf)).sum(axis=0)  # noqa: E731
    return _together(add, _known(tree, "total"), checkpoint)


def save(tree: Any, folder: str | os.PathLike[str]) -> Path:
    """Write this process's rows, a `tree` of arrays, to `folder/share-<process>.npz`, or nothing.

    **Returns** the path of the file.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     save(jnp.arange(2), folder).name
    'share-0.npz'
    """
    folder = _checks.path(folder, "folder")
    leaves: dict[str, Any] = {
        f"leaf{i}": leaf for i, leaf in enumerate(jax.tree.leaves(_known(tree, "save")))
    }
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"share-{jax.process_index()}.npz"
    handle, name = tempfile.mkstemp(dir=folder, suffix=".part")
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez(file, **leaves)
        os.replace(name, path)
    except OSError:
        os.unlink(name)
        raise
    return path


def recover(like: Any, folder: str | os.PathLike[str]) -> list[Any]:
    """The rows that `save` wrote, process by process; `like` a tree of the same structure.

    **Raises:** `FileNotFoundError` for a folder without shares; `ValueError` for a file that is not
    from `save`, is cut short, or has another number of arrays than `like`.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = save(jnp.arange(2), folder)
    ...     recover(jnp.zeros(2), folder)[0].tolist()
    [0, 1]
    """
    folder = _checks.path(folder, "folder")
    paths = sorted(folder.glob("share-*.npz"), key=lambda p: int(p.stem.split("-")[1]))
    if not paths:
        raise FileNotFoundError(f"recover: no share-*.npz in {folder}")
    structure = jax.tree.structure(like)
    found = []
    for path in paths:
        try:
            with path.open("rb") as raw, np.load(raw) as file:
                leaves = [file[f"leaf{i}"] for i in range(len(file.files))]
        except Exception as error:
            # An empty file raises EOFError; a cut one BadZipFile, or zlib.error.
            raise ValueError(f"recover: {path} is no file of save, or is cut short") from error
        if len(leaves) != structure.num_leaves:
            raise ValueError(
                f"recover: like has {structure.num_leaves} arrays, {path} holds {len(leaves)}"
            )
        found.append(jax.tree.unflatten(structure, leaves))
    return found


def _known(tree: Any, name: str) -> Any:
    """The tree in host memory."""
    if not _checks.known(tree):
        raise TypeError(
            f"{name}: wanted a tree of known arrays, got one that is traced; this sends between "
            "processes: call it outside of jax.jit, jax.grad and jax.vmap"
        )
    return jax.tree.map(np.asarray, tree)


def _together(send: Callable[[Any], Any], tree: Any, checkpoint: Any) -> Any:
    """`send` of every array, after the tree has been written to the `checkpoint`."""
    if checkpoint is not None:
        try:
            save(tree, checkpoint)
        except OSError as error:
            # The rows are still to be sent.
            words = f"this process's share is not in {checkpoint} ({error.strerror or error})"
            warnings.warn(f"gather, total: {words}; it is sent all the same", stacklevel=3)
            checkpoint = None
    if jax.process_count() == 1:
        return tree
    try:
        return jax.tree.map(send, tree)
    except Exception as error:
        kept = (
            f"this process's share is in {Path(checkpoint) / f'share-{jax.process_index()}.npz'}"
            if checkpoint is not None
            else "give checkpoint= a folder to keep each share"
        )
        raise RuntimeError(
            f"process {jax.process_index()} of {jax.process_count()}: another process did not "
            f"answer, it has most likely ended; {kept}; end this process and start them all again"
        ) from error


__all__ = ["connect", "gather", "recover", "save", "share", "total"]

show(__name__)
