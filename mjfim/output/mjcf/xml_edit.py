"""Edits of an XML text that change only the bytes of the edited start tags."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NoReturn
from xml.parsers import expat
from xml.sax.saxutils import escape

from mjfim.errors import ModelError

# Name of an element, up to white space or the end of its tag.
NAME = re.compile(rb"[^\s/>]+")

# An attribute with the white space before it: groups are that space, the name, and the value with
# its quotes.
ATTRIBUTE = re.compile(rb"""(\s+)([^\s=/>]+)\s*=\s*("[^"]*"|'[^']*')""")

# White space, possibly none.
SPACE = re.compile(rb"\s*")

# End of an element without content.
EMPTY_END = re.compile(rb"\s*/>")

# Indentation of a child.
STEP = b"  "

# Quotes inside a value, as entities, so that a value may stand in either kind of quotes.
QUOTES = {'"': "&quot;", "'": "&apos;"}

# First byte, byte after the last one, and replacement of one part of the text.
TextChange = tuple[int, int, bytes]


@dataclass(frozen=True, kw_only=True)
class Tag:
    """Start tag of an element in the original text.

    Attributes:
        name: Name of the element.
        attributes: Values by name of the attribute, entities resolved.
        start: Position of its first byte in the text.
        parent: Index of the start tag of the enclosing element; -1 for the root.
    """

    name: str
    attributes: dict[str, str]
    start: int
    parent: int


@dataclass(frozen=True, kw_only=True)
class NewTag:
    """An element that is added to a text.

    Attributes:
        name: Name of the element.
        attributes: Values by name of the attribute.
        children: Elements inside it.
    """

    name: str
    attributes: dict[str, str]
    children: tuple[NewTag, ...] = ()

    def lines(self, depth: int) -> list[tuple[int, bytes]]:
        """Lines of the element with their depths.

        Args:
            depth: Depth of its own line.
        """
        tag = _start_tag(self.name, self.attributes)
        if not self.children:
            return [(depth, b"<%s/>" % tag)]
        inside = [line for child in self.children for line in child.lines(depth + 1)]
        return [(depth, b"<%s>" % tag), *inside, (depth, b"</%s>" % self.name.encode())]


