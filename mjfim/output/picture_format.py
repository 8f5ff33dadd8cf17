"""The formats in which pictures are written."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum


class PictureFormat(StrEnum):
    """Format of pictures; the value is also the ending of their files."""

    PNG = "png"
    SVG = "svg"
    PDF = "pdf"

    def file_of(self, picture: str) -> str:
        """Return the name of a picture's file.

        Args:
            picture: Name of the picture, without an ending.
        """
        return f"{picture}.{self.value}"

    def files(self, names: Iterable[str]) -> tuple[str, ...]:
        """Return the names of files, where all pictures have this format.

        Args:
            names: Names of files; those of pictures end in .png.
        """
        return tuple(
            name.removesuffix("png") + self.value if name.endswith(".png") else name
            for name in names
        )
