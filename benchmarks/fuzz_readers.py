"""Damaged files for every reader: none may crash or hang the process that reads it, fill its memory, or surprise it.

    python benchmarks/fuzz_readers.py

Two hours on two cores. Good files of every format, written by the formats' own libraries, are damaged in one to four
places: bits turned, bytes replaced by numbers that lengths and offsets choke on, parts cut out, repeated, or taken from
another file; of archives and compressed texts also what is inside, and of a folder one of its files, or a value or a
column in it. A few bombs come on top: small files that claim, or unpack to, gigabytes, in a field that is needed and in
one that is not. An input is made of the seed and its number alone. A file is either read, or refused by a
``RecordingError`` that begins with its name.
"""

from __future__ import annotations

import gzip
import io
import json
import math
import platform
import resource
import shlex
import shutil
import sys
import tempfile
import time
import zipfile
from collections import Counter
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import repeat, takewhile
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import h5py
import mcap.writer
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import rosbags.rosbag1
import rosbags.rosbag2
import scipy.io
import tyro
from rosbags.typesys import Stores, get_typestore
from tqdm import tqdm

from torchrl_athletic.recordings import Column, ColumnMap, Recording, RecordingError, read_recordings, write_recording
from torchrl_athletic.recordings.formats.child import end_helper

JOINTS = ("hip", "knee")
COLUMNS = ColumnMap(joint_names=JOINTS, torque_semantics="link_side")
LEROBOT = ColumnMap(
    position=Column("observation.state", unit="deg"), position_target=Column("action", unit="deg"), kp=20.0, kd=0.5
)
KINDS = {
    "npz": ".npz", "csv": ".csv", "csv.gz": ".csv.gz", "parquet": ".parquet", "parquet of lists": ".parquet",
    "hdf5": ".h5", "hdf5 in chunks": ".h5", "mat": ".mat", "mat struct": ".mat", "mat 4": ".mat",
    "ROS 1 bag": ".bag", "ROS 2 bag": ".db3", "mcap": ".mcap", "mcap without checksums": ".mcap", "LeRobot folder": "",
}  # fmt: skip
"""Suffix of each kind of input."""
LONGEST_READ, LARGEST_READ, LONGEST_MESSAGE = 20.0, 2 << 30, 10_000
"""What counts as a hang [s], as a bomb [B], and as a message that nobody can read [characters]."""
RUN = 500
"""Inputs of one kind that follow each other: so many need the libraries of one format only."""
EDGES = (0, 1, 0x7F, 0x80, 0xFF, 0xFFFF, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**64 - 1)
DEEP = 900
"""How many lists lie in one another: JSON that Python just reads."""
ODD = (
    "null", "true", "0", "-1", "1e999", "9" * 5000, '""', '"hip.pos"', '"\\ud800"', '"\\u0000"', f'"{"a" * 10**5}"',
    "[]", '["hip.pos"]', '["hip.pos", "hip.pos"]', '["a", "b", "c"]', '["", "b"]', "[[]]", "[" * DEEP + "]" * DEEP,
    "{}", '{"motors": ["a", "b"]}', '{"a": {"a": []}}',
)  # fmt: skip
"""JSON to stand in the place of other JSON."""


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    inputs: int = 100_000
    """Damaged files, the kinds in turn."""
    seed: int = 0
    """Seed of the damage."""
    kind: str = ""
    """The one kind to read, without the bombs; its inputs are those that it has when all kinds take turns."""
    minutes: float = math.inf
    """How long inputs are read; the table counts those that were."""
    jobs: int = 2
    """Processes."""
    output: Path = Path("benchmarks/results/fuzz_readers.md")
    """Table to write."""
    keep: Path = Path("out/fuzz_readers")
    """Folder for the inputs that a reader failed on."""


