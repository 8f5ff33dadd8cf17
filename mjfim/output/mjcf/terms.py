"""Physical terms in the user's MJCF text.

They are written with the values that they have in the extended model; identified values are written
afterwards, as those of any other element.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from mjfim.arrays import Array
from mjfim.model.loading import ModelSource
from mjfim.model.terms.changes import Attributes, ChangedElement, NewElement
from mjfim.model.terms.term import Term
from mjfim.output.mjcf.document import MjcfDocument, all_digits
from mjfim.output.mjcf.xml_edit import NewTag

# Elements of actuators that state gain and bias as `general` does, or not at all.
PLAIN_ACTUATORS = ("general", "motor")

# Attributes of other elements of actuators that `general` does not have.
OF_SHORTHANDS = ("kp", "kv", "dampratio", "timeconst", "inheritrange")

# Index of the root element.
ROOT = 0


def with_terms(document: MjcfDocument, source: ModelSource) -> MjcfDocument:
    """The texts of a model with its physical terms.

    Args:
        document: The texts of the user's model, which may be edited.
        source: The model with its terms.

    Returns:
        The texts of the extended model; the given ones without terms.

    Raises:
        ModelError: An element that a term changes is not in the text. The message is a clause.
    """
    if not source.terms:
        return document

    for term in source.terms.values():
        for change in term.changes():
            if isinstance(change, NewElement):
                _add(document, term, change)
            else:
                _change(document, change)
    _extend_keyframes(document, source)
    return document.edited()


def _add(document: MjcfDocument, term: Term, new: NewElement) -> None:
    """Add an element, with a comment that says what it is."""
    children = tuple(NewTag(name=tag, attributes=_texts(inside)) for tag, inside in new.children)
    element = NewTag(name=new.tag, attributes=_texts(new.attributes), children=children)
    comment = f"{term.kind} {term.name!r}".replace("--", "- -")

    if new.parent_kind:
        document.append_child(document.element(new.parent_kind, new.parent), element, comment)
        return

    # Elements of a section keep their order, so that the new one is in the last section.
    sections = document.top_level(new.parent)
    if sections and document.is_in_main_file(sections[-1]):
        document.append_child(sections[-1], element, comment)
    else:
        section = NewTag(name=new.parent, attributes={}, children=(element,))
        document.append_child(ROOT, section, comment)


def _change(document: MjcfDocument, change: ChangedElement) -> None:
    """Change the attributes of an element."""
    if change.kind == "option":
        options = document.top_level("option")
        if options:
            _set(document, options[-1], change.attributes)
        else:
            document.insert_child(ROOT, "option", _texts(change.attributes))
        return

    if change.kind == "flag":
        for i, each in enumerate(document.tags):
            if each.name == "flag":
                _set(document, i, change.attributes)
        return

    tag = document.element(change.kind, change.name)
    name = document.tags[tag].name
    if change.tag and change.tag != name:
        document.rename_element(tag, change.tag)
        if name not in PLAIN_ACTUATORS:
            for attribute in OF_SHORTHANDS:
                document.set(tag, attribute, None)
            _set(document, tag, change.of_shorthand)
    for attribute in change.removed:
        document.set(tag, attribute, None)
    _set(document, tag, change.attributes)


def _set(document: MjcfDocument, tag: int, attributes: Attributes) -> None:
    """Set attributes; numbers that the text states already keep their spelling."""
    for attribute, value in attributes:
        written = document.written_numbers(tag, attribute)
        if isinstance(value, str):
            document.set(tag, attribute, value)
        elif not _are_numbers(written, value):
            document.set(tag, attribute, _short(*value))


def _are_numbers(written: list[str], values: Iterable[float]) -> bool:
    """Whether some words of a text are these numbers."""
    try:
        return [float(word) for word in written] == list(values)
    except ValueError:
        return False


def _extend_keyframes(document: MjcfDocument, source: ModelSource) -> None:
    """State the keyframes for the state of the extended model."""
    stated, model = source.stated.model, source.model
    tags = [i for i, tag in enumerate(document.tags) if tag.name == "key"]
    if len(tags) != model.nkey:
        return

    sizes = {"qpos": (stated.nq, model.nq), "qvel": (stated.nv, model.nv)}
    for key, tag in enumerate(tags):
        for attribute, (before, after) in sizes.items():
            if before != after and document.attribute(tag, attribute) is not None:
                _set_row(document, tag, attribute, getattr(model, f"key_{attribute}")[key])

        activations: Array = np.asarray(model.key_act[key])
        is_stated = document.attribute(tag, "act") is not None
        if stated.na != model.na and (is_stated or activations.any()):
            _set_row(document, tag, "act", activations)


def _set_row(document: MjcfDocument, tag: int, attribute: str, numbers: Array) -> None:
    """State the numbers of an attribute of a keyframe."""
    document.set(tag, attribute, _short(*np.asarray(numbers).tolist()))


def _texts(attributes: Attributes) -> dict[str, str]:
    """Attributes as the text states them."""
    return {name: value if isinstance(value, str) else _short(*value) for name, value in attributes}


def _short(*values: float) -> str:
    """Numbers with all digits; whole numbers without a decimal point."""
    return " ".join(word.removesuffix(".0") for word in all_digits(*values).split())
