from .channels import Channels
from .formats import read_table
from .read import Log, LogSummary, read_log, read_recording, recording_paths, summarize
from .section import ColumnSpec, RecordingSpec

__all__ = [
    "Channels",
    "ColumnSpec",
    "Log",
    "LogSummary",
    "RecordingSpec",
    "read_log",
    "read_recording",
    "read_table",
    "recording_paths",
    "summarize",
]
