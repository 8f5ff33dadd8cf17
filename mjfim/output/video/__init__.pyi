from .record import NoVideoError, Video
from .results import video_for_report

__all__ = [
    "NoVideoError",
    "Video",
    "video_for_report",
]
