"""Read PX4's ULog, by the library pyulog (an extra)."""

from collections.abc import Sequence
from pathlib import Path

from rigidjax import _checks
from rigidjax.cli.logs.columns import Columns


def read_ulog(path: Path, columns: Sequence[str]) -> Columns:
    """Return two things: the names of all fields in a ULog of PX4, as `topic.field`, such as
    `sensor_combined.gyro_rad[0]`; and a dict of the fields that `columns` name.

    A field of the second instance of a topic has the name `topic#1.field`. Times are in µs.
    """
    reader, arrays = _checks.import_library("pyulog", "ulog", str(path)).ULog, {}
    # The file is opened here, since the library pyulog does not close a file that it opened and
    # cannot read.
    with path.open("rb") as file:
        topics = reader(file).data_list
    for data in topics:
        topic = data.name + (f"#{data.multi_id}" if data.multi_id else "")
        arrays |= {f"{topic}.{name}": values for name, values in data.data.items()}
    return list(arrays), {name: arrays[name] for name in columns if name in arrays}
