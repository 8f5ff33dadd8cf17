"""Records that a notebook shows as tables, and that draw their figures.

Records stand below the rooms that draw. Two modules of `mjfim.output` know how each kind of record
is shown and drawn; they are imported by their names when a record is shown for the first time.
"""

from __future__ import annotations

import os
from importlib import import_module
from typing import Any

from mjfim.records.serialization import SavedRecord

# Modules that show records as HTML, and that draw their figures.
PRESENTATION = "mjfim.output.presentation"
PICTURES = "mjfim.output.plots.pictures"


class ShownRecord(SavedRecord):
    """Base class of the results of verbs, which can be shown, drawn, saved and loaded."""

    @property
    def pictures(self) -> tuple[str, ...]:
        """Names of the figures that `plot` can draw, the usual one first."""
        names: tuple[str, ...] = import_module(PICTURES).picture_names(self)
        return names

    def plot(self, picture: str | None = None, *, file: str | os.PathLike[str] = "") -> Any:
        """Draw a figure of the record; the verbs of the command line write the same figures.

        Args:
            picture: Name of the figure, one of `pictures`; default: the first of them.
            file: File to which the figure is also written; the ending .png, .svg or .pdf of its
                name states the format. Default: no file is written.

        Returns:
            A matplotlib Figure, which a notebook shows and which `savefig` writes to a file.

        Raises:
            MjfimError: The record has no such figure, or the file has another ending.
        """
        return import_module(PICTURES).draw(self, picture, file)

    def _repr_html_(self) -> str:
        """Return the tables and sentences of the record as HTML, for notebooks."""
        html: str = import_module(PRESENTATION).as_html(self)
        return html