class XmlText:
    """XML text with pending edits of its start tags.

    Attributes:
        tags: All start tags in the order of the text; the root is the first.
        is_changed: Whether the text differs from that of its file before any pending edit.
    """

    def __init__(self, text: bytes) -> None:
        """Parse a text.

        Args:
            text: XML in UTF-8.

        Raises:
            ModelError: The text is not well-formed, or has a DOCTYPE, which could declare entities.
                The message is a clause that completes a sentence.
        """
        self._text = text
        self.is_changed = False
        self.tags: list[Tag] = []
        self._end_tags: dict[int, int] = {}
        self._parse()

        # Pending edits, by index of the tag.
        self._values: dict[int, dict[str, str | None]] = {}
        self._successors: dict[tuple[int, str], str] = {}
        self._names: dict[int, str] = {}
        self._children: dict[int, list[bytes]] = {}
        self._last_children: dict[int, list[tuple[int, bytes]]] = {}

    def _parse(self) -> None:
        """Find all start tags, and the position of each element's end tag."""
        # MuJoCo reads bytes, whatever encoding the XML declaration states.
        parser = expat.ParserCreate("UTF-8")
        enclosing: list[int] = []

        def on_start(name: str, attributes: dict[str, str]) -> None:
            """Record a start tag."""
            parent = enclosing[-1] if enclosing else -1
            position = parser.CurrentByteIndex
            self.tags.append(Tag(name=name, attributes=attributes, start=position, parent=parent))
            enclosing.append(len(self.tags) - 1)

        def on_end(_: str) -> None:
            """Record an end tag."""
            self._end_tags[enclosing.pop()] = parser.CurrentByteIndex

        def on_doctype(*_: object) -> NoReturn:
            """Refuse entities, which could expand without limit."""
            raise ModelError("the XML has a DOCTYPE")

        parser.StartElementHandler = on_start
        parser.EndElementHandler = on_end
        parser.StartDoctypeDeclHandler = on_doctype

        try:
            parser.Parse(self._text, True)
        except expat.ExpatError as error:
            raise ModelError(f"the text is not well-formed XML in UTF-8 ({error})") from None

    @property
    def is_edited(self) -> bool:
        """Whether the text differs from that of its file, by pending edits or before them."""
        return self.is_changed or bool(
            self._values or self._names or self._children or self._last_children
        )

    def attribute(self, tag: int, name: str) -> str | None:
        """Return the value of an attribute after the edits so far.

        Args:
            tag: Index of the tag.
            name: Name of the attribute.

        Returns:
            The value, None if there is no such attribute.
        """
        edited = self._values.get(tag, {})
        return edited[name] if name in edited else self.tags[tag].attributes.get(name)

    def set(self, tag: int, name: str, value: str | None) -> None:
        """Change or remove an attribute.

        A changed attribute stays in its place; a new one comes after the others.

        Args:
            tag: Index of the tag.
            name: Name of the attribute.
            value: The new value; None removes the attribute.
        """
        if value != self.attribute(tag, name):
            self._values.setdefault(tag, {})[name] = value

    def replace_attribute(self, tag: int, name: str, successor: str, value: str) -> None:
        """Write another attribute in the place of an existing one.

        Args:
            tag: Index of the tag.
            name: Name of the existing attribute.
            successor: Name of the attribute that takes its place.
            value: Value of the successor.
        """
        self.set(tag, name, None)
        self.set(tag, successor, value)
        self._successors[tag, name] = successor

    def rename_element(self, tag: int, name: str) -> None:
        """Change the name of an element.

        Args:
            tag: Index of the tag.
            name: The new name.
        """
        self._names[tag] = name

    def insert_child(self, parent: int, name: str, attributes: dict[str, str]) -> None:
        """Add an empty element as the first child of another one.

        It gets the indentation of the present first child.

        Args:
            parent: Index of the tag of the enclosing element.
            name: Name of the new element.
            attributes: Values by name of the attribute.
        """
        self._children.setdefault(parent, []).append(b"<%s/>" % _start_tag(name, attributes))

    def insert_comment(self, parent: int, comment: str) -> None:
        """Add a comment before the first child of an element, with the indentation of this child.

        Args:
            parent: Index of the tag of the element.
            comment: The comment, without two hyphens in a row.
        """
        self._children.setdefault(parent, []).append(f"<!-- {comment} -->".encode())

    def append_child(self, parent: int, element: NewTag, comment: str = "") -> None:
        """Add an element as the last child of another one.

        It gets the indentation of the present last child.

        Args:
            parent: Index of the tag of the enclosing element.
            element: The new element.
            comment: Comment above it; empty for none.
        """
        lines = [(0, f"<!-- {comment} -->".encode())] if comment else []
        self._last_children.setdefault(parent, []).extend([*lines, *element.lines(0)])

    def insert_parent(
        self, parent: int, name: str, children: Sequence[tuple[str, dict[str, str]]]
    ) -> None:
        """Add an element that contains empty ones as the first child of another one.

        It gets the indentation of the present first child, and its content stands in one line.

        Args:
            parent: Index of the tag of the enclosing element.
            name: Name of the new element.
            children: Names of its children, each with its attributes.
        """
        inside = b"".join(b"<%s/>" % _start_tag(child, values) for child, values in children)
        text = b"<%s>" % _start_tag(name, {}) + inside + b"</%s>" % name.encode()
        self._children.setdefault(parent, []).append(text)

    def edited(self) -> bytes:
        """Return the text with all edits applied.

        Returns:
            The text; bytes outside the edited parts are unchanged.

        Raises:
            ModelError: An element without content would need one.
        """
        changes: list[TextChange] = []
        for tag in {*self._values, *self._names, *self._children}:
            changes += self._changes_of_tag(tag)
        for tag in self._last_children:
            changes.append(self._appended(tag))

        # From the end to the beginning, so that positions of later changes stay valid.
        text = self._text
        for start, stop, new in sorted(changes, reverse=True):
            text = text[:start] + new + text[stop:]
        return text

    def _changes_of_tag(self, tag: int) -> list[TextChange]:
        """Return all changes to one element."""
        name_start = self.tags[tag].start + 1
        name_stop = self._name_stop(name_start)

        attributes, stop, added = self._attribute_changes(tag, name_stop)

        # An element with content has its name in the end tag as well.
        names = [(name_start, name_stop)]
        if not EMPTY_END.match(self._text, stop):
            end_name = self._end_tags[tag] + len(b"</")
            names.append((end_name, self._name_stop(end_name)))

        renamed: list[TextChange] = []
        if tag in self._names:
            renamed = [(start, end, self._names[tag].encode()) for start, end in names]

        return [*attributes, *renamed, (stop, stop, added), *self._child_changes(tag, stop)]

    def _attribute_changes(self, tag: int, position: int) -> tuple[list[TextChange], int, bytes]:
        """Return the changes to the attributes that begin at a position.

        Returns:
            Changes to existing attributes, the position after the last attribute, and the text of
            new attributes.
        """
        pending = dict(self._values.get(tag, {}))
        changes: list[TextChange] = []

        while found := ATTRIBUTE.match(self._text, position):
            position = found.end()
            name = found[2].decode()
            if name not in pending:
                continue

            value = pending.pop(name)
            successor = self._successors.get((tag, name), "")
            if value is not None:
                changes.append((found.start(3) + 1, found.end(3) - 1, _escaped(value)))
            elif successor in pending:
                text = _attribute_text(successor, pending.pop(successor))
                changes.append((found.start(2), found.end(), text))
            else:
                changes.append((found.start(), found.end(), b""))

        added = [
            b" " + _attribute_text(name, value)
            for name, value in pending.items()
            if value is not None
        ]
        return changes, position, b"".join(added)

    def _name_stop(self, start: int) -> int:
        """Return the position after the name that begins at a position."""
        found = NAME.match(self._text, start)
        return start if found is None else found.end()

    def _child_changes(self, tag: int, stop: int) -> list[TextChange]:
        """Return the insertion of new children; `stop` is the end of the last attribute."""
        if tag not in self._children:
            return []
        if EMPTY_END.match(self._text, stop):
            raise ModelError(f"the empty element <{self.tags[tag].name}/> would need content")

        content = self._text.index(b">", stop) + 1
        lead = self._last_line_break(content)
        inserted = b"".join(lead + child for child in self._children[tag])
        return [(content, content, inserted)]

    def _appended(self, tag: int) -> TextChange:
        """Return the insertion of last children before the end tag of an element."""
        start, end = self.tags[tag].start, self._end_tags[tag]
        if not self._text.startswith(b"</", end):
            raise ModelError(f"the empty element <{self.tags[tag].name}/> would need content")

        # The new lines are indented like the last child, or by two blanks more than the element.
        children = [each for each in self.tags if each.parent == tag]
        lead = self._lead(children[-1].start) if children else self._lead(start) + STEP
        lines = [lead + STEP * depth + line for depth, line in self._last_children[tag]]
        place = len(self._text[:end].rstrip())
        closing = b"" if place < end else self._lead(start)
        return place, place, b"".join(lines) + closing

    def _lead(self, position: int) -> bytes:
        """Return the line break and the white space before a position at the begin of a line."""
        space = self._text[len(self._text[:position].rstrip()) : position]
        line_break = max(space.rfind(b"\n"), 0)
        if line_break > 0 and space[line_break - 1 : line_break] == b"\r":
            line_break -= 1
        return space[line_break:]

    def _last_line_break(self, position: int) -> bytes:
        """Return the line break and the indentation in the white space at a position."""
        found = SPACE.match(self._text, position)
        space = b"" if found is None else found[0]

        line_break = space.rfind(b"\n")
        if line_break > 0 and space[line_break - 1 : line_break] == b"\r":
            line_break -= 1
        return space[max(line_break, 0) :]


def _escaped(value: str) -> bytes:
    """Return the bytes of an attribute's value between its quotes."""
    return escape(value, QUOTES).encode("utf-8", "surrogateescape")


def _start_tag(name: str, attributes: dict[str, str]) -> bytes:
    """Return the bytes between the brackets of a start tag."""
    written = [b" " + _attribute_text(key, value) for key, value in attributes.items()]
    return name.encode() + b"".join(written)


def _attribute_text(name: str, value: str | None) -> bytes:
    """Return the bytes of an attribute in a start tag."""
    return b'%s="%s"' % (name.encode(), _escaped(value or ""))
