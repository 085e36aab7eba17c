"""What real robots logged: ``Recording``, readers and writers, quality control, excitation signals, public datasets.

Everything that a file can get wrong is found here, with the file, the field, the row and the mend in the message.
"""

from torchrl_athletic.recordings.collection import (
    Arm,
    TakeStopped,
    Watchdog,
    beginning,
    held,
    record,
    recorded,
    through_poses,
)
from torchrl_athletic.recordings.excitation import (
    Excitation,
    ExcitationError,
    Safety,
    amplitude_frequency_pairs,
    chirp,
    gaussian,
    multisine,
    sine,
    square,
)
from torchrl_athletic.recordings.fetch import FetchError, fetch
from torchrl_athletic.recordings.formats import Column, ColumnMap, read_recordings, write_recording
from torchrl_athletic.recordings.noise import noise_correlation, repeat_noise, sensor_noise
from torchrl_athletic.recordings.quality import Quality, check_quality
from torchrl_athletic.recordings.recording import Recording, RecordingError
from torchrl_athletic.recordings.resampling import resample, split_at_gaps
from torchrl_athletic.recordings.stretches import cut_stretches, recorded_time

__all__ = [
    "Arm",
    "Column",
    "ColumnMap",
    "Excitation",
    "ExcitationError",
    "FetchError",
    "Quality",
    "Recording",
    "RecordingError",
    "Safety",
    "TakeStopped",
    "Watchdog",
    "amplitude_frequency_pairs",
    "beginning",
    "check_quality",
    "chirp",
    "cut_stretches",
    "fetch",
    "gaussian",
    "held",
    "multisine",
    "noise_correlation",
    "read_recordings",
    "record",
    "recorded",
    "recorded_time",
    "repeat_noise",
    "resample",
    "sensor_noise",
    "sine",
    "split_at_gaps",
    "square",
    "through_poses",
    "write_recording",
]
