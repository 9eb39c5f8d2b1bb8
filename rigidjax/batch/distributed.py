"""Share bodies among several processes: each process computes its share, and only results are sent.

The results of a share are equal, to the last bit, to those of one process that computes all bodies.
"""

import os
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jaxtyping import Array, PyTree

from rigidjax import _checks
from rigidjax._names import define_dir_and_getattr


def connect(address: str, processes: int, process: int, *, patience: int = 20) -> None:
    """Connect this process with the other processes of a run, before any other call of JAX.

    **Arguments:**

    - `address`: "host:port" of process 0.
    - `processes`: the number of processes.
    - `process`: the index of this process, from 0.
    - `patience`: seconds after which a process that does not answer counts as dead; every other
      process then ends, with a message and a non-zero exit code.

    **Raises:** `ValueError` for an index out of range; `RuntimeError` if JAX is in use already, or
    if the other processes do not answer.

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


def share(tree: PyTree) -> PyTree:
    """Return the rows of the arrays in a tree that belong to the bodies of this process.

    The N bodies of a run are divided in order among its P processes: each process gets ⌈N/P⌉
    bodies, or one fewer.

    **Arguments:** `tree` of arrays with a leading axis of N bodies; leave out the numbers that all
    bodies share.

    **Raises:** `TypeError` for a leaf without a leading axis; `ValueError` for arrays of different
    length, and for fewer bodies than processes.

    The only process of a run gets all bodies:

    >>> share(jnp.arange(5)).shape
    (5,)
    """
    processes, process = jax.process_count(), jax.process_index()
    leaves = jax.tree.leaves(tree)
    if not all(np.ndim(leaf) > 0 and hasattr(leaf, "shape") for leaf in leaves):
        raise TypeError("share: wanted a tree of arrays with a leading axis of bodies")
    counts = {leaf.shape[0] for leaf in leaves}
    if len(counts) != 1:
        raise ValueError(
            "share: wanted arrays of one number of bodies (the length of the first axis), got "
            f"{sorted(counts)}"
        )
    count = counts.pop()
    if count < processes:
        raise ValueError(
            f"share: wanted at least one body for each of {processes} processes, got {count} "
            "bodies; start fewer processes"
        )
    edges = [count * i // processes for i in range(processes + 1)]
    return jax.tree.map(lambda leaf: leaf[edges[process] : edges[process + 1]], tree)


def gather(tree: PyTree, checkpoint: str | os.PathLike[str] | None = None) -> PyTree:
    """Return to every process the rows of all processes, joined in the order of the processes.

    Each process calls this function with its own rows, which are sent to the other processes.

    **Arguments:**

    - `tree`: arrays with one row for each body of this process, in the order of `share`.
    - `checkpoint`: a folder to which `save` writes the rows of this process before they are sent,
      or `None`.

    **Returns** the tree with the rows of all processes, in host memory.

    **Raises:** `TypeError` for traced arrays; `RuntimeError` if another process has ended. After
    this error end this process, too: its JAX arrays cannot be used any more.

    >>> gather(jnp.arange(3)).tolist()
    [0, 1, 2]
    """

    def rows_of_all(leaf: np.ndarray) -> np.ndarray:
        # Only arrays of equal shape can be sent, but the shares of the processes differ in length
        # by up to one row. A share that is one row shorter than the longest share gets one more
        # row before it is sent, and this row is cut off afterwards.
        rows = np.asarray(leaf)
        counts = np.asarray(multihost_utils.process_allgather(jnp.asarray(rows.shape[0])))
        most = int(counts.max())
        filled = np.concatenate([rows, np.repeat(rows[-1:], most - rows.shape[0], axis=0)])
        sent = np.asarray(multihost_utils.process_allgather(jnp.asarray(filled)))
        return np.concatenate([part[:n] for part, n in zip(sent, counts, strict=True)])

    return _combined_tree(rows_of_all, _on_host(tree, "gather"), checkpoint)


def total(tree: PyTree, checkpoint: str | os.PathLike[str] | None = None) -> PyTree:
    """Return the sum of each array of a tree over all processes.

    The sum is equal, to the last bit, on every process.

    **Arguments:**

    - `tree`: arrays, which have the same shapes on every process.
    - `checkpoint`: a folder to which `save` writes the arrays of this process before they are sent,
      or `None`.

    **Raises:** `TypeError` for traced arrays; `RuntimeError` if another process has ended.

    >>> total(jnp.ones(2)).tolist()
    [1.0, 1.0]
    """
    add = lambda leaf: multihost_utils.process_allgather(jnp.asarray(leaf)).sum(axis=0)  # noqa: E731
    return _combined_tree(add, _on_host(tree, "total"), checkpoint)


def save(tree: PyTree, folder: str | os.PathLike[str]) -> Path:
    """Write the share of this process alone, the arrays of `tree`, to a file in `folder`.

    The file is `folder/share-<process>.npz`, where `<process>` is the index of this process, from
    0. The file appears only when it is complete. **Returns** the path of the file.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     save(jnp.arange(2), folder).name
    'share-0.npz'
    """
    folder = _checks.file_path(folder, "folder")
    leaves = {f"leaf{i}": leaf for i, leaf in enumerate(jax.tree.leaves(_on_host(tree, "save")))}
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


def recover(like: PyTree, folder: str | os.PathLike[str]) -> list[PyTree]:
    """Return the trees that `save` wrote to `folder`, one for each process, in order.

    **Arguments:**

    - `like`: a tree with the structure of the saved trees; the values of its arrays are not used.
    - `folder`: the folder that was given to `save`.

    **Raises:** `FileNotFoundError` for a folder without shares; `ValueError` for a file that `save`
    did not write, that is cut short, or that has another number of arrays than `like`.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = save(jnp.arange(2), folder)
    ...     recover(jnp.zeros(2), folder)[0].tolist()
    [0, 1]
    """
    folder = _checks.file_path(folder, "folder")
    paths = sorted(folder.glob("share-*.npz"), key=lambda p: int(p.stem.split("-")[1]))
    if not paths:
        raise FileNotFoundError(
            f"recover: wanted a folder with files share-*.npz, which save writes, got {folder}"
        )
    structure = jax.tree.structure(like)
    trees = []
    for path in paths:
        try:
            with path.open("rb") as raw, np.load(raw) as file:
                leaves = [file[f"leaf{i}"] for i in range(len(file.files))]
        except Exception as error:
            # An empty file raises EOFError; a file that is cut short raises BadZipFile or
            # zlib.error.
            raise ValueError(f"recover: {path} was not written by save, or is cut short") from error
        if len(leaves) != structure.num_leaves:
            raise ValueError(
                f"recover: wanted a file of {structure.num_leaves} arrays, as `like` has, got "
                f"{path} with {len(leaves)}"
            )
        trees.append(jax.tree.unflatten(structure, leaves))
    return trees


def _on_host(tree: PyTree, caller: str) -> PyTree:
    """Return a tree whose arrays are NumPy arrays in host memory; raise a `TypeError`, which begins
    with the name of the `caller`, if one is traced.
    """
    if not _checks.is_known(tree):
        raise TypeError(
            f"{caller}: wanted a tree of known arrays, got one that is traced; {caller} sends "
            "arrays between processes: call it outside of jax.jit, jax.grad and jax.vmap"
        )
    return jax.tree.map(np.asarray, tree)


def _combined_tree(
    combine: Callable[[np.ndarray], np.ndarray | Array],
    tree: PyTree,
    checkpoint: str | os.PathLike[str] | None,
) -> PyTree:
    """Return a tree whose arrays `combine` has joined or summed over all processes, one by one.

    The tree is written to the folder `checkpoint`, if there is one, before it is sent, so that it
    is not lost if another process has ended; a folder that cannot be written only makes a warning.
    """
    if checkpoint is not None:
        try:
            save(tree, checkpoint)
        except OSError as error:
            # A full disk is no reason to lose the rows: the rows can still be sent to the other
            # processes.
            warnings.warn(
                f"gather, total: the share of this process could not be written to {checkpoint} "
                f"({error.strerror or error}); it is sent nevertheless",
                stacklevel=3,
            )
            checkpoint = None
    if jax.process_count() == 1:
        return tree
    try:
        return jax.tree.map(combine, tree)
    except Exception as error:
        advice = (
            f"this process's share is in {Path(checkpoint) / f'share-{jax.process_index()}.npz'}"
            if checkpoint is not None
            else "give checkpoint= a folder to keep each share"
        )
        raise RuntimeError(
            f"process {jax.process_index()} of {jax.process_count()}: another process did not "
            f"answer, it has most likely ended; {advice}; end this process and start all again"
        ) from error


__all__ = ["connect", "gather", "recover", "save", "share", "total"]

define_dir_and_getattr(__name__)
