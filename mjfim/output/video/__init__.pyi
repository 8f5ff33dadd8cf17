from .begun import VideoBegun
from .record import NoVideoError, Video

__all__ = [
    "NoVideoError",
    "Video",
    "VideoBegun",
]
