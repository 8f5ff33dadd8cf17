"""Find texts of a figure that overlap another text or leave the figure."""

from __future__ import annotations

import numpy as np
from matplotlib.axis import Tick
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox

# Overlap of two texts, and excess beyond the edge of the figure, that no reader sees [points].
TOLERANCE = 1.0


def misplaced_texts(figure: Figure) -> list[str]:
    """Return a sentence for each text that overlaps another one or leaves the figure.

    Args:
        figure: The figure; it is laid out.
    """
    figure.draw_without_rendering()
    tolerance = TOLERANCE * figure.dpi / 72.0
    texts, boxes = _visible_texts(figure)
    if not texts:
        return []

    ends = np.array([box.extents for box in boxes])
    low, high = ends[:, :2], ends[:, 2:]
    size = figure.bbox.extents[2:]
    outside = ((low < -tolerance) | (high > size + tolerance)).any(axis=1)
    faults = [f"leaves the figure: {texts[i]!r}" for i in np.flatnonzero(outside)]

    # Two rectangles overlap where they do in both directions.
    shared = np.minimum(high[:, None], high[None]) - np.maximum(low[:, None], low[None])
    overlap = np.triu((shared > tolerance).all(axis=2), 1)
    return faults + [f"overlap: {texts[i]!r} and {texts[j]!r}" for i, j in np.argwhere(overlap)]


def _visible_texts(figure: Figure) -> tuple[list[str], list[Bbox]]:
    """Return all texts that are drawn, a line each, with the boxes around them [pixels]."""
    hidden = {id(text) for text in _texts_of_unused_ticks(figure)}
    texts, boxes = [], []
    for artist in figure.findobj(Text):
        if not isinstance(artist, Text) or id(artist) in hidden or not artist.get_visible():
            continue
        if artist.axes is not None and not artist.axes.get_visible():
            continue
        words = artist.get_text().strip()
        if words:
            texts.append(words)
            boxes.append(_box(artist))
    return texts, boxes


def _box(text: Text) -> Bbox:
    """Return the box around a text; empty lines below it are left out."""
    whole = text.get_text()
    try:
        text.set_text(whole.rstrip())
        box = text.get_window_extent()
        if text.get_va() == "top" or whole == whole.rstrip():
            return box

        # The first line stays where it is.
        text.set_text(whole)
        top = text.get_window_extent().y1
        return Bbox.from_extents(box.x0, top - box.height, box.x1, top)
    finally:
        text.set_text(whole)


def _texts_of_unused_ticks(figure: Figure) -> list[Text]:
    """Return the texts of ticks that are not drawn: they are hidden, or outside of the range."""
    unused = []
    for axes in figure.findobj(lambda artist: hasattr(artist, "xaxis")):
        for axis in (axes.xaxis, axes.yaxis):
            drawn = axis._update_ticks() if axes.axison and axis.get_visible() else []
            kept = {id(tick) for tick in drawn}
            ticks: list[Tick] = [*axis.majorTicks, *axis.minorTicks]
            for tick in ticks:
                if id(tick) not in kept:
                    unused += [tick.label1, tick.label2]
            if not drawn:
                unused += [axis.label, axis.offsetText]
    return unused
