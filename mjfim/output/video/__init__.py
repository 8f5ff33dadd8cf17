"""Videos of robots, drawn by MuJoCo without a display."""

from __future__ import annotations

from mjfim.output.video.record import NoVideoError, Video

__all__ = ["NoVideoError", "Video"]
