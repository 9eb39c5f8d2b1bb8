"""Read files of arrays: those of NumPy and MATLAB, HDF5, and the tables of Arrow."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rigidjax import _checks
from rigidjax.cli.logs.errors import LogError
from rigidjax.cli.logs.log import Log

# A matrix with more columns is no table of readings.
_WIDEST = 64


def arrays_log(path: Path, arrays: Mapping[str, Any]) -> Log:
    """Return the log of named arrays: a matrix is a column for each of its columns, `gyro[0]`, a
    struct one for each of its parts, `imu.t`.
    """
    leaves = dict(_leaves(arrays))
    if not leaves:
        raise LogError(f"{path}: holds no columns of numbers")

    def read(columns: Sequence[str]) -> dict[str, Any]:
        return {name: np.asarray(leaves[name][0])[leaves[name][1]] for name in columns}

    dates = {name: "s" for name, (value, _) in leaves.items() if value.dtype.kind in "mM"}
    return Log(list(leaves), read, dates)


def _leaves(value: Any, name: str = "") -> Iterator[tuple[str, tuple[Any, Any]]]:
    """Yield the name of each column of numbers in `value` with the array that holds it and the
    index of the column there.
    """
    if isinstance(value, Mapping):
        for part, inside in value.items():
            if part[:1] != "#" and part[:2] != "__":
                yield from _leaves(inside, f"{name}.{part}" if name else part)
        return
    if isinstance(value, list | tuple):
        try:
            value = np.asarray(value)
        except ValueError:
            return
    if isinstance(value, np.ndarray) and value.dtype == object and value.size == 1:
        yield from _leaves(value.item(), name)
        return
    shape, dtype = getattr(value, "shape", ()), getattr(value, "dtype", None)
    if dtype is None or not shape:
        return
    if dtype.names:
        for part in dtype.names:
            yield from _leaves(value[part], f"{name}.{part}" if name else part)
        return
    wide = [axis for axis, size in enumerate(shape) if size > 1]
    if len(wide) < 2:
        yield name, (value, np.s_[...] if len(shape) == 1 else _column(shape, wide[:1], 0, 0))
    elif len(wide) == 2 and (least := min(shape[axis] for axis in wide)) <= _WIDEST:
        across = next(axis for axis in reversed(wide) if shape[axis] == least)
        for i in range(least):
            yield f"{name}[{i}]", (value, _column(shape, wide, across, i))


def _column(shape: Sequence[int], wide: Sequence[int], across: int, i: int) -> tuple[Any, ...]:
    """Return the index of the column `i` along the axis `across`; axes of length 1 vanish."""
    long = [axis for axis in wide if len(wide) == 1 or axis != across] or [0]
    return tuple(
        np.s_[:] if axis in long else (i if axis == across and len(wide) > 1 else 0)
        for axis in range(len(shape))
    )


def read_numpy(path: Path) -> Log:
    """Return the log of a `.npy` or `.npz` file."""
    # The file is opened here, since NumPy does not close a file that it opened and cannot read.
    with path.open("rb") as raw:
        file = np.load(raw)
        if isinstance(file, np.ndarray):
            return arrays_log(path, {"": file})
        with file:
            return arrays_log(
                path, {name: file[name] for name in file.files if _is_readable(file, name)}
            )


def _is_readable(file: Any, name: str) -> bool:
    """Return whether an array of a `.npz` file can be read without running its code."""
    try:
        file[name]
    except ValueError:
        return False
    return True


def read_mat(path: Path) -> Log:
    """Return the log of a `.mat` file (MATLAB up to v7)."""
    from scipy.io import loadmat

    with path.open("rb") as raw:
        return arrays_log(path, loadmat(raw, simplify_cells=True))


def read_hdf5(path: Path) -> Log:
    """Return the log of an HDF5 file, as MATLAB's v7.3 and netCDF 4 are, by h5py (an extra)."""
    h5py = _checks.import_library("h5py", "hdf5", str(path))

    def opened(group: Any) -> dict[str, Any]:
        return {
            k: opened(v) if isinstance(v, h5py.Group) else v[()]
            for k, v in group.items()
            if k[0] != "#"
        }

    with h5py.File(path, "r") as file:
        return arrays_log(path, opened(file))


def read_arrow(path: Path) -> Log:
    """Return the log of a Parquet or a Feather file, by pyarrow (an extra)."""
    with path.open("rb") as file:
        module = "pyarrow.parquet" if file.read(4) == b"PAR1" else "pyarrow.feather"
    table = _checks.import_library(module, "parquet", str(path)).read_table(path)
    while any(str(field.type).startswith("struct") for field in table.schema):
        table = table.flatten()
    columns = {}
    for name in table.column_names:
        column = table[name].to_numpy()
        if column.dtype == object and len({np.shape(one) for one in column}) == 1:
            column = np.array(column.tolist())
        columns[name] = column
    return arrays_log(path, columns)
