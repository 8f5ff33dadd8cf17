"""An XML text whose start tags are changed byte by byte: what is not named stays as it was typed."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import NoReturn
from xml.parsers import expat
from xml.sax.saxutils import escape

from mjfim.errors import ModelError

NAME = re.compile(rb"[^\s/>]+")
ATTRIBUTE = re.compile(rb"""(\s+)([^\s=/>]+)\s*=\s*("[^"]*"|'[^']*')""")
SPACE = re.compile(rb"\s*")
EMPTY = re.compile(rb"\s*/>")
QUOTES = {'"': "&quot;", "'": "&apos;"}


@dataclass(frozen=True)
class Tag:
    """A start tag: its name and attributes as read, its first byte, and the index of the tag around it (the root's is -1)."""

    name: str
    attributes: dict[str, str]
    start: int
    parent: int


class Markup:
    """A text under change. tags: all start tags, in order, the root first.

    Raises ModelError, as a clause that says why, where the text is not well-formed UTF-8 or has a DOCTYPE, which could
    declare entities.
    """

    def __init__(self, text: bytes) -> None:
        self._text = text
        self.tags: list[Tag] = []
        self._ends: dict[int, int] = {}
        self._read()
        self._values: dict[int, dict[str, str | None]] = {}
        self._heirs: dict[tuple[int, str], str] = {}
        self._names: dict[int, str] = {}
        self._children: dict[int, list[bytes]] = {}

    def _read(self) -> None:
        parser = expat.ParserCreate("UTF-8")  # whatever the declaration says: MuJoCo reads bytes
        around: list[int] = []

        def start(name: str, attributes: dict[str, str]) -> None:
            self.tags.append(
                Tag(name, attributes, parser.CurrentByteIndex, around[-1] if around else -1)
            )
            around.append(len(self.tags) - 1)

        def end(_: str) -> None:
            self._ends[around.pop()] = parser.CurrentByteIndex

        def doctype(*_: object) -> NoReturn:
            raise ModelError("the MJCF has a DOCTYPE")

        parser.StartElementHandler, parser.EndElementHandler = start, end
        parser.StartDoctypeDeclHandler = doctype
        try:
            parser.Parse(self._text, True)
        except expat.ExpatError as error:
            raise ModelError(f"the MJCF is not well-formed XML in UTF-8 ({error})") from None

    def attribute(self, tag: int, name: str) -> str | None:
        """An attribute as it now stands, None where there is none."""
        changed = self._values.get(tag, {})
        return changed[name] if name in changed else self.tags[tag].attributes.get(name)

    def set(self, tag: int, name: str, value: str | None) -> None:
        """Replace an attribute where it stands, add it behind the others, or take it out (None)."""
        if value != self.attribute(tag, name):
            self._values.setdefault(tag, {})[name] = value

    def replace(self, tag: int, name: str, other: str, value: str) -> None:
        """Put another attribute where one stands."""
        self.set(tag, name, None)
        self.set(tag, other, value)
        self._heirs[tag, name] = other

    def rename(self, tag: int, name: str) -> None:
        """Give an element another name."""
        self._names[tag] = name

    def insert(self, parent: int, name: str, attributes: dict[str, str]) -> None:
        """Put a new element before all others inside `parent`, indented as the first of these."""
        written = b"".join(b" " + _written(key, value) for key, value in attributes.items())
        self._children.setdefault(parent, []).append(b"<" + name.encode() + written + b"/>")

    def edited(self) -> bytes:
        """The text with all changes."""
        pieces: list[tuple[int, int, bytes]] = []
        for tag in {*self._values, *self._names, *self._children}:
            pieces += self._pieces(tag)
        text = self._text
        for start, stop, new in sorted(pieces, reverse=True):
            text = text[:start] + new + text[stop:]
        return text

    def _pieces(self, tag: int) -> list[tuple[int, int, bytes]]:
        """(first byte, byte behind the last, replacement) of the changes to one element."""
        pieces, changed = [], dict(self._values.get(tag, {}))
        at = self._name_end(self.tags[tag].start + 1)
        names = [(self.tags[tag].start + 1, at)]
        while found := ATTRIBUTE.match(self._text, at):
            at = found.end()
            name = found[2].decode()
            if name not in changed:
                continue
            value, heir = changed.pop(name), self._heirs.get((tag, name), "")
            if value is None and heir in changed:
                pieces.append((found.start(2), found.end(), _written(heir, changed.pop(heir))))
            elif value is None:
                pieces.append((found.start(), found.end(), b""))
            else:
                pieces.append((found.start(3) + 1, found.end(3) - 1, _encoded(value)))
        added = b"".join(b" " + _written(n, v) for n, v in changed.items() if v is not None)
        if not EMPTY.match(self._text, at):
            close = self._ends[tag] + 2
            names.append((close, self._name_end(close)))
        if tag in self._names:
            pieces += [(start, stop, self._names[tag].encode()) for start, stop in names]
        return [*pieces, (at, at, added), *self._inside(tag, at)]

    def _name_end(self, start: int) -> int:
        found = NAME.match(self._text, start)
        return start if found is None else found.end()

    def _inside(self, tag: int, at: int) -> list[tuple[int, int, bytes]]:
        """The new children of an element whose last attribute ends at a byte."""
        if tag not in self._children:
            return []
        if EMPTY.match(self._text, at):
            raise ModelError(f"an empty <{self.tags[tag].name}/> would need a content")
        stop = self._text.index(b">", at) + 1
        space = SPACE.match(self._text, stop)
        lead = b"" if space is None else space[0]
        newline = lead.rfind(b"\n")
        if newline > 0 and lead[newline - 1 : newline] == b"\r":
            newline -= 1
        lead = lead[max(newline, 0) :]
        return [(stop, stop, b"".join(lead + child for child in self._children[tag]))]


def _encoded(value: str) -> bytes:
    return escape(value, QUOTES).encode("utf-8", "surrogateescape")


def _written(name: str, value: str | None) -> bytes:
    return b'%s="%s"' % (name.encode(), _encoded(value or ""))
