"""A robot's log as a recording: the experiment's `[recording]` table, and everything that a log may have wrong."""

from mjfim.logs.looks import ColumnLook, Look
from mjfim.logs.quality import doubts
from mjfim.logs.reading import Logged, check_spec, read_log, read_recording

__all__ = ["ColumnLook", "Logged", "Look", "check_spec", "doubts", "read_log", "read_recording"]
