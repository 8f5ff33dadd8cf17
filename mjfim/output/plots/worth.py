"""The picture of what would help."""

from __future__ import annotations

import numpy as np

from mjfim.arrays import Array
from mjfim.output.pages.worth import SMALL_INCREASE, change, headline, percent, price_name
from mjfim.output.panels import (
    Axis,
    Mark,
    Panel,
    Picture,
    around,
    bars,
    dots,
    line,
    row_axis,
    vline,
)
from mjfim.output.words import BEST_CASE, share_note
from mjfim.records.worth import SensorWorth, Worth

# Largest number of sensors in the picture; of more, those that change σ most are drawn.
MOST_ROWS = 24


def worth(result: Worth) -> Picture:
    """Show σ without and with each sensor beside the wanted one, and the price of each limit."""
    reach = {each.name: _reach(result, each) for each in result.sensors}
    order = sorted(result.sensors, key=lambda each: -reach[each.name])
    relevant = [each for each in order if reach[each.name] > SMALL_INCREASE] or order
    rows = sorted(relevant[:MOST_ROWS], key=lambda each: each.is_added)
    panels = [_sensors(result, rows)]
    heights = [1.1 + 0.3 * len(rows)]
    if result.prices:
        panels.append(_prices(result, max(len(rows), len(result.prices))))
        heights[0] = max(heights[0], 1.1 + 0.3 * len(result.prices))
    return Picture(
        title=headline(result).removesuffix("."),
        panels=panels,
        note=BEST_CASE + share_note(rows, order, "sensors, those that change σ most"),
        heights=heights,
        widths=[1.6, 1.0][: len(panels)],
    )


def _reach(result: Worth, sensor: SensorWorth) -> float:
    """Ratio of the largest and the smallest σ that a sensor makes a difference for."""
    least = result.ratio(sensor.present if sensor.is_added else sensor.halved)
    return 1.0 if np.isinf(least) else result.ratio(sensor.without) / least


def _sensors(result: Worth, rows: list[SensorWorth]) -> Panel:
    """Return the largest σ over its wanted value, with and without each sensor."""
    now = result.ratio(result.std)

    def ratios(stds: list[Array]) -> Array:
        """Largest ratio for each row; NaN where it is infinite."""
        found = np.array([result.ratio(std) for std in stds])
        return np.where(np.isfinite(found), found, np.nan)

    is_added = np.array([each.is_added for each in rows])
    without = ratios([each.without for each in rows])
    better = ratios([each.present if each.is_added else each.halved for each in rows])
    alone = ratios([each.alone for each in rows])
    places = np.arange(len(rows))
    low, high = around(np.concatenate([without, better, [1.0, now]]), factor=2.0)
    without_or_end = np.where(np.isnan(without), high, without)
    marks: list[Mark] = [
        vline(1.0, dash="--", label=result.goal),
        *([vline(now, "muted", label="now")] if np.isfinite(now) else []),
        *(
            line([better[k], without_or_end[k]], np.full(2, k), "band", width=5.0, front=1.0)
            for k in places
        ),
        dots(np.where(alone < high, alone, np.nan), places, "muted", hollow=True, label="alone"),
    ]
    kinds = [
        (~is_added, without, "series1", "without it"),
        (~is_added, better, "series0", "half its noise"),
        (is_added, better, "series2", "with it"),
    ]
    for mask, values, role, label in kinds:
        if mask.any():
            marks.append(dots(values[mask], places[mask], role, size=6.0, label=label))
    texts = [change(result, each.present if each.is_added else each.without) for each in rows]
    return Panel(
        title="Sensors",
        marks=marks,
        x=Axis(label=f"largest σ over {result.goal} [–]", limits=(low, high), log=True),
        y=row_axis([each.name for each in rows]),
        beside=[("without / with", "text", texts)],
    )


def _prices(result: Worth, rows: int) -> Panel:
    """Return the change of σ where each restriction is relaxed, in as many rows as beside it."""
    places = np.arange(len(result.dearest))
    shown = 100.0 * np.array([price.change for price in result.dearest])
    predicted = 100.0 * np.array([price.predicted for price in result.dearest])
    marks = [bars(np.nan_to_num(shown), places, "series0", left=0.0), vline(0.0, "muted")]
    if not np.array_equal(shown, predicted, equal_nan=True):
        look = {"symbol": "|", "size": 12.0, "width": 2.0, "label": "by the multiplier"}
        marks.append(dots(predicted, places, "text", **look))
    rest = [""] * (rows - len(places))
    return Panel(
        title="Prices of restrictions",
        marks=marks,
        x=Axis(label="change of σ [%]", most=4),
        y=row_axis([price_name(price) for price in result.dearest] + rest),
        beside=[("", "text", [percent(price.change) for price in result.dearest] + rest)],
        place=(0, 1),
    )
