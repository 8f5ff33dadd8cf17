"""The files of an edited MJCF, which are written together: the main file and what it includes."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import mujoco

from mjfim.errors import ModelError
from mjfim.files import replacing
from mjfim.model.loading import load_written_model
from mjfim.output.mjcf.asset_paths import point_to_copies
from mjfim.output.mjcf.document import MAIN, MjcfDocument


def copies_of_included_files(path: Path, model: Path) -> tuple[str, ...]:
    """Names of the files that `write_identified` may write beside the main file.

    Args:
        path: The new main file.
        model: The user's main file.

    Returns:
        One name for each included file, of which only the changed ones are written. There are none
        where the model is no MJCF.
    """
    try:
        source = model.resolve()
        document = MjcfDocument(source.read_bytes(), source)
    except (ModelError, OSError):
        return ()
    return tuple(_names(document, path)[1:])


class EditedFiles:
    """Files of an edited model, which appear under their names when a context ends."""

    def __init__(self, document: MjcfDocument, spec: Any, path: Path, stack: ExitStack) -> None:
        """Begin to write the main file.

        Args:
            document: The texts with their edits.
            spec: MjSpec of the user's model.
            path: The new main file.
            stack: The context. The main file gets its name last.
        """
        self._document = document
        self._spec = spec
        self._path = path
        self._stack = stack
        self._names = _names(document, path)
        self._temporary = {MAIN: stack.enter_context(replacing(path))}

    def compiled(self) -> Any:
        """Write the texts under temporary names and compile them.

        Returns:
            The MjModel.

        Raises:
            ModelError: MuJoCo does not load the texts.
        """
        for i in self._point_to(self._names):
            if i not in self._temporary:
                file = self._path.with_name(self._names[i])
                self._temporary[i] = self._stack.enter_context(replacing(file))

        names = [
            self._temporary[i].name if i in self._temporary else name
            for i, name in enumerate(self._names)
        ]
        self._point_to(names)
        self._write()
        try:
            return load_written_model(self._temporary[MAIN])
        except (ValueError, mujoco.FatalError) as error:
            reason = " ".join(str(error).split())
            raise ModelError(
                f"MuJoCo does not load the text with the identified values ({reason})"
            ) from None

    def finish(self) -> None:
        """Write the texts as they are under their final names."""
        self._point_to(self._names)
        self._write()

    def _point_to(self, names: list[str]) -> list[int]:
        """Let the texts include files of these names; return the changed files."""
        source = self._document.files[MAIN].path.parent
        target = self._path.resolve().parent
        return point_to_copies(self._document, names, self._spec, source, target)

    def _write(self) -> None:
        """Write all texts to their temporary files."""
        for i, temporary in self._temporary.items():
            temporary.write_bytes(self._document.files[i].text.edited())


def _names(document: MjcfDocument, path: Path) -> list[str]:
    """Names of the new files of a document, that of the main file first.

    A copy is called after the main file and the included file. Names of the files of the model in
    the same folder are left out.
    """
    folder = path.resolve().parent
    originals = [file.path for file in document.files if file.path.resolve().parent == folder]
    taken = {path.name.lower(), *(original.name.lower() for original in originals)}
    names = [path.name]

    for file in document.files[1:]:
        stem = f"{path.stem}_{file.path.stem.removeprefix(f'{path.stem}_')}"
        name, number = f"{stem}{file.path.suffix}", 1
        while name.lower() in taken:
            number += 1
            name = f"{stem}_{number}{file.path.suffix}"
        taken.add(name.lower())
        names.append(name)
    return names
