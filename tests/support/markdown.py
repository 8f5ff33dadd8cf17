"""Code blocks and links of Markdown files."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

# A fenced block with its language; the block ends at the next equal fence. A comment above it says
# why it is not run, e.g. `<!-- not run: needs a robot -->`.
BLOCK = re.compile(
    r"(?:^<!--\s*not run:\s*(?P<reason>\S.*?)\s*-->\s*?\n\s*)?"
    r"^(?P<fence>```+|~~~+)(?P<language>\w*)[ \t]*\n(?P<text>.*?)^(?P=fence)$",
    re.MULTILINE | re.DOTALL,
)

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
    text = path.read_text(encoding="utf-8")
    if len(re.findall(r"^(?:```|~~~)", text, re.MULTILINE)) % 2:
        raise ValueError(f"{path}: a block is not closed")
    return [
        CodeBlock(
            path=path,
            line=text.count("\n", 0, found.start("fence")) + 1,
            language=found["language"],
            text=found["text"],
            skip_reason=found["reason"] or "",
        )
        for found in BLOCK.finditer(text)
    ]


def linked_files(path: Path) -> list[Path]:
    """Return the files that a Markdown file links to or shows."""
    targets = LINK.findall(path.read_text(encoding="utf-8"))
    return [path.parent / target for target in targets]
