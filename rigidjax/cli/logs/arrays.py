"""Read the files of arrays that NumPy and MATLAB write."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rigidjax.cli.logs.columns import Columns


def read_npz(path: Path, columns: Sequence[str]) -> Columns:
    """Return the names of all arrays in a `.npz` file, and the arrays that `columns` name."""
    # Open the file here: NumPy does not close a file that it opened and cannot read.
    with path.open("rb") as raw, np.load(raw) as file:
        return file.files, {name: file[name] for name in columns if name in file.files}


def read_mat(path: Path, columns: Sequence[str]) -> Columns:
    """Return the names of all arrays in a `.mat` file, and the arrays that `columns` name."""
    from scipy.io import loadmat, whosmat

    with path.open("rb") as raw:
        names = [name for name, *_ in whosmat(raw)]
        return names, loadmat(raw, variable_names=list(columns))
