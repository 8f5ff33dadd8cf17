"""Changes of an MJCF text by which a physical term is added to it."""

from __future__ import annotations

from dataclasses import dataclass

# Attributes of an element: pairs of a name and its value, a text or numbers.
Attributes = tuple[tuple[str, str | tuple[float, ...]], ...]


@dataclass(frozen=True, kw_only=True)
class NewElement:
    """An element that is added as the last child of another one.

    Attributes:
        parent_kind: `body` for a child of a body; empty for a child of a section of `<mujoco>`.
        parent: Name of the body, or of the section, such as `actuator`, which is added where it is
            missing.
        tag: Name of the element.
        attributes: Its attributes.
        children: Elements inside it.
    """

    parent_kind: str = ""
    parent: str
    tag: str
    attributes: Attributes
    children: tuple[tuple[str, Attributes], ...] = ()


@dataclass(frozen=True, kw_only=True)
class ChangedElement:
    """An element whose attributes change.

    Attributes:
        kind: Kind of the element, such as `actuator`.
        name: Its name.
        tag: New name of the element in the text; empty where it stays.
        attributes: The new attributes.
        removed: Names of attributes that are removed.
        of_shorthand: Further attributes where the element of the text is a shorthand, such as
            `position`, whose own attributes the new element does not have.
    """

    kind: str
    name: str
    tag: str = ""
    attributes: Attributes = ()
    removed: tuple[str, ...] = ()
    of_shorthand: Attributes = ()


MjcfChange = NewElement | ChangedElement
