"""Notes of a recording as JSON text."""

from __future__ import annotations

import json

from torchrl_athletic.recordings.recording import Recording


def metadata_text(recording: Recording) -> str:
    """JSON text of ``recording.metadata``, which the recording has checked."""
    return json.dumps(dict(recording.metadata), ensure_ascii=False)