def samples(folder: Path) -> dict[str, Path]:
    """A good file of each kind."""
    rng = np.random.default_rng(0)
    times = np.arange(40, dtype=np.float64) * 0.01
    position, velocity, torque = rng.normal(size=(3, 40, 2))
    take = Recording(times, JOINTS, position, velocity=velocity, torque_command=torque)
    numbers = {"time": times, "position": position, "velocity": velocity, "torque_command": torque}
    notes = {"joint_names": list(JOINTS), "metadata": '{"robot": "two joints"}'}
    columns = {"time": times} | {
        f"{name}/{joint}": values[:, k] for name, values in list(numbers.items())[1:] for k, joint in enumerate(JOINTS)
    }
    rows = [",".join(str(float(x)) for x in row) for row in zip(*columns.values(), strict=True)]
    text = "\n".join([",".join(columns), *rows, ""])
    made = {name: folder / f"{name.replace(' ', '_')}{suffix}" for name, suffix in KINDS.items()}
    np.savez(made["npz"], **numbers, **notes)  # type: ignore[arg-type]  # names of arrays
    made["csv"].write_text(text)
    made["csv.gz"].write_bytes(gzip.compress(text.encode()))
    write_recording(take, made["parquet"])
    pq.write_table(pa.table({name: values.tolist() for name, values in numbers.items()}), made["parquet of lists"])
    for name, options in (("hdf5", {}), ("hdf5 in chunks", {"chunks": True, "compression": "gzip", "shuffle": True})):
        with h5py.File(made[name], "w") as file:
            run = file.create_group("run")
            for key, values in numbers.items():
                run.create_dataset(key, data=values, **options)
            file.attrs.update(notes)
    cells = {"joint_names": np.array(JOINTS, dtype=object), "metadata": notes["metadata"]}
    scipy.io.savemat(made["mat"], numbers | cells)
    scipy.io.savemat(made["mat struct"], {"log": numbers | cells, "note": "a"}, do_compression=True)
    scipy.io.savemat(made["mat 4"], numbers, format="4")
    with rosbags.rosbag1.Writer(made["ROS 1 bag"]) as bag1:
        _write_bag(bag1, Stores.ROS1_NOETIC, "serialize_ros1", take)
    with rosbags.rosbag2.Writer(folder / "bag", version=9) as bag2:
        _write_bag(bag2, Stores.ROS2_HUMBLE, "serialize_cdr", take)
    next((folder / "bag").glob("*.db3")).rename(made["ROS 2 bag"])
    write_recording(take, made["mcap"])
    with made["mcap without checksums"].open("wb") as stream:
        writer = mcap.writer.Writer(stream, compression=mcap.writer.CompressionType.NONE, enable_crcs=False)
        writer.start()
        schema = writer.register_schema("sensor_msgs/JointState", "jsonschema", b"{}")
        for topic, values in (("/joint_states", {"position": position}), ("/joint_command", {"effort": torque})):
            channel = writer.register_channel(topic, "json", schema)
            for row in range(len(times)):
                stamp = {"sec": 0, "nanosec": 10_000_000 * row}
                said = {name: array[row].tolist() for name, array in values.items()}
                message = json.dumps({"header": {"stamp": stamp}, "name": JOINTS, **said}).encode()
                writer.add_message(channel, 10_000_000 * row, message, 10_000_000 * row)
        writer.finish()
    _write_lerobot(made["LeRobot folder"], take)
    return made


def _write_lerobot(folder: Path, take: Recording) -> None:
    """Three episodes in two files, of which both hold a part of the second."""
    names = [f"{joint}.pos" for joint in JOINTS]
    features = {feature: {"dtype": "float32", "names": names} for feature in ("observation.state", "action")}
    info = {"codebase_version": "v3.0", "robot_type": "two joints", "fps": 100, "features": features}
    row = np.arange(take.num_samples)
    table = pa.table(
        {
            "observation.state": pa.array(list(take.position.astype(np.float32))),
            "action": pa.array(list(take.command.astype(np.float32))),
            "timestamp": take.time.astype(np.float32),
            "episode_index": row // 15,
            "task": ["pick"] * len(row),
        }
    )
    for part in ("meta", "data/chunk-000"):
        (folder / part).mkdir(parents=True)
    (folder / "meta/info.json").write_text(json.dumps(info, indent=1))
    for number, rows in enumerate((table.slice(0, 20), table.slice(20))):
        pq.write_table(rows, folder / f"data/chunk-000/file-{number:03d}.parquet")


