"""Code blocks and links of Markdown files."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

# A fence that opens a block, with its language; the block ends at the next equal fence.
FENCE = re.compile(r"^(?P<fence>```+|~~~+)(?P<language>\w*)\s*$")

# A comment above a block that is not run, with the reason, e.g. `<!-- not run: needs a robot -->`.
SKIP = re.compile(r"^<!--\s*not run:\s*(?P<reason>\S.*?)\s*-->\s*$")

# Targets of links and pictures that are neither an address nor a place in the same file.
LINK = re.compile(r"\]\((?!https?:|mailto:|#)([^)#\s]+)")


@dataclass(frozen=True, kw_only=True)
class CodeBlock:
    """One fenced block of code.

    Attributes:
        path: Markdown file that holds the block.
        line: Line of the opening fence, counted from 1.
        language: Word behind the opening fence; empty if there is none.
        text: Lines between the fences.
        skip_reason: Reason of the comment `<!-- not run: reason -->` above the block; empty if
            there is none.
    """

    path: Path
    line: int
    language: str
    text: str
    skip_reason: str = ""

    @property
    def name(self) -> str:
        """File and line, as the name of a test."""
        return f"{self.path.name}:{self.line}"


def code_blocks(path: Path) -> list[CodeBlock]:
    """Return all fenced blocks of a Markdown file.

    Raises:
        ValueError: A block is not closed.
    """
    lines = path.read_text(encoding="utf-8").splitlines()
    blocks = []
    reason = ""
    index = 0

    while index < len(lines):
        skip = SKIP.match(lines[index])
        opening = FENCE.match(lines[index])

        if opening is None:
            # Only blank lines may stand between the comment and its block.
            if skip is not None:
                reason = skip["reason"]
            elif lines[index].strip():
                reason = ""
            index += 1
            continue

        first = index + 1
        try:
            last = lines.index(opening["fence"], first)
        except ValueError:
            raise ValueError(f"{path}: the block of line {first} is not closed") from None

        block = CodeBlock(
            path=path,
            line=first,
            language=opening["language"],
            text="\n".join(lines[first:last]) + "\n",
            skip_reason=reason,
        )
        blocks.append(block)
        reason = ""
        index = last + 1

    return blocks


def linked_files(path: Path) -> list[Path]:
    """Return the files that a Markdown file links to or shows."""
    targets = LINK.findall(path.read_text(encoding="utf-8"))
    return [path.parent / target for target in targets]
