from .video import NoVideoError, Video

__all__ = [
    "NoVideoError",
    "Video",
]
