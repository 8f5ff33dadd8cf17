from .channels import Channels
from .formats.read import read_table
from .read import Log, read_log, read_recording, recording_paths
from .spec import ColumnSpec, RecordingSpec
from .summary import LogSummary, summarize

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
