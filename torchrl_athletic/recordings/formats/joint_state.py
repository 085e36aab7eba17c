"""``sensor_msgs/JointState`` messages of a bag, put together to one take."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrl_athletic.recordings.formats.column_map import ColumnMap
from torchrl_athletic.recordings.formats.take import RawTake
from torchrl_athletic.recordings.recording import RecordingError

_COMMAND = re.compile(r"command|cmd|target|desired|goal|reference|setpoint", re.IGNORECASE)
_QUANTITIES = ("position", "velocity", "effort")


class Message(NamedTuple):
    """One message of a topic."""

    topic: str
    received: int
    """When the recorder got it [ns]."""
    content: Any
    """Object or dict with name, position, velocity, effort, and a header if there is one."""


@dataclass(frozen=True)
class Track:
    """What one topic says, joint by joint."""

    topic: str
    header: NDArray[np.int64]
    """Stamps of the headers [ns]. Shape (M,). 0 where there is none."""
    received: NDArray[np.int64]
    """When the recorder got the messages [ns]. Shape (M,)."""
    messages: tuple[Mapping[str, Mapping[str, float]], ...]
    """Quantity -> joint -> value, a message."""


def take_from_messages(
    source: str, topics: Mapping[str, str], read: Callable[[set[str]], Iterable[Message]], columns: ColumnMap
) -> RawTake:
    """One take from a topic of measured states and a topic of commands.

    The state's stamps are the time line. The command at a stamp is the last one stamped no later (zero-order hold),
    never a later one: a command that arrives between two states shows in the later of them, so that it seems to act up
    to one state period late, half a period on average. ``metadata["command_age"]`` [s] holds the mean age of the
    commands when they are not stamped like the states. States before the first command are left out and counted in
    ``metadata["before_first_command"]``.

    Stamps are those of the headers; when a topic has none (all are 0), the times at which the recorder got the messages
    are taken for both topics, and ``metadata["stamps"]`` says so.

    Where no topic of commands is clear, what drove the robot is the effort of the states, if the column map says so.

    Args:
        source: The bag.
        topics: Message type by topic.
        read: Gives the messages of some topics.
        columns: Names the topics where they are not clear, and the joints.

    Raises:
        RecordingError: If topics or joints are not clear, or messages are malformed.
    """
    state_topic, command_topic = _choose_topics(source, topics, columns)
    chosen = [topic for topic in (state_topic, command_topic) if topic is not None]
    tracks = _tracks(source, read(set(chosen)), chosen)
    state = tracks[state_topic]
    headers = all(track.header.any() for track in tracks.values())
    joints = columns.file_joint_names or columns.joint_names or _joints(state)
    state_stamps, states = _rows(source, state, state.header if headers else state.received, joints)
    if "position" not in states:
        raise RecordingError(
            f"{source}: topic {state_topic} has no position. Name the topic of the encoders as state_topic of a column "
            "map."
        )
    fields: dict[str, NDArray[Any]] = {"time": state_stamps / 1e9, "position": states["position"]}
    for quantity, name in (("velocity", "velocity"), ("effort", "torque_measured")):
        if quantity in states:
            fields[name] = states[quantity]
    named = {"joint_names": np.array(joints, dtype=np.str_)}
    notes: dict[str, Any] = {} if headers else {"stamps": "received"}
    if command_topic is None:
        if "torque_measured" not in fields or not columns.measured_drives:
            raise RecordingError(_untold(source, topics, state_topic, "torque_measured" in fields))
        return RawTake(source, fields | named, notes)
    command = tracks[command_topic]
    command_stamps, commands = _rows(source, command, command.header if headers else command.received, joints)
    held = _held(source, state_topic, state_stamps, command_topic, command_stamps)
    known = held >= 0
    fields = {name: values[known] for name, values in fields.items()} | named
    name, values = _command(source, command_topic, commands, columns)
    fields[name] = values[held[known]]
    age = (state_stamps[known] - command_stamps[held[known]]) / 1e9
    notes |= {"before_first_command": int((~known).sum())} if not known.all() else {}
    notes |= {"command_age": float(age.mean())} if age.any() else {}
    return RawTake(source, fields, notes)


def _untold(source: str, topics: Mapping[str, str], state_topic: str, effort: bool) -> str:
    """That nothing says what the robot was told, and the mends."""
    mend = "let its effort drive, with --drive measured or ColumnMap(measured_drives=True)"
    return (
        f"{source}: no topic of sensor_msgs/JointState says what the robot was told. {_listed(topics)} Name it as "
        "command_topic of a column map, or record it as well, or "
        f"{mend if effort else f'record the effort in {state_topic}'}."
    )


def _held(
    source: str, state_topic: str, states: NDArray[np.int64], command_topic: str, commands: NDArray[np.int64]
) -> NDArray[np.intp]:
    """Which command holds at each state, by their stamps; -1 before the first. Shape of the states."""
    if (np.diff(commands) <= 0).any():
        row = int(np.argmax(np.diff(commands) <= 0)) + 1
        raise RecordingError(
            f"{source}: topic {command_topic} goes from {commands[row - 1]} ns to {commands[row]} ns at "
            f"message {row}. Stamps must increase, or it is not clear which command held."
        )
    held = np.searchsorted(commands, states, side="right") - 1
    if not (held >= 0).any():
        raise RecordingError(
            f"{source}: all of {state_topic} is stamped before the first message of {command_topic}, so no state has a "
            "command. Check the clocks of the two publishers."
        )
    return held


def _choose_topics(source: str, topics: Mapping[str, str], columns: ColumnMap) -> tuple[str, str | None]:
    """Topic of the state and topic of the command: as named, else as their names tell.

    None for the command where the state's is the only topic, or where the measured effort drives and none is clear.
    """
    for topic in (columns.state_topic, columns.command_topic):
        if topic is not None and topic not in topics:
            raise RecordingError(f"{source}: no topic {topic}. {_listed(topics)}")
    candidates = [topic for topic, kind in topics.items() if kind.endswith("/JointState")]
    given = (columns.state_topic, columns.command_topic)
    commands = [topic for topic in candidates if _COMMAND.search(topic) and topic not in given]
    states = [topic for topic in candidates if not _COMMAND.search(topic) and topic not in given]
    state = columns.state_topic or (states[0] if len(states) == 1 else None)
    command = columns.command_topic or (commands[0] if len(commands) == 1 else None)
    alone = command is None and (columns.measured_drives or set(candidates) <= {state})
    if state is None or (command is None and not alone) or state == command:
        raise RecordingError(
            f"{source}: it is not clear which sensor_msgs/JointState topic is the state and which the command. "
            f"{_listed(topics)} Name them in a column map: ColumnMap(state_topic='/joint_states', "
            "command_topic='/joint_command')."
        )
    return state, command


def _listed(topics: Mapping[str, str]) -> str:
    return "Topics are " + ", ".join(f"{topic} ({kind})" for topic, kind in sorted(topics.items())) + "."


def _tracks(source: str, messages: Iterable[Message], topics: Sequence[str]) -> dict[str, Track]:
    collected: dict[str, list[tuple[int, int, dict[str, dict[str, float]]]]] = {topic: [] for topic in topics}
    for topic, received, content in messages:
        where = f"{source}: topic {topic}, message {len(collected[topic])}"
        stamp = _stamp(content, where)
        if max(abs(stamp), received) >= 2**62:
            raise RecordingError(
                f"{where}: stamped {stamp} ns, received {received} ns; this is no time. Mend the clock of the "
                "publisher."
            )
        collected[topic].append((stamp, received, _quantities(content, where)))
    if empty := [topic for topic, found in collected.items() if not found]:
        raise RecordingError(
            f"{source}: topic {empty[0]} holds no message. Record it, or name another in a column map."
        )
    return {
        topic: Track(
            topic, np.array([f[0] for f in found]), np.array([f[1] for f in found]), tuple(f[2] for f in found)
        )
        for topic, found in collected.items()
    }


def _stamp(content: Any, where: str) -> int:
    """Stamp of the header [ns], 0 when there is none."""
    header = _get(content, "header")
    stamp = None if header is None else _get(header, "stamp")
    if stamp is None:
        return 0
    seconds = next((x for key in ("sec", "secs") if (x := _get(stamp, key)) is not None), None)
    nanoseconds = next((x for key in ("nanosec", "nsecs", "nsec") if (x := _get(stamp, key)) is not None), None)
    if not isinstance(seconds, int | np.integer) or not isinstance(nanoseconds, int | np.integer):
        raise RecordingError(f"{where}: header.stamp is {stamp!r}; needed are whole numbers sec and nanosec.")
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def _quantities(content: Any, where: str) -> dict[str, dict[str, float]]:
    """Quantity -> joint -> value, of what the message fills."""
    names = _get(content, "name")
    if (
        not isinstance(names, list | tuple | np.ndarray)
        or not all(isinstance(name, str) for name in names)
        or not len(names)
    ):
        raise RecordingError(f"{where}: name is {names!r}; needed is a list of joint names.")
    if len(set(names)) < len(names):
        raise RecordingError(f"{where}: name {list(names)} has a joint twice, so its value is not clear.")
    found = {}
    for quantity in _QUANTITIES:
        values = _get(content, quantity)
        array = np.asarray([] if values is None else values)
        if array.size == 0:
            continue
        if array.shape != (len(names),) or array.dtype.kind not in "iuf":
            raise RecordingError(
                f"{where}: {quantity} is {values!r} for the joints {list(names)}; needed is one number a joint."
            )
        found[quantity] = dict(zip(names, array.astype(np.float64).tolist(), strict=True))
    return found


def _get(content: Any, key: str) -> Any:
    return content.get(key) if isinstance(content, Mapping) else getattr(content, key, None)


def _joints(track: Track) -> tuple[str, ...]:
    """All joints of a topic, in order of appearance."""
    return tuple(dict.fromkeys(joint for message in track.messages for values in message.values() for joint in values))


def _rows(
    source: str, track: Track, stamps: NDArray[np.int64], joints: tuple[str, ...]
) -> tuple[NDArray[np.int64], dict[str, NDArray[np.float64]]]:
    """Stamps (T,), and arrays (T, J) of the quantities; messages of one stamp fill one row together.

    A quantity that no message fills, or that is NaN throughout, is left out; so are messages of other joints alone.
    """
    rows: dict[int, dict[str, dict[str, float]]] = {}
    for number, (stamp, message) in enumerate(zip(stamps.tolist(), track.messages, strict=True)):
        for quantity, values in message.items():
            wanted = {joint: values[joint] for joint in joints if joint in values}
            row = rows.setdefault(stamp, {}) if wanted else {}
            if twice := row.get(quantity, {}).keys() & wanted.keys():
                raise RecordingError(
                    f"{source}: topic {track.topic}, message {number} repeats {quantity} of {sorted(twice)[0]} at the "
                    f"stamp {stamp} ns. Remove the duplicates: it is not clear which one holds."
                )
            row.setdefault(quantity, {}).update(wanted) if wanted else None
    if not rows:
        raise RecordingError(
            f"{source}: topic {track.topic} never mentions {', '.join(joints)}; its joints are "
            f"{', '.join(_joints(track))}. Name the joints in a column map: joint_names as in the model, "
            "file_joint_names as in the bag."
        )
    filled = [quantity for quantity in _QUANTITIES if any(quantity in row for row in rows.values())]
    for stamp, row in rows.items():
        for quantity in filled:
            if missing := [joint for joint in joints if joint not in row.get(quantity, {})]:
                raise RecordingError(
                    f"{source}: topic {track.topic} at the stamp {stamp} ns has no {quantity} of {', '.join(missing)}, "
                    "but others have. Messages that each cover some of the joints must share their stamps; or choose "
                    "joints that come together, as joint_names of a column map. Joints of the topic: "
                    f"{', '.join(_joints(track))}."
                )
    arrays = {q: np.array([[row[q][joint] for joint in joints] for row in rows.values()]) for q in filled}
    arrays = {
        quantity: array for quantity, array in arrays.items() if quantity == "position" or not np.isnan(array).all()
    }
    return np.array(list(rows), dtype=np.int64), arrays


def _command(
    source: str, topic: str, commands: Mapping[str, NDArray[np.float64]], columns: ColumnMap
) -> tuple[str, NDArray[np.float64]]:
    """The one command of a topic: its effort or its position."""
    there = {"position_target": commands.get("position"), "torque_command": commands.get("effort")}
    for name in there:
        if columns.column(name) is not None or name in columns.ignore:
            named = name if columns.column(name) is not None else next(other for other in there if other != name)
            if (values := there[named]) is None:
                raise RecordingError(
                    f"{source}: topic {topic} has no values for {named}; it fills {', '.join(commands)}."
                )
            return named, values
    full = [name for name, values in there.items() if values is not None and not np.isnan(values).all()]
    if len(full) != 1 or (full == ["position_target"] and np.any(commands.get("velocity", 0.0))):
        raise RecordingError(
            f"{source}: topic {topic} fills {', '.join(commands)}, so it is not clear what the robot followed. Say it "
            "in a column map: ColumnMap(position_target='position_target') to follow the position alone, or "
            "torque_command='torque_command' the effort."
        )
    values = there[full[0]]
    assert values is not None
    return full[0], values


def counted(messages: Iterator[Message], counts: Mapping[str, int], source: str) -> Iterator[Message]:
    """Pass messages on, and refuse at the end when there were fewer or more than the file announces."""
    found = dict.fromkeys(counts, 0)
    for message in messages:
        found[message.topic] += 1
        yield message
    for topic, count in counts.items():
        if found[topic] != count:
            raise RecordingError(
                f"{source}: topic {topic} has {found[topic]} messages, but the file announces {count}. It is damaged "
                "or was cut off: record or copy it again, or mend its index (rosbag reindex, mcap recover)."
            )
