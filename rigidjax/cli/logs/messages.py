"""Read logs of messages: JSON, and by a library (an extra) those of ROS, MCAP, ArduPilot, PX4."""

import contextlib
import dataclasses
import json
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from rigidjax import _checks
from rigidjax.cli.logs.arrays import arrays_log
from rigidjax.cli.logs.errors import LogError
from rigidjax.cli.logs.log import Log

# It is assumed that every topic has at least one message among the first _ENOUGH messages.
_ENOUGH = 2000


def _messages_log(
    messages: Callable[[], Iterable[tuple[str, float | None, Any]]], **units: str
) -> Log:
    """Return the log of messages, each a topic, the time of its logging, ns, and a content.

    A number has a name such as `/imu.angular_velocity.x`. The fields `topic.log_time` and
    `topic.stamp` (from the header of a message) are times in s since the first message.
    """

    def fields() -> Iterator[tuple[str, dict[str, float]]]:
        first = None
        for topic, time, content in messages():
            first = time if first is None else first
            of_message = (
                {} if time is None or first is None else {"log_time": 1e-9 * (time - first)}
            )
            of_message |= dict(_numbers(content))
            sec, nano = (of_message.get(f"header.stamp.{part}") for part in ("sec", "nanosec"))
            if first is not None and sec is not None and nano is not None:
                of_message["stamp"] = 1e-9 * (10**9 * int(sec) - first + int(nano))
            yield (f"{topic}." if topic else ""), of_message

    def read(columns: Sequence[str]) -> dict[str, np.ndarray]:
        arrays = {name: array("d") for name in columns}
        for topic, of_message in fields():
            for field, number in of_message.items():
                if topic + field in arrays:
                    arrays[topic + field].append(number)
        return {name: np.frombuffer(numbers, float) for name, numbers in arrays.items()}

    names = dict.fromkeys(
        topic + field for topic, found in islice(fields(), _ENOUGH) for field in found
    )
    last = {name: name.rpartition(".")[2] for name in names}
    times = {name: "s" for name in names if last[name] in ("log_time", "stamp")}
    return Log(
        list(names), read, times | {n: u for n in names for part, u in units.items() if part in n}
    )


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
        if dataclasses.is_dataclass(content):
            parts = [field.name for field in dataclasses.fields(content)]
        else:
            parts = content if named else getattr(content, "__slots__", ())
        for part in parts:
            inside = content[part] if named else getattr(content, part)
            yield from _numbers(inside, f"{name}.{part}" if name else str(part))


def read_mcap(path: Path) -> Log:
    """Return the JSON and ROS 2 messages of an MCAP log."""
    make_reader = _checks.import_library("mcap.reader", "mcap", str(path)).make_reader
    ros = _checks.import_library("mcap_ros2.decoder", "mcap", str(path)).DecoderFactory

    def messages() -> Iterator[tuple[str, float, Any]]:
        with path.open("rb") as file:
            reader = make_reader(file, decoder_factories=[_Json(), ros()])
            for _, channel, message, content in reader.iter_decoded_messages():
                yield channel.topic, message.log_time, content

    return _messages_log(messages, angular_velocity="rad/s", linear_acceleration="m/s2")


class _Json:
    """Provide the decoder of JSON to the library mcap, by the interface that it needs."""

    def decoder_for(self, encoding: str, schema: object) -> Callable[[bytes], Any] | None:
        return json.loads if encoding == "json" else None


def read_bag(path: Path) -> Log:
    """Return the messages of a bag of ROS 1 (`.bag`) or ROS 2 (`.db3`)."""
    reader = _checks.import_library("rosbags.highlevel", "ros", str(path)).AnyReader
    types = _checks.import_library("rosbags.typesys", "ros", str(path))

    def messages() -> Iterator[tuple[str, float, Any]]:
        store = types.get_typestore(types.Stores.LATEST)
        with reader([path], default_typestore=store) as bag:
            for connection, time, raw in bag.messages():
                # A message of a type that the bag does not describe cannot be read.
                with contextlib.suppress(KeyError):
                    yield connection.topic, time, bag.deserialize(raw, connection.msgtype)

    return _messages_log(messages, angular_velocity="rad/s", linear_acceleration="m/s2")


def read_ardupilot(path: Path) -> Log:
    """Return the messages of ArduPilot's `.bin`, or of its text dump, by names such as `IMU.GyrX`;
    those of the second instance of a sensor have the name `IMU#1.GyrX`.
    """
    library = _checks.import_library("pymavlink.DFReader", "ardupilot", str(path))
    with path.open("rb") as file:
        is_binary = file.read(1) == b"\xa3"

    def messages() -> Iterator[tuple[str, None, Any]]:
        kind = library.DFReader_binary if is_binary else library.DFReader_text
        reader = kind(str(path))
        # The library does not close the file.
        with contextlib.closing(reader.filehandle):
            while (message := reader.recv_msg()) is not None:
                number = message.to_dict().get(message.fmt.instance_field or "", 0)
                yield message.get_type() + (f"#{number}" if number else ""), None, message.to_dict()

    return _messages_log(messages, TimeUS="us", TimeMS="ms", Gyr="rad/s", Acc="m/s2")


def read_json(path: Path) -> Log:
    """Return the log of a JSON file: lists by name, or records in a list or one in each line."""
    text = path.read_text(encoding="utf-8-sig")
    try:
        content = json.loads(text)
    except json.JSONDecodeError:
        content = [json.loads(line) for line in text.splitlines() if line.strip()]
    if isinstance(content, dict):
        return arrays_log(path, content)
    if not content or not all(isinstance(record, dict) for record in content):
        raise LogError(f"{path}: wanted JSON of lists by name, or of records")

    def messages() -> Iterator[tuple[str, None, Any]]:
        for record in content:
            topic = next(
                (record[k] for k in ("sensor", "topic", "name") if isinstance(record.get(k), str)),
                "",
            )
            yield topic, None, {name: _plain(value) for name, value in record.items()}

    return _messages_log(messages)


def _plain(value: Any) -> Any:
    """Return the number that a text is, or the value unchanged."""
    with contextlib.suppress(ValueError, TypeError):
        return float(value) if isinstance(value, str) else value
    return value


def read_ulog(path: Path) -> Log:
    """Return the fields of a ULog of PX4, by names such as `sensor_combined.gyro_rad[0]`; those of
    the second instance of a topic have the name `topic#1.field`.
    """
    library = _checks.import_library("pyulog", "ulog", str(path)).ULog
    # The file is opened here, since the library does not close a file that it opened and cannot
    # read.
    with path.open("rb") as file:
        topics = library(file).data_list
    arrays = {}
    for data in topics:
        topic = data.name + (f"#{data.multi_id}" if data.multi_id else "")
        arrays |= {f"{topic}.{name}": values for name, values in data.data.items()}
    times = {name: "us" for name in arrays if "timestamp" in name}
    rates = {
        name: "rad/s" for name in arrays if "gyro_rad" in name or "angular_velocity.xyz[" in name
    }
    return Log(
        list(arrays), lambda columns: {name: arrays[name] for name in columns}, times | rates
    )
