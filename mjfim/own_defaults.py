"""Import of matplotlib with its own defaults, whenever that happens first.

Matplotlib reads a file `matplotlibrc` of the current folder, which may lie there beside the
experiment and belong to another program. It is imported only where something is drawn, so that the
command line cannot simply import it at its start.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from types import ModuleType

# Folder from which this package is imported; it holds no settings of matplotlib.
HOME = os.path.dirname(os.path.dirname(os.path.realpath(__file__)))


def ignore_settings_of_this_folder() -> None:
    """Let every later import of matplotlib take no settings from the current folder."""
    sys.meta_path.insert(0, _MatplotlibFinder())


class _MatplotlibFinder(MetaPathFinder):
    """Finds matplotlib as usual, and chooses how it is executed."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the description of matplotlib; None for all other modules."""
        if name != "matplotlib":
            return None

        spec = PathFinder.find_spec(name, path, target)
        if spec is not None and spec.origin is not None:
            spec.loader = _MatplotlibLoader(name, spec.origin)
        return spec


class _MatplotlibLoader(SourceFileLoader):
    """Executes matplotlib in another folder, and sets its defaults."""

    def exec_module(self, module: ModuleType) -> None:
        """Execute the module."""
        with _in_folder(HOME):
            super().exec_module(module)
            module.rcdefaults()


@contextmanager
def _in_folder(folder: str) -> Iterator[None]:
    """Make a folder the current one for a while; the present one need not have a name any more."""
    current = os.open(os.curdir, os.O_RDONLY) if hasattr(os, "fchdir") else os.getcwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(current)
        if isinstance(current, int):
            os.close(current)
