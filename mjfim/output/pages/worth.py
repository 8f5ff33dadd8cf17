"""The page of what would help, which also is a section in the pages of a check and of a design."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import listed
from mjfim.output.page import (
    Page,
    Part,
    Plot,
    Table,
    Text,
    capitalised,
    named,
    numbers,
    tabulated,
    warned,
)
from mjfim.output.words import NOT_ALONE, improvement
from mjfim.records.base import Level, Verdict
from mjfim.records.worth import Price, Worth

# Increase of σ up to which a sensor is hardly needed, and from which its row is marked (factors).
SMALL_INCREASE, LARGE_INCREASE = 1.05, 2.0

# Number of repetitions above which nobody needs to know it.
MANY_REPETITIONS = 1e6


def worth_page(worth: Worth) -> Page:
    """Describe which sensor, which data and which limit would help."""
    steps = []
    if not worth.prices:
        steps.append("See what limits cost: `mjfim worth DESIGN_FOLDER`, after `mjfim design`.")
    return Page(
        kind="What would help",
        verdict=Verdict(headline(worth), Level.GOOD, ok=True),
        next_steps=tuple(steps),
        facts={"motion": worth.source, "duration": f"{worth.horizon:g} s"},
        sections={"What would help": worth_parts(worth)},
    )


def headline(worth: Worth) -> str:
    """Say what helps most: a sensor, data or a limit."""
    reached = f"reaches {worth.goal} of every parameter"
    now = worth.ratio(worth.std)
    if np.isinf(now):
        reached = f"does not determine {worth.worst(worth.std)} alone"
    elif now > 1.0:
        reached = f"misses {worth.goal} of {worth.worst(worth.std)} by a factor of {now:.2g}"
    helps = ", ".join(_helps(worth)) or "none of these sensors"
    return f"{capitalised(worth.source)} {reached}. What lowers σ: {helps}."


def _helps(worth: Worth) -> Iterator[str]:
    """The best sensor, the best added one and the costliest limit, each with the change of σ."""
    for added in (False, True):
        rows = [each for each in worth.single if each.is_added == added]
        best = min(rows, key=lambda each: worth.ratio(each.improved), default=None)
        if best is not None and change(worth, best.improved) != "same":
            what = best.name if added else f"half the noise of {best.name}"
            yield f"{what} ({change(worth, best.improved).partition(' (')[0]})"
    if worth.prices:
        price = worth.costliest[0]
        yield f"{price_name(price)} ({percent(price.change)})"


def worth_parts(worth: Worth | None, *, detail: bool = False) -> Sequence[Part]:
    """Return the picture, the tables and the sentences of what would help.

    Args:
        worth: The record; None for none.
        detail: Whether a short form leaves the tables out.
    """
    if worth is None:
        return ()
    present = [each for each in worth.sensors if not each.is_added]
    added = [each for each in worth.sensors if each.is_added]
    added.sort(key=lambda each: worth.ratio(each.present))
    now = worth.ratio(worth.std)
    columns = {
        "sensor": [each.name for each in present],
        "noise": [each.noise for each in present],
        "σ without it": [change(worth, each.without) for each in present],
        "alone": [change(worth, each.alone) for each in present],
        "half its noise": [change(worth, each.halved) for each in present],
    }
    note = f"Change of the largest σ over {worth.goal}, and the parameter that then has it."
    marked = warned(not worth.ratio(each.without) < LARGE_INCREASE * now for each in present)
    table = tabulated("Sensors", columns, marked, spare=("noise",), note=note, detail=detail)
    parts: list[Part] = [*(Text(each) for each in _sentences(worth)), Plot("worth"), table]
    if added:
        columns = {
            "sensor": [each.name for each in added],
            "noise": [each.noise for each in added],
            "σ with it": [change(worth, each.present) for each in added],
            "alone": [change(worth, each.alone) for each in added],
        }
        parts.append(tabulated("Sensors that the model does not have", columns))
    if worth.prices:
        parts.append(_price_table(worth, detail))
    return [*parts, _parameter_table(worth)]


def _sentences(worth: Worth) -> Iterator[str]:
    if worth.fewest:
        yield f"The smallest set that reaches {worth.goal} everywhere: {listed(worth.fewest)}."
    now = worth.ratio(worth.std)
    if 1.0 < now < np.inf:
        count = f"{np.ceil(now**2):.0f}" if now**2 < MANY_REPETITIONS else "more than a million"
        yield f"Without priors, {count} repetitions reach {worth.goal}."
    needless = [
        each.name
        for each in worth.single
        if not each.is_added and worth.ratio(each.without) < SMALL_INCREASE * now
    ]
    if needless:
        yield f"Hardly needed, each by itself: {listed(needless)}."
    yield (
        f"Two repetitions: σ {change(worth, worth.repeated)}. Twice as many samples a second: σ "
        f"{change(worth, worth.faster)}."
    )


def change(worth: Worth, std: Array) -> str:
    """Write how the largest σ over its wanted value changes, and which parameter then has it."""
    ratio, worst = worth.ratio(std), worth.worst(std)
    now = worth.ratio(worth.std)
    if ratio == now or 1.0 / SMALL_INCREASE < ratio / now < SMALL_INCREASE:
        return "same"
    if np.isinf(now):
        return f"{ratio:.2g} of the wanted σ"
    text = improvement(now, ratio) if np.isfinite(ratio) else "∞"
    return f"{text} ({worst})" if worst != worth.worst(worth.std) else text


def price_name(price: Price) -> str:
    """Write what is relaxed, and by how much."""
    return f"{price.name}, {price.step}"


def percent(share: float) -> str:
    """Write a relative change with its sign."""
    return "-" if np.isnan(share) else f"{100.0 * share:+.2g} %".replace("-", "−")


def _price_table(worth: Worth, detail: bool) -> Table:
    """Tabulate what each restriction costs."""
    return tabulated(
        "Prices: how σ changes where a restriction is relaxed",
        {
            "restriction": [price_name(price) for price in worth.costliest],
            "by its multiplier": [percent(price.predicted) for price in worth.costliest],
            "in a new design": [percent(price.redesigned) for price in worth.costliest],
        },
        note="σ is what the criterion minimises: for E-optimality that of the worst combination.",
        detail=detail,
    )


def _parameter_table(worth: Worth) -> Table:
    """Tabulate σ of each parameter without each sensor, and with each added one."""
    shown = np.flatnonzero(np.isfinite(worth.target)).tolist()
    rows = [("all sensors", worth.std), ("wanted", worth.target)]
    for each in worth.sensors:
        word = "with" if each.is_added else "without"
        rows.append((f"{word} {each.name}", each.present if each.is_added else each.without))
    columns = {
        named(worth.parameters[j], worth.units[j]): numbers(
            [std[j] for _, std in rows], infinite=NOT_ALONE
        )
        for j in shown
    }
    title = "σ of each parameter"
    return tabulated(title, {"": [name for name, _ in rows], **columns}, detail=True)
