"""Logs of any format as recordings in SI units, with remarks about the quality of their data."""

from mjfim.recordings.channels import Channels
from mjfim.recordings.formats.read import read_table
from mjfim.recordings.read import Log, read_log, read_recording, recording_paths
from mjfim.recordings.spec import ColumnSpec, RecordingSpec
from mjfim.recordings.summary import LogSummary, summarize

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
