"""Files are read in a child process with a limit of time and of memory: a damaged one can crash a library, or hang it.

To start Python takes longer than to read a file, and a process whose threads are at work must not fork. So an idle
helper is started once, and forks for every file. It ends with the process that started it.
"""

from __future__ import annotations

import atexit
import importlib
import json
import math
import os
import pickle
import resource
import signal
import socket
import subprocess
import sys
import threading
from contextlib import suppress
from dataclasses import fields, replace
from functools import cache
from io import BufferedReader
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from torchrl_athletic.recordings.formats.column_map import ColumnMap
from torchrl_athletic.recordings.formats.foreign_library import DAMAGED
from torchrl_athletic.recordings.formats.readers import LIBRARIES, kind_of, read_source
from torchrl_athletic.recordings.recording import Recording, RecordingError

SECONDS, SECONDS_PER_MB = 15.0, 8.0
"""Time that a file may take [s], and what each megabyte of it adds: ten times what MCAP and CSV in gzip need."""
MEMORY, MEMORY_PER_BYTE = 3 << 29, 128
"""Address space [B], and what each byte of the file adds: CSV in gzip needs 100, bags 20, arrays less."""
_OUT_OF_MEMORY = 3
"""Exit code."""


def read_in_child(source: Path, columns: ColumnMap) -> list[Recording]:
    """What :func:`~torchrl_athletic.recordings.formats.readers.read_source` reads, whatever happens to the reader.

    Raises:
        RecordingError: If the file cannot be used, or reading it crashed, took too long or asked for too much memory.
        ImportError: If the library of the format is not installed.

    Example:
        >>> np.savez("take.npz", time=[0.0, 0.01], joint_names=["hip"], position=[0.0, 0.1], torque_command=[1.0, 1.0])
        >>> [recording] = read_in_child(Path("take.npz"), ColumnMap())
        >>> recording.position.tolist()
        [[0.0], [0.1]]
    """
    size = sum(p.stat().st_size for p in ([source] if source.is_file() else source.rglob("*")) if p.is_file())
    limits = SECONDS + SECONDS_PER_MB * size / 1e6, MEMORY + MEMORY_PER_BYTE * size
    with open(os.memfd_create("recordings"), "w+b", buffering=0) as sheet:
        question = replace(columns, metadata=dict(columns.metadata))
        sheet.write(pickle.dumps((source, question)))  # our own words; what comes back is never unpickled
        for _ in range(2):  # somebody may have killed the helper since the last file
            sheet.seek(0)
            if (code := _exit_code([kind_of(source), *limits], sheet.fileno())) is not None:
                break
        if code != 0:
            raise RecordingError(f"{source}: {_what_happened(code, size, *limits)}")
        sheet.seek(0)
        return _decode(BufferedReader(sheet))


def _what_happened(code: int | None, size: int, seconds: float, memory: int) -> str:
    if code is None:
        return (
            "the helper process that reads files cannot be started, or is killed. Look for what does so, and try again."
        )
    if code == -signal.SIGALRM:
        return f"was not read within {seconds:.0f} s, which is far more than its {size:,} bytes need. {DAMAGED}"
    if code == _OUT_OF_MEMORY:
        return (
            f"needs more than {memory / 2**30:.1f} GB of memory to read, for {size:,} bytes. If it is not damaged, "
            "export the signals of the joints alone, or cut it into shorter files."
        )
    reason = signal.strsignal(-code) if code < 0 else f"exit code {code}"
    return f"the process that read it crashed ({reason}). {DAMAGED}"


class _Helper(NamedTuple):
    process: subprocess.Popen[bytes]
    control: socket.socket
    lock: threading.Lock


@cache
def _helper(pid: int) -> _Helper:
    """The helper of this process, which a fork of it must not share."""
    ours, theirs = socket.socketpair()
    start = f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import serve; serve({theirs.fileno()})"
    process = subprocess.Popen(
        [sys.executable, "-P", "-W", "ignore", "-c", start],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        pass_fds=[theirs.fileno()],
        env=os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        start_new_session=True,  # Ctrl-C is for the process that asks
    )
    theirs.close()
    helper = _Helper(process, ours, threading.Lock())
    atexit.register(_end, helper, pid)
    return helper


def end_helper() -> None:
    """End the helper of this process; the next file starts another."""
    _end(_helper(os.getpid()), os.getpid())
    _helper.cache_clear()


