"""Colours of a report for each role, in the light and in the dark theme."""

from __future__ import annotations

from typing import Any

from mjfim.output.panels import ROLES
from mjfim.output.vocabulary import OTHER, TERMS

# Colours of page and plots that belong to no term of the vocabulary, by their role.
LIGHT = {
    "page": "#ffffff",
    "card": "#f6f7f8",
    "text": "#222222",
    "muted": "#5c6268",
    "grid": "#e2e5e8",
    "band": "#d9dcdf",
    "white": "#ffffff",
    "good": "#1a7f4b",
    "doubtful": "#9a6700",
    "bad": "#c0281a",
    "link": "#0a5fa5",
}
DARK = {
    "page": "#16191d",
    "card": "#20252b",
    "text": "#e6e8ea",
    "muted": "#a3abb3",
    "grid": "#333a42",
    "band": "#3a424b",
    "white": "#16191d",
    "good": "#4fc78a",
    "doubtful": "#e0b04c",
    "bad": "#ff8072",
    "link": "#7dbdf5",
}

# Colours of negative, small and positive values of cells.
CELLS_LIGHT = ("#2166ac", "#f7f7f7", "#b2182b")
CELLS_DARK = ("#2a73b5", "#262b31", "#c2412f")

# How much lighter the colours of curves without a role are on a dark page.
LIGHTER = 0.35


def palettes() -> dict[str, dict[str, Any]]:
    """Return the colours by theme, `light` and `dark`, and role."""
    places = (0.0, 0.5, 1.0)
    light: dict[str, Any] = {
        **ROLES,
        **LIGHT,
        "diverging": list(zip(places, CELLS_LIGHT, strict=True)),
    }
    dark: dict[str, Any] = {
        **{role: _lighter(colour) for role, colour in ROLES.items()},
        **{term.word: term.colour_on_dark for term in (*TERMS, OTHER)},
        **DARK,
        "diverging": list(zip(places, CELLS_DARK, strict=True)),
    }
    return {"light": light, "dark": dark}


def _lighter(colour: str) -> str:
    """A colour that can be read on a dark page."""
    channels = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    return "#" + "".join(f"{round(c + LIGHTER * (255 - c)):02x}" for c in channels)
