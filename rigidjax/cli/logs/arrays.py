"""Read files of arrays: those of NumPy and MATLAB, HDF5, and the tables of Arrow."""

import contextlib
from collections.abc import Iterator, Mapping
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
    columns = dict(_columns(arrays))
    if not columns:
        raise LogError(f"{path}: no columns of numbers; save arrays, not objects, or export CSV")
    dates = {name: "s" for name, column in columns.items() if column.dtype.kind in "mM"}
    return Log(list(columns), lambda names: {name: columns[name] for name in names}, dates)


def _columns(value: Any, name: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """Yield the name and the numbers of each column in `value`."""
    if isinstance(value, np.ndarray) and value.dtype.names:
        value = {part: value[part] for part in value.dtype.names}
    if isinstance(value, Mapping):
        for part, inside in value.items():
            # MATLAB's own parts begin with these signs.
            if not part.startswith(("#", "__")):
                yield from _columns(inside, f"{name}.{part}" if name else part)
        return
    try:
        array = np.squeeze(value)
    except ValueError:
        # Rows of different lengths are no matrix.
        return
    if array.dtype == object and array.ndim == 0 and isinstance(array.item(), Mapping | np.ndarray):
        yield from _columns(array.item(), name)
    elif array.ndim == 1:
        yield name, array
    elif array.ndim == 2 and min(array.shape) <= _WIDEST:
        across = array.T if array.shape[0] >= array.shape[1] else array
        yield from ((f"{name}[{i}]", column) for i, column in enumerate(across))


def read_numpy(path: Path) -> Log:
    """Return the log of a `.npy` or `.npz` file."""
    # The file is opened here, since NumPy does not close a file that it opened and cannot read.
    with path.open("rb") as raw:
        file = np.load(raw)
        if isinstance(file, np.ndarray):
            return arrays_log(path, {"": file})
        arrays = {}
        for name in file.files:
            # An array of objects may run code: it is left out.
            with contextlib.suppress(ValueError):
                arrays[name] = file[name]
        return arrays_log(path, arrays)


def read_mat(path: Path) -> Log:
    """Return the log of a `.mat` file (MATLAB up to v7)."""
    from scipy.io import loadmat
    from scipy.io.matlab import MatlabOpaque

    with path.open("rb") as raw:
        found = loadmat(raw, simplify_cells=True)
    # Objects, such as timetables, may stand beside arrays: SciPy cannot read them.
    return arrays_log(path, {k: v for k, v in found.items() if not isinstance(v, MatlabOpaque)})


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
