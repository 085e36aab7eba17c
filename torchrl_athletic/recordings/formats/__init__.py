"""Foreign and own files: ``read_recordings``, ``write_recording``, and ``ColumnMap`` for foreign names and units.

A reader turns a file into takes (named arrays, nothing understood yet); ``recording_from_take`` gives names and units
their meaning, the same for every format.
"""

from torchrl_athletic.recordings.formats.column_map import Column, ColumnMap
from torchrl_athletic.recordings.formats.read import read_recordings
from torchrl_athletic.recordings.formats.write import write_recording

__all__ = ["Column", "ColumnMap", "read_recordings", "write_recording"]
