from .channels import Channels
from .formats import read_table
from .read import LogSummary, read_log, read_recording, recording_paths, summarize
from .section import ColumnSpec, RecordingSpec

__all__ = [
    "Channels",
    "ColumnSpec",
    "LogSummary",
    "RecordingSpec",
    "read_log",
    "read_recording",
    "read_table",
    "recording_paths",
    "summarize",
]
