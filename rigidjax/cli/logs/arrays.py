"""Read the files of arrays that NumPy and MATLAB write."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rigidjax.cli.logs.columns import Columns


def read_npz(path: Path, columns: Sequence[str]) -> Columns:
    """Return the wanted arrays of a `.npz` file."""
    # The file is opened here, since NumPy does not close a file that it opened and cannot read.
    with path.open("rb") as raw, np.load(raw) as file:
        return Columns(file.files, {name: file[name] for name in columns if name in file.files})


def read_mat(path: Path, columns: Sequence[str]) -> Columns:
    """Return the wanted arrays of a `.mat` file (MATLAB up to v7)."""
    from scipy.io import loadmat, whosmat

    with path.open("rb") as raw:
        names = [name for name, *_ in whosmat(raw)]
        return Columns(names, loadmat(raw, variable_names=list(columns)))
