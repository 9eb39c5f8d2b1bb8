"""Read MCAP files of JSON and ROS 2 messages, by the library mcap (an extra)."""

import json
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rigidjax import _checks
from rigidjax.cli.logs.columns import Columns


def read_mcap(path: Path, columns: Sequence[str]) -> Columns:
    """Return two things: the names of all fields of the JSON and ROS 2 messages in an MCAP log,
    such as `/imu.angular_velocity.x`; and a dict of the fields that `columns` name.

    The fields `topic.log_time` and `topic.stamp` (from the header of a message) are times in s
    since the first message of the file.
    """
    make_reader = _checks.import_library("mcap.reader", "mcap", str(path)).make_reader
    ros = _checks.import_library("mcap_ros2.decoder", "mcap", str(path)).DecoderFactory
    names: dict[str, None] = {}
    arrays: dict[str, array] = {name: array("d") for name in columns}
    first = None
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[_Json(), ros()])
        for number, (_, channel, message, content) in enumerate(reader.iter_decoded_messages()):
            if not columns and number == _ENOUGH:
                # Only the names of the fields are wanted here. Reading ends after the first _ENOUGH
                # messages, since every topic is assumed to have had a message by then.
                break
            first = message.log_time if first is None else first
            fields = {"log_time": 1e-9 * (message.log_time - first)} | dict(
                _named_numbers_in(content)
            )
            if {"header.stamp.sec", "header.stamp.nanosec"} <= set(fields):
                whole = 10**9 * int(fields["header.stamp.sec"]) - first
                fields["stamp"] = 1e-9 * (whole + int(fields["header.stamp.nanosec"]))
            for field, number in fields.items():
                name = f"{channel.topic}.{field}"
                names[name] = None
                if name in arrays:
                    arrays[name].append(number)
    return list(names), {name: np.frombuffer(a, float) for name, a in arrays.items() if len(a)}


# It is assumed that every topic has at least one message among the first _ENOUGH messages.
_ENOUGH = 2000


class _Json:
    """Provide the decoder of messages in JSON, with the interface that the library mcap needs."""

    def decoder_for(self, encoding: str, schema: object) -> Callable[[bytes], Any] | None:
        """Return the decoder of messages in JSON if `encoding` is JSON, else `None`."""
        return json.loads if encoding == "json" else None


def _named_numbers_in(content: object, name: str = "") -> Iterator[tuple[str, float]]:
    """Yield a pair for each number in a message: the names of the fields that lead to the number,
    such as `gyro.x`, or `gyro[0]` for the first number of an array; and the number as a float.

    - `content`: the message, or a field inside it
    - `name`: the name of this field, empty for the message
    """
    if isinstance(content, bool | int | float | np.number):
        yield name, float(content)
    elif isinstance(content, list | tuple | np.ndarray):
        for index, one in enumerate(content):
            yield from _named_numbers_in(one, f"{name}[{index}]")
    elif not isinstance(content, str | bytes):
        named = isinstance(content, Mapping)
        for part in content if named else getattr(content, "__slots__", ()):
            inside = content[part] if named else getattr(content, part)
            yield from _named_numbers_in(inside, f"{name}.{part}" if name else str(part))
