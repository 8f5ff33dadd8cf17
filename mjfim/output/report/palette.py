"""Colours of a report for each role, in the light and in the dark theme."""

from __future__ import annotations

from typing import Any

import numpy as np

from mjfim.output.correlation_colours import colour_strength
from mjfim.output.vocabulary import OTHER, TERMS

# Colours of page and plots that belong to no term of the vocabulary, by their role.
LIGHT = {
    "page": "#ffffff",
    "card": "#f6f7f8",
    "text": "#222222",
    "muted": "#5c6268",
    "grid": "#e2e5e8",
    "band": "#d9dcdf",
    "bound": "#6b7076",
    "forbidden": "#f4dcd7",
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
    "bound": "#98a1aa",
    "forbidden": "#452a28",
    "good": "#4fc78a",
    "doubtful": "#e0b04c",
    "bad": "#ff8072",
    "link": "#7dbdf5",
}

# Colours of curves without a meaning of their own, which differ also for colour-blind readers.
SERIES_LIGHT = (
    "#0077bb",
    "#ee7733",
    "#009988",
    "#aa3377",
    "#8a6d3b",
    "#cc3311",
    "#33669a",
    "#6b7076",
)
SERIES_DARK = (
    "#4fb0f0",
    "#f7a55c",
    "#2fc9b5",
    "#e884bd",
    "#cdb07a",
    "#ff7f66",
    "#8fb4dd",
    "#a3abb3",
)

# Colours of the correlations -1, 0 and 1, and number of colours from one to the next.
DIVERGING_LIGHT = ("#2166ac", "#f7f7f7", "#b2182b")
DIVERGING_DARK = ("#2a73b5", "#262b31", "#c2412f")
DIVERGING_STEPS = 12


def palettes() -> dict[str, dict[str, Any]]:
    """Return the colours by theme, `light` and `dark`, and role."""
    light: dict[str, Any] = {**LIGHT, "diverging": _diverging(DIVERGING_LIGHT)}
    dark: dict[str, Any] = {**DARK, "diverging": _diverging(DIVERGING_DARK)}

    for term in (*TERMS, OTHER):
        light[term.word] = term.colour
        dark[term.word] = term.colour_on_dark

    light.update((f"series{i}", colour) for i, colour in enumerate(SERIES_LIGHT))
    dark.update((f"series{i}", colour) for i, colour in enumerate(SERIES_DARK))
    return {"light": light, "dark": dark}


def _diverging(ends: tuple[str, str, str]) -> list[tuple[float, str]]:
    """Return places from 0 to 1 on a scale of correlations, with their colours.

    Args:
        ends: Colours at -1, 0 and 1, `#rrggbb`.
    """
    # Colours change faster near 0, so the places there are closer.
    even = np.linspace(-1.0, 1.0, 2 * DIVERGING_STEPS + 1)
    correlations = np.sign(even) * even**2
    known = np.array([[int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in ends])
    strengths = colour_strength(correlations)
    channels = [np.interp(strengths, (-1.0, 0.0, 1.0), known[:, i]) for i in range(3)]
    colours = np.round(np.stack(channels, axis=1)).astype(int).tolist()
    return [
        (float(place), "#{:02x}{:02x}{:02x}".format(*colour))
        for place, colour in zip((1.0 + correlations) / 2.0, colours, strict=True)
    ]
