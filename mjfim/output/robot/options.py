"""Options of an export that are one of a few words."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal, TypeVar

from mjfim.errors import ExperimentError, unknown

# Programs for which a design can be exported.
Target = Literal["ros2", "ros2-bag", "player", "lerobot"]

Word = TypeVar("Word", bound=str)


def chosen(option: str, kind: str, text: str, valid: Iterable[Word]) -> Word:
    """Return the word that the text of an option names.

    Args:
        option: Name of the option, such as `--to`.
        kind: What the words are, such as "target".
        text: The text.
        valid: All words.

    Raises:
        ExperimentError: There is no such word.
    """
    words = tuple(valid)
    for word in words:
        if word == text:
            return word
    raise ExperimentError(f"{option}: {unknown(kind, text, words)}")