def _write_bag(bag: Any, store_name: Stores, serialize: str, take: Recording) -> None:
    store, kind = get_typestore(store_name), "sensor_msgs/msg/JointState"
    header, stamp_of, state = (
        store.types[name] for name in ("std_msgs/msg/Header", "builtin_interfaces/msg/Time", kind)
    )
    empty, numbered = np.zeros(0), {"seq": 0} if store_name is Stores.ROS1_NOETIC else {}
    for topic in ("/joint_states", "/joint_command"):
        connection = bag.add_connection(topic, kind, typestore=store)
        for row in range(take.num_samples):
            stamp = stamp_of(sec=1, nanosec=10_000_000 * row)
            said = {"position": take.position[row]} if topic == "/joint_states" else {"effort": take.command[row]}
            filled = {name: said.get(name, empty) for name in ("position", "velocity", "effort")}
            message = state(header=header(**numbered, stamp=stamp, frame_id=""), name=list(JOINTS), **filled)
            bag.write(connection, 10**9 + 10_000_000 * row, getattr(store, serialize)(message, kind))


def damaged(raw: bytes, other: bytes, rng: np.random.Generator) -> bytes:
    """The bytes with one to four places spoilt, some of them by a piece of another file."""
    out = bytearray(raw)
    for _ in range(rng.integers(1, 5)):
        at, size = int(rng.integers(0, len(out) + 1)), int(2 ** rng.uniform(0, 9))
        match rng.integers(0, 8):
            case 0 | 1:
                for place in rng.integers(0, max(len(out), 1), rng.integers(1, 9)) if out else ():
                    out[place] ^= 1 << int(rng.integers(0, 8))
            case 2 | 3:
                width = int(rng.choice([1, 2, 4, 8]))
                edge = EDGES[rng.integers(0, len(EDGES))] % 256**width
                out[at : at + width] = edge.to_bytes(width, "little" if rng.random() < 0.8 else "big")
            case 4:
                del out[at : at + size]
            case 5:
                out[at:at] = out[at : at + size] * int(rng.integers(1, 5))
            case 6:
                out[at : at + size] = rng.bytes(size)
            case _:
                begin = int(rng.integers(0, len(other)))
                out[at : at + size] = other[begin : begin + size]
    return bytes(out if rng.random() < 0.9 else out[: rng.integers(0, len(out) + 1)])


def damaged_inside(raw: bytes, kind: str, rng: np.random.Generator) -> bytes:
    """What an archive, a compressed text or a file of a data set holds, damaged, and packed well."""
    if kind == "LeRobot folder":
        return _other_value(raw, rng) if raw.startswith(b"{") else _other_column(raw, rng)
    if kind == "csv.gz":
        text = gzip.decompress(raw)
        return gzip.compress(damaged(text, text, rng), 1, mtime=0)  # the same at any time of day
    packed = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(raw)) as archive, zipfile.ZipFile(packed, "w") as new:
        names = archive.namelist()
        chosen = names[rng.integers(0, len(names))]
        for name in names:
            content = archive.read(name)
            new.writestr(
                zipfile.ZipInfo(name), damaged(content, archive.read(names[0]), rng) if name == chosen else content
            )
    return packed.getvalue()


def _other_value(raw: bytes, rng: np.random.Generator) -> bytes:
    """JSON of an object with something else in the place of one value, at any depth."""
    whole = json.loads(raw)
    holders, places = [whole], []
    for holder in holders:
        for key in holder if isinstance(holder, dict) else range(len(holder)):
            places.append((holder, key))
            holders += [holder[key]] if isinstance(holder[key], dict | list) else []
    holder, key = places[rng.integers(0, len(places))]
    holder[key] = "this one"
    return json.dumps(whole).replace('"this one"', ODD[rng.integers(0, len(ODD))]).encode()


