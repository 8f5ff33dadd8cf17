"""A video as bytes, for a file or for a page that holds it."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from mjfim.errors import MjfimError, RecordingError
from mjfim.files import replacing

# Format of a video: that of the ending of its file.
Format = Literal["mp4", "gif", "webp"]

# Media type of each format, as pages state it.
MEDIA_TYPES: dict[Format, str] = {"mp4": "video/mp4", "gif": "image/gif", "webp": "image/webp"}

# Formats that the user can ask for by the ending of a file.
FILE_FORMATS: dict[str, Format] = {".mp4": "mp4", ".gif": "gif"}


class NoVideoError(MjfimError):
    """There is no video, for a reason that its message states; the work goes on without it."""


@dataclass(frozen=True, kw_only=True)
class Video:
    """A video of a motion.

    Attributes:
        data: Contents of its file.
        media_type: `video/mp4`, which a page shows as a video, or `image/gif` or `image/webp`,
            which it shows as an image.
        caption: What it shows and how fast it is played, in one or two sentences.
        width: Width [pixels].
        height: Height [pixels].
    """

    data: bytes
    media_type: str
    caption: str
    width: int
    height: int

    def save(self, path: Path) -> None:
        """Write the video into a file.

        Args:
            path: The file.
        """
        with replacing(path) as temporary:
            temporary.write_bytes(self.data)


def format_of(path: Path) -> Format:
    """Return the format that the ending of a file asks for.

    Args:
        path: The file.

    Raises:
        RecordingError: The ending is neither .mp4 nor .gif.
    """
    found = FILE_FORMATS.get(path.suffix.lower())
    if found is None:
        raise RecordingError(f"--video {path}: the name of a video ends in .mp4 or .gif")
    return found


def has_encoder(kind: Format) -> bool:
    """Return whether a format can be written.

    Args:
        kind: The format.
    """
    return kind != "mp4" or find_spec("av") is not None


def require_encoder(kind: Format) -> None:
    """Make sure before the work that a format can be written.

    Args:
        kind: The format.

    Raises:
        NoVideoError: A package is missing.
    """
    if not has_encoder(kind):
        raise NoVideoError(
            "mp4 needs the package av; install it with `pip install 'mjfim[video]'`, or write a "
            "file that ends in .gif"
        )
