"""MCAP files of ``sensor_msgs/JointState`` messages, in ROS 2's CDR or as JSON."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_athletic.recordings.formats.column_map import ColumnMap
from torchrl_athletic.recordings.formats.foreign_library import decoding, import_format_library
from torchrl_athletic.recordings.formats.joint_state import Message, counted, take_from_messages
from torchrl_athletic.recordings.formats.metadata import metadata_text
from torchrl_athletic.recordings.formats.take import RawTake, parse_json_object
from torchrl_athletic.recordings.recording import Recording, RecordingError

_NOTES = "torchrl_athletic"
"""Name of the metadata record with the gains and notes, and of the attachment with the exact times."""

JOINT_STATE = """\
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
"""Definition of ``sensor_msgs/msg/JointState`` with all that it needs."""


def read_mcap(path: Path, columns: ColumnMap) -> list[RawTake]:
    """The take of an MCAP file; how: :func:`take_from_messages`."""
    mcap, ros2 = import_format_library("mcap.reader"), import_format_library("mcap_ros2.decoder")
    with path.open("rb") as file:
        with decoding(str(path), "an MCAP file"):
            reader = mcap.make_reader(
                file, validate_crcs=True, decoder_factories=[ros2.DecoderFactory(), _JsonDecoderFactory(str(path))]
            )
            summary = reader.get_summary()
        if summary is None or summary.statistics is None:
            raise RecordingError(f"{path}: has no summary, so the recorder did not finish it. Run: mcap recover")
        with decoding(str(path), "an MCAP file"):
            topics = {
                c.topic: summary.schemas[c.schema_id].name if c.schema_id else c.message_encoding
                for c in summary.channels.values()
            }
            notes = {record.name: record.metadata for record in reader.iter_metadata()}.get(_NOTES, {})
            kept = any(attachment.name == _NOTES for attachment in summary.attachment_indexes)  # others may be large
            attachments = {found.name: found.data for found in reader.iter_attachments()} if kept else {}

        def read(wanted: set[str]) -> Iterator[Message]:
            counts = dict.fromkeys(wanted, 0)
            for channel, count in summary.statistics.channel_message_counts.items():
                if (topic := summary.channels[channel].topic) in wanted:
                    counts[topic] += count
            return counted(messages(wanted), counts, str(path))

        def messages(wanted: set[str]) -> Iterator[Message]:
            with decoding(str(path), "messages of an MCAP file"):
                for _, channel, message, content in reader.iter_decoded_messages(topics=sorted(wanted)):
                    yield Message(channel.topic, message.log_time, content)

        take = take_from_messages(str(path), topics, read, columns)
    return [_with_notes(take, notes, attachments.get(_NOTES))]


def write_mcap(recording: Recording, path: Path) -> None:
    """Write ``/joint_states`` and ``/joint_command`` in CDR, stamped to the nanosecond, for any reader of ROS 2
    messages.

    What these messages cannot say (gains, notes, times between two nanoseconds) stands beside them for
    :func:`read_mcap`.
    """
    writer_module = import_format_library("mcap_ros2.writer")
    if recording.base_position is not None:
        raise RecordingError(
            f"{recording.source}: JointState messages have no place for base_position and base_orientation. Write .npz "
            "or .parquet."
        )
    stamps = np.rint(recording.time * 1e9)
    if np.abs(stamps).max() >= 2**31 * 1e9 or (np.diff(stamps) <= 0).any():
        raise RecordingError(
            f"{recording.source}: time from {recording.time[0]} s to {recording.time[-1]} s cannot be stamped in ROS, "
            "which counts whole nanoseconds in 32-bit seconds. Write .npz or .parquet, or shift the time."
        )
    notes = {"metadata": metadata_text(recording)}
    if recording.torque_semantics is not None:
        notes["torque_semantics"] = recording.torque_semantics
    for key in ("kp", "kd"):
        if (gains := getattr(recording, key)) is not None:
            notes[key] = json.dumps(gains.tolist())
    state = {"position": recording.position, "velocity": recording.velocity, "effort": recording.torque_measured}
    command = {"position": recording.position_target, "velocity": None, "effort": recording.torque_command}
    with path.open("wb") as file, writer_module.Writer(file) as writer:
        schema = writer.register_msgdef("sensor_msgs/msg/JointState", JOINT_STATE)
        for row, stamp in enumerate(stamps.astype(np.int64).tolist()):
            received = stamp - min(0, int(stamps[0]))  # MCAP's clock starts at 0
            for topic, quantities in (("/joint_states", state), ("/joint_command", command)):
                message = {
                    "header": {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": ""},
                    "name": list(recording.joint_names),
                    **{name: [] if values is None else values[row].tolist() for name, values in quantities.items()},
                }
                writer.write_message(topic, schema, message, log_time=received, publish_time=received, sequence=row)
        writer.add_metadata(_NOTES, notes)
        if not np.array_equal(stamps / 1e9, recording.time):
            writer.add_attachment(0, 0, _NOTES, "application/octet-stream", recording.time.astype("<f8").tobytes())


def _with_notes(take: RawTake, notes: dict[str, str], exact_time: bytes | None) -> RawTake:
    """Add what :func:`write_mcap` put beside the messages; exact times only while they are those of the messages."""
    fields, source = dict(take.fields), f"{take.source}: metadata record {_NOTES}"
    if exact_time is not None and len(exact_time) == 8 * len(fields["time"]):
        time = np.frombuffer(exact_time, dtype="<f8").astype(np.float64)
        if np.array_equal(np.rint(time * 1e9) / 1e9, fields["time"]):
            fields["time"] = time
    for key in ("kp", "kd"):
        if key in notes:
            with decoding(f"{source}: {key}", "a JSON list of numbers"):
                fields[key] = np.array(json.loads(notes[key]))
    for key in ("torque_semantics", "metadata"):
        if key in notes:
            fields[key] = np.array(notes[key])
    return replace(take, fields=fields)


@dataclass(frozen=True)
class _JsonDecoderFactory:
    """Decodes JSON messages, for mcap's reader."""

    source: str

    def decoder_for(self, message_encoding: str, schema: Any) -> Callable[[bytes], dict[str, Any]] | None:
        return self._decode if message_encoding == "json" else None

    def _decode(self, data: bytes) -> dict[str, Any]:
        return parse_json_object(data.decode(), f"{self.source}: a JSON message")
