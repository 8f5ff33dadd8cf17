"""Long sentences without the parts that nobody needs at first sight.

A sentence keeps its beginning, which says what was found. Remarks in parentheses go first, then
clauses from its end. The long form and the report have the whole text.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from mjfim.output.terminal_tables import fold

# A remark in parentheses with its space; short ones are units or numbers, which stay.
REMARK = re.compile(r"\s*\([^()]{12,}\)")

# Ends of the clauses that a sentence can do without.
CLAUSE_END = re.compile(r"; |\. |, because |: this ")

# Shortest beginning that says something [characters].
LEAST_CLAUSE = 30


def condensed(sentence: str, width: int, most: int) -> str:
    """Leave out parts of a sentence until it has few enough lines.

    Args:
        sentence: The sentence. Lines that are broken already are a list, which stays.
        width: Width of the lines [characters].
        most: Largest number of lines.

    Returns:
        The longest of its short forms that has so few lines, or else the shortest of them.
    """
    if "\n" in sentence:
        return sentence

    shown = sentence
    for shown in _short_forms(sentence):
        if len(fold(shown, width)) <= most:
            break
    return shown


def _short_forms(sentence: str) -> Iterator[str]:
    """Yield a sentence, then shorter and shorter forms of it."""
    yield sentence

    # The longest remark goes first.
    text = sentence
    for remark in sorted(REMARK.findall(text), key=len, reverse=True):
        text = text.replace(remark, "", 1)
        yield text

    ends = [found.start() for found in CLAUSE_END.finditer(text)]
    for end in reversed(ends):
        if end >= LEAST_CLAUSE:
            yield text[:end]
