"""Read PX4's ULog, by the library pyulog (an extra)."""

from collections.abc import Sequence
from pathlib import Path

from rigidjax import _checks
from rigidjax.cli.logs.columns import Columns


def read_ulog(path: Path, columns: Sequence[str]) -> Columns:
    """Return the wanted fields of a ULog of PX4, by names such as `sensor_combined.gyro_rad[0]`;
    times are in µs.

    A field of the second instance of a topic has the name `topic#1.field`.
    """
    reader, arrays = _checks.import_library("pyulog", "ulog", str(path)).ULog, {}
    # The file is opened here, since the library pyulog does not close a file that it opened and
    # cannot read.
    with path.open("rb") as file:
        topics = reader(file).data_list
    for data in topics:
        topic = data.name + (f"#{data.multi_id}" if data.multi_id else "")
        arrays |= {f"{topic}.{name}": values for name, values in data.data.items()}
    return Columns(list(arrays), {name: arrays[name] for name in columns if name in arrays})