def _other_column(raw: bytes, rng: np.random.Generator) -> bytes:
    """A Parquet file that lacks a column, or has other values, another type or another name in it, or other rows."""
    table = pq.read_table(io.BytesIO(raw))
    names, count = list(table.column_names), table.num_rows
    at, other = rng.integers(0, len(names), 2).tolist()
    rows, edges = table.column(at).to_pylist(), rng.choice(np.array(EDGES, dtype=np.uint64), count)
    match rng.integers(0, 7):
        case 0:
            table = table.remove_column(at)
        case 1:
            names[at] = names[other]
            table = table.rename_columns(names)
        case 2:
            table = table.set_column(at, names[at], table.column(other))
        case 3:
            rows[rng.integers(0, count)] = None if rng.random() < 0.5 else rows[0][:1] if at < 2 else rows[0]
            table = table.set_column(at, names[at], pa.array(rows))
        case 4:
            kind = rng.choice(["u8", "i8", "f4", "M8[ms]", "M8[ns]", "m8[ns]", "U", "?"])
            table = table.set_column(at, names[at], pa.array(edges.astype(kind)))
        case 5:
            odd = rng.choice([0.0, 1.0, -1e308, 1e308, np.nan, np.inf], count)
            table = table.set_column(at, names[at], pa.array(odd if rng.random() < 0.5 else odd[:, None].tolist()))
        case _:
            table = table.take(rng.integers(0, count, rng.integers(0, 2 * count)))
    packed = io.BytesIO()
    pq.write_table(table, packed)
    return packed.getvalue()


