"""ROS 1 and ROS 2 bags of ``sensor_msgs/JointState`` messages."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from torchrl_athletic.recordings.formats.column_map import ColumnMap
from torchrl_athletic.recordings.formats.foreign_library import decoding, import_format_library
from torchrl_athletic.recordings.formats.joint_state import Message, counted, take_from_messages
from torchrl_athletic.recordings.formats.take import RawTake


def is_rosbag2(folder: Path) -> bool:
    """Whether the folder is a ROS 2 bag."""
    return (folder / "metadata.yaml").is_file()


def read_rosbag(path: Path, columns: ColumnMap) -> list[RawTake]:
    """The take of a ROS 1 bag (``.bag``) or a ROS 2 bag (folder, or bare ``.db3``); see :func:`take_from_messages`."""
    highlevel, typesys = import_format_library("rosbags.highlevel"), import_format_library("rosbags.typesys")
    with ExitStack() as stack:
        with decoding(str(path), "a ROS bag"):
            store = typesys.get_typestore(
                typesys.Stores.ROS2_HUMBLE
            )  # bags written before ROS 2 Iron hold no definitions
            reader = stack.enter_context(highlevel.AnyReader([path], default_typestore=store))
            connections = list(reader.connections)
            topics = {connection.topic: connection.msgtype for connection in connections}

        def read(wanted: set[str]) -> Iterator[Message]:
            counts = dict.fromkeys(wanted, 0)
            for connection in connections:
                if connection.topic in wanted:
                    counts[connection.topic] += connection.msgcount
            return counted(messages(wanted), counts, str(path))

        def messages(wanted: set[str]) -> Iterator[Message]:
            chosen: list[Any] = [connection for connection in connections if connection.topic in wanted]
            with decoding(str(path), "messages of a ROS bag"):
                for connection, received, raw in reader.messages(chosen):
                    yield Message(connection.topic, received, reader.deserialize(raw, connection.msgtype))

        return [take_from_messages(str(path), topics, read, columns)]
