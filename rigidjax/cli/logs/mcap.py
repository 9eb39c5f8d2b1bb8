"""Read MCAP files of JSON and ROS 2 messages, by the library mcap (an extra)."""

import json
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rigidjax import _checks
from rigidjax.cli.logs.columns import Columns

# It is assumed that every topic has at least one message among the first _ENOUGH messages.
_ENOUGH = 2000


def read_mcap(path: Path, columns: Sequence[str]) -> Columns:
    """Return the wanted fields of the JSON and ROS 2 messages in an MCAP log, by names such as
    `/imu.angular_velocity.x`.

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
                # Only the names of the fields are wanted.
                break
            first = message.log_time if first is None else first
            fields = {"log_time": 1e-9 * (message.log_time - first)} | dict(_numbers(content))
            if {"header.stamp.sec", "header.stamp.nanosec"} <= set(fields):
                whole = 10**9 * int(fields["header.stamp.sec"]) - first
                fields["stamp"] = 1e-9 * (whole + int(fields["header.stamp.nanosec"]))
            for field, number in fields.items():
                name = f"{channel.topic}.{field}"
                names[name] = None
                if name in arrays:
                    arrays[name].append(number)
    read = {name: np.frombuffer(numbers, float) for name, numbers in arrays.items() if numbers}
    return Columns(list(names), read)


class _Json:
    """Provide the decoder of JSON to the library mcap, by the interface that it needs."""

    def decoder_for(self, encoding: str, schema: object) -> Callable[[bytes], Any] | None:
        return json.loads if encoding == "json" else None


def _numbers(content: object, name: str = "") -> Iterator[tuple[str, float]]:
    """Yield each number in a message with its path, such as `gyro.x` or `gyro[0]`; `name` is the
    path of `content`.
    """
    if isinstance(content, bool | int | float | np.number):
        yield name, float(content)
    elif isinstance(content, list | tuple | np.ndarray):
        for index, one in enumerate(content):
            yield from _numbers(one, f"{name}[{index}]")
    elif not isinstance(content, str | bytes):
        named = isinstance(content, Mapping)
        for part in content if named else getattr(content, "__slots__", ()):
            inside = content[part] if named else getattr(content, part)
            yield from _numbers(inside, f"{name}.{part}" if name else str(part))