def bombs(folder: Path) -> Iterator[tuple[str, Path]]:
    """Small files that ask for a lot, and what is in them."""
    good = {"time": [0.0, 0.1], "joint_names": ["hip"], "position": [0.0, 1.0], "torque_command": [0.0, 1.0]}
    for name in ("velocity", "pictures"):
        zeros = np.zeros(300_000_000)
        np.savez_compressed(folder / f"{name}.npz", **good | {name: zeros})  # type: ignore[arg-type]  # as above
        with h5py.File(folder / f"{name}.h5", "w") as file:
            for key, value in good.items():
                file[key] = value
            file.create_dataset(name, shape=(400_000_000, 1), dtype="f8", chunks=(1_000_000, 1), compression="gzip")
        with zipfile.ZipFile(folder / f"claims_{name}.npz", "w") as archive:
            for key, value in good.items():
                np.save(archive.open(f"{key}.npy", "w"), np.asarray(value))
            claim = io.BytesIO()
            np.lib.format.write_array_header_1_0(claim, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
            archive.writestr(f"{name}.npy", claim.getvalue())
        scipy.io.savemat(folder / f"{name}.mat", good | {name: zeros[:150_000_000]}, do_compression=True)
        yield from ((f"{name} {kind}", folder / f"{name}.{kind}") for kind in ("npz", "h5", "mat"))
        yield f"{name} claimed by an npz", folder / f"claims_{name}.npz"
        del zeros
    header = "time,position_hip,torque_command_hip,note\n"
    rows = "".join(f"{row},0,0,\n" for row in range(100_000))
    (folder / "cell.csv").write_text(f"{header}{rows}100000,0,0,{'x' * 100_000}\n")
    yield "one long cell of a csv", folder / "cell.csv"
    with gzip.open(folder / "rows.csv.gz", "wt", compresslevel=1) as text:
        text.write(header)
        for _ in range(400):
            text.write("0,0,0,\n" * 100_000)
    yield "rows of a csv.gz", folder / "rows.csv.gz"
    columns = {"time": good["time"], "position_hip": [0.0, 0.0], "torque_command_hip": [0.0, 0.0]}
    pq.write_table(pa.table(columns).take(np.zeros(80_000_000, dtype=np.int32)), folder / "rows.parquet")
    yield "rows of a parquet", folder / "rows.parquet"
    with (folder / "chunk.mcap").open("wb") as stream:
        writer = mcap.writer.Writer(stream, chunk_size=1 << 40, compression=mcap.writer.CompressionType.ZSTD)
        writer.start()
        schema = writer.register_schema("sensor_msgs/JointState", "jsonschema", b"{}")
        for topic in ("/joint_states", "/joint_command"):
            channel = writer.register_channel(topic, "json", schema)
            writer.add_message(channel, 0, b'{"name": ["' + b"a" * 700_000_000 + b'"]}', 0)
        writer.finish()
    yield "a message of an mcap", folder / "chunk.mcap"


@dataclass(frozen=True)
class Outcome:
    """What reading one file led to."""

    kind: str
    said: str
    seconds: float

    @property
    def failed(self) -> bool:
        """Whether a user would be worse off than with an error."""
        return self.said not in ("read", "refused") or self.seconds > LONGEST_READ


def outcome(kind: str, path: Path, columns: ColumnMap | None = COLUMNS) -> Outcome:
    """Read one file or folder, and say how that went."""
    begin = time.monotonic()
    try:
        read_recordings(path, LEROBOT if path.is_dir() else columns)
        said = "read"
    except RecordingError as error:
        fine = str(error).startswith(str(path)) and len(str(error)) < LONGEST_MESSAGE
        said = "refused" if fine else f"bad message: {str(error)[:200]}"
    except Exception as error:  # which is what is looked for
        said = f"{type(error).__name__}: {str(error)[:200]}"
    return Outcome(kind, said, time.monotonic() - begin)


def fuzz(numbers: Iterable[int], seed: int, keep: Path, end: float = math.inf) -> tuple[list[Outcome], int]:
    """Make and read the inputs of these numbers, and keep those that fail.

    Args:
        numbers: Of the inputs.
        seed: Seed of the damage.
        keep: Folder for the inputs that a reader failed on.
        end: When to stop, on the clock of ``time.time`` [s].

    Returns:
        What came of each, and the most memory that a child took [B].
    """
    outcomes: list[Outcome] = []
    if time.time() > end:
        return outcomes, 0
    with tempfile.TemporaryDirectory() as scratch:
        good = samples(Path(scratch))
        raw = {kind: _contents(path) for kind, path in good.items()}
        kinds = list(good)
        for number in takewhile(lambda _: time.time() < end, numbers):
            rng = np.random.default_rng([seed, number])
            kind = kinds[number // RUN % len(kinds)]
            inside = kind in ("npz", "csv.gz", "LeRobot folder") and rng.random() < 0.7
            name = list(raw[kind])[rng.integers(0, len(raw[kind]))]
            whole = raw[kind][name]
            other = next(iter(raw[kinds[rng.integers(0, len(kinds))]].values())) if rng.random() < 0.3 else whole
            spoilt = damaged_inside(whole, kind, rng) if inside else damaged(whole, other, rng)
            path = Path(scratch) / f"{number}{KINDS[kind]}"
            _write(path, raw[kind] | {name: spoilt})
            outcomes.append(outcome(kind, path))
            if outcomes[-1].failed:
                _write(keep / path.name, raw[kind] | {name: spoilt})
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    return outcomes, memory_of_children()


def _contents(path: Path) -> dict[Path, bytes]:
    """The bytes of a file, or of every file in a folder, by the path below it."""
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    return {file.relative_to(path): file.read_bytes() for file in files}


def _write(path: Path, contents: dict[Path, bytes]) -> None:
    """A file or a folder with these contents."""
    for name, content in contents.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(content)


def turns(inputs: int, kind: str = "") -> list[range]:
    """Numbers of the inputs to read, in runs of one kind: of all kinds in turn, or of one alone."""
    if kind and kind not in KINDS:
        raise SystemExit(f"there is no kind {kind!r}; known are {', '.join(KINDS)}.")
    first, step = (list(KINDS).index(kind), len(KINDS)) if kind else (0, 1)
    begins = range(RUN * first, RUN * (first + step * math.ceil(inputs / RUN)), RUN * step)
    return [range(begin, begin + min(RUN, inputs - RUN * k)) for k, begin in enumerate(begins)]


def explode() -> tuple[list[Outcome], int]:
    """Read the bombs."""
    with tempfile.TemporaryDirectory() as scratch:
        outcome("npz", samples(Path(scratch))["npz"])  # starts the helper while this process is small, which it counts
        outcomes = [
            outcome(f"{what} | {path.stat().st_size / 1e3:,.0f}", path, None) for what, path in bombs(Path(scratch))
        ]
    return outcomes, memory_of_children()


def memory_of_children() -> int:
    """The most that any child of this process took [B], once all have ended."""
    end_helper()
    return 1024 * resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss


def table(config: Config, outcomes: list[Outcome], exploded: list[Outcome], largest: int) -> str:
    """The result, in Markdown."""
    limit = "" if math.isinf(config.minutes) else f" --minutes {config.minutes:g}"
    limit += f" --kind {shlex.quote(config.kind)}" if config.kind else ""
    lines = [
        "# Fuzz of the readers",
        "",
        f"    python benchmarks/fuzz_readers.py --inputs {config.inputs} --seed {config.seed}{limit}",
        "",
        f"{platform.system()}, Python {platform.python_version()}, numpy {np.__version__}, scipy {scipy.__version__}, "
        f"h5py {h5py.__version__}, pyarrow {pa.__version__}.",
        "",
        f"A reading process never took more than {largest / 2**30:.2f} GB. A failure is any other exception than a "
        f"RecordingError, more than {LONGEST_READ:.0f} s, or a message that does not begin with the file's name.",
        "",
        "| kind | inputs | read | refused | longest [s] | failures |",
        "|---|---|---|---|---|---|",
    ]
    by_kind: dict[str, list[Outcome]] = {}
    for one in outcomes:
        by_kind.setdefault(one.kind, []).append(one)
    bombs_and_sum = [("bombs", exploded), ("all", [*outcomes, *exploded])] if exploded else []
    for kind, group in [*by_kind.items(), *bombs_and_sum]:
        said = Counter(one.said for one in group)
        longest, failures = max(one.seconds for one in group), sum(one.failed for one in group)
        lines.append(f"| {kind} | {len(group)} | {said['read']} | {said['refused']} | {longest:.1f} | {failures} |")
    lines += ["", "| bomb | size of the file [kB] | outcome |", "|---|---|---|"] if exploded else []
    lines += [f"| {one.kind} | {one.said} |" for one in exploded]
    reasons = Counter(f"{one.kind}: {one.said}" for one in [*outcomes, *exploded] if one.failed)
    return "\n".join([*lines, *(f"\n{count} times {what}" for what, count in reasons.most_common(20))]) + "\n"


def main(config: Config) -> int:
    """Fuzz, write the table, and return the number of failures."""
    chunks = turns(config.inputs, config.kind)
    new = get_context("spawn")
    with ProcessPoolExecutor(config.jobs, new) as pool, ProcessPoolExecutor(1, new) as safe:
        bang = safe.submit(explode) if not config.kind else None
        end = time.time() + 60 * config.minutes
        found = pool.map(fuzz, chunks, repeat(config.seed), repeat(config.keep), repeat(end))
        parts = list(tqdm(found, total=len(chunks), unit_scale=RUN, unit=" inputs"))
        exploded, largest = bang.result() if bang is not None else ([], 0)
    outcomes = [one for part, _ in parts for one in part]
    text = table(config, outcomes, exploded, max(largest, *(memory for _, memory in parts)))
    config.output.parent.mkdir(parents=True, exist_ok=True)
    config.output.write_text(text, encoding="utf-8")
    print(text)
    return sum(one.failed for one in [*outcomes, *exploded])


if __name__ == "__main__":
    sys.exit(1 if main(tyro.cli(Config, description=__doc__)) else 0)