def _end(helper: _Helper, pid: int) -> None:
    """Stop the helper with whatever it is doing, from the process that started it."""
    if os.getpid() == pid:
        helper.control.close()
        if helper.process.poll() is None:
            os.killpg(helper.process.pid, signal.SIGKILL)
            helper.process.wait()


def _exit_code(question: list[Any], sheet: int) -> int | None:
    """How the child that was to read ended: negative for a signal, None if the helper is gone."""
    helper, folder = _helper(os.getpid()), os.open(".", os.O_RDONLY)
    try:
        with helper.lock:
            socket.send_fds(helper.control, [json.dumps(question).encode()], [sheet, folder])
            if status := helper.control.recv(4):
                return os.waitstatus_to_exitcode(int.from_bytes(status, "little"))
        raise ConnectionError
    except BaseException as error:  # Ctrl-C, too: its answer would be taken for that to the next question
        end_helper()
        if not isinstance(error, OSError):
            raise
    finally:
        os.close(folder)
    return None


def serve(control: int) -> None:
    """Fork for every file that is asked for through a socket, until its other end is closed.

    Args:
        control: Descriptor of the socket. With the kind of file and the limits come descriptors of a sheet, which holds
            the question and takes the answer, and of the folder that relative paths start from. What goes back is the
            exit status.
    """
    channel = socket.socket(fileno=control)
    signal.pthread_sigmask(signal.SIG_SETMASK, [])  # whatever the other process ignores or blocks
    for number in (signal.SIGALRM, signal.SIGCHLD):
        signal.signal(number, signal.SIG_DFL)
    while True:
        question, descriptors, _, _ = socket.recv_fds(channel, 4096, 2)
        if not question:
            return
        sheet, folder = descriptors
        kind, seconds, memory = json.loads(question)
        for library in LIBRARIES.get(kind, ()):  # before the fork, so that the next one has it, too
            with suppress(ImportError):
                importlib.import_module(library)
        if (child := os.fork()) == 0:
            _answer(sheet, folder, seconds, memory)
        os.close(sheet)
        os.close(folder)
        status = os.waitpid(child, 0)[1]
        with suppress(BrokenPipeError):
            channel.send(status.to_bytes(4, "little"))


def _answer(sheet: int, folder: int, seconds: float, memory: int) -> None:
    """Read what the sheet asks for, write it there, and end."""
    code = 1
    try:
        _limit(seconds, memory)
        os.fchdir(folder)
        with open(sheet, "r+b") as file:
            source, columns = pickle.load(file)
            file.seek(0)
            file.truncate()
            _encode(source, columns, file)
        code = 0
    except MemoryError:
        code = _OUT_OF_MEMORY
    finally:
        os._exit(code)


def _limit(seconds: float, memory: int) -> None:
    """Bound this process, for good."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # last words of C libraries
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (memory if hard == resource.RLIM_INFINITY else min(memory, hard), hard))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.setitimer(signal.ITIMER_REAL, seconds)


def _encode(source: Path, columns: ColumnMap, file: IO[bytes]) -> None:
    """A line of JSON, and then the numbers of all arrays that it names."""
    try:
        recordings = read_source(source, columns)
    except (RecordingError, ImportError) as error:
        file.write(json.dumps({"error": str(error), "import": getattr(error, "name", None)}).encode())
        return
    told = [{f.name: getattr(recording, f.name) for f in fields(recording)} for recording in recordings]
    arrays = [value for one in told for value in one.values() if isinstance(value, np.ndarray)]
    file.write(json.dumps(told, default=_shape).encode() + b"\n")
    for array in arrays:
        file.write(np.ascontiguousarray(array).data)


def _shape(value: Any) -> Any:
    return {"shape": value.shape} if isinstance(value, np.ndarray) else dict(value)


def _decode(file: BufferedReader) -> list[Recording]:
    """The recordings that :func:`_encode` wrote.

    Raises:
        RecordingError: If it wrote why there are none.
        ImportError: The same, for want of a library.
    """
    told = json.loads(file.readline())
    if isinstance(told, dict):
        if told["import"] is not None:
            raise ImportError(told["error"], name=told["import"])
        raise RecordingError(told["error"])
    for one in told:
        for name, value in one.items():
            if name != "metadata" and isinstance(value, dict):
                one[name] = np.fromfile(file, np.float64, math.prod(value["shape"])).reshape(value["shape"])
    return [Recording(**one) for one in told]
