"""Labels, numbers, units, names and accuracies as results are written and drawn."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence, Sized

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import first_ones
from mjfim.output.page import number
from mjfim.records.design import Design
from mjfim.records.estimate import Prediction

# Digits of a power of ten, raised.
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

# Largest number of widths of a shortened name that must differ from others.
MOST_WIDTHS = 4

# ---- units


def quotient_unit(unit: str, divisor: str) -> str:
    """Return the unit of a quotient: `quotient_unit("m", "kg")` is "m/kg".

    Compound units are put in brackets.

    Args:
        unit: Unit of the numerator; may be empty.
        divisor: Unit of the denominator; may be empty.
    """
    numerator = unit or "1"
    if not divisor:
        return numerator
    return f"{bracketed_unit(numerator)}/{bracketed_unit(divisor)}"


def bracketed_unit(unit: str) -> str:
    """Return a unit that may be divided or raised as a whole.

    Args:
        unit: The unit.
    """
    compound = any(character in unit for character in " /·*^²³")
    return f"({unit})" if compound else unit


def squared_unit(unit: str) -> str:
    """Return the unit of a variance: "kg" becomes "kg²".

    Args:
        unit: Unit of the quantity; may be empty.
    """
    return f"{bracketed_unit(unit)}²" if unit else ""


# ---- numbers


def format_number(value: float, digits: int = 3) -> str:
    """Write a number with raised powers of ten: 0.874, 1.65×10⁴, ∞; a dash stands for NaN.

    Args:
        value: The number.
        digits: Significant digits.
    """
    if np.isnan(value):
        return "–"
    if np.isinf(value):
        return "∞" if value > 0 else "−∞"

    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    power = int(exponent)

    # Numbers of moderate size are written without a power of ten.
    if value == 0.0 or -4 < power < max(4, digits):
        shown_power = power if value else 0
        decimals = max(digits - 1 - shown_power, 0)
        return f"{value:.{decimals}f}".replace("-", "−")

    raised = str(power).translate(SUPERSCRIPTS)
    return f"{mantissa}×10{raised}".replace("-", "−")


def without_zeros(text: str) -> str:
    """Leave out zeros at the end of a decimal number: `0.05000` becomes `0.05`.

    Args:
        text: The number, as `format_number` writes it.
    """
    mantissa, times, power = text.partition("×")
    if "." in mantissa:
        mantissa = mantissa.rstrip("0").rstrip(".")
    return mantissa + times + power


def format_with_uncertainty(value: float, half_width: float) -> str:
    """Write a value with as many digits as its uncertainty leaves: `0.994 ± 0.012`.

    Args:
        value: The value.
        half_width: Half the width of its interval, in the unit of the value.
    """
    usable = bool(np.isfinite(half_width)) and half_width > 0.0
    largest = max(abs(value), half_width)
    if not usable or not 1e-3 <= largest < 1e5:
        return f"{format_number(value, 4)} ± {format_number(half_width, 2)}"

    # The uncertainty has two significant digits.
    decimals = int(np.clip(1 - np.floor(np.log10(half_width)), 0, 8))
    text = f"{value:.{decimals}f} ± {half_width:.{decimals}f}"
    return text.replace("-", "−")


def format_percent(value: float) -> str:
    """Write a fraction as percent with two significant digits.

    Args:
        value: The fraction, 1 for 100 %.
    """
    if not np.isfinite(value):
        return format_number(value)
    return f"{format_number(100.0 * value, 2)} %"


def shorten(text: str, width: int = 28, among: Iterable[str] = ()) -> str:
    """Shorten a long name; both of its ends stay, with an ellipsis between them.

    Names beside it stay different: the ellipsis moves, and a longer text stays where this is not
    enough.

    Args:
        text: The name.
        width: Largest number of characters, where this tells the names apart.
        among: Names beside it.
    """
    if len(text) <= width:
        return text
    names = [text, *({*among} - {text})]
    for kept in range(2 * ((width - 1) // 2), MOST_WIDTHS * width):
        for head in sorted(range(1, kept), key=lambda head: abs(2 * head - kept)):
            short, *others = (
                name
                if len(name) <= max(width, kept + 1)
                else f"{name[:head]}…{name[head - kept :]}"
                for name in names
            )
            if short not in others:
                return short
    return text


def share_note(shown: Sized, every: Sized, which: str) -> str:
    """Say that only some things are shown, and which; empty where all are.

    Args:
        shown: What is shown.
        every: All of them.
        which: Their name, and by what they were chosen.
    """
    if len(shown) >= len(every):
        return ""
    return f" Shown: {len(shown)} of {len(every)} {which}."


def normal_density(x: Array, mean: float = 0.0, std: float = 1.0) -> Array:
    """Return the density of a normal distribution.

    Args:
        x: (n,) places [unit of the quantity].
        mean: Mean.
        std: Standard deviation, positive.

    Returns:
        (n,) densities [1/unit].
    """
    deviations = (x - mean) / std
    return np.asarray(np.exp(-0.5 * deviations**2) / (np.sqrt(2.0 * np.pi) * std))


# Remark on predicted standard deviations.
BEST_CASE = (
    "σ is the Cramér-Rao bound: the best case, reached if the model and the stated noise are right."
)


def sigma_remark(inflation: Array, names: Sequence[str]) -> str:
    """Say for which residuals standard deviations are predicted.

    Args:
        inflation: (p,) factors by which the residuals of earlier estimates widen them; empty where
            they assume white noise.
        names: Names of the p parameters.
    """
    if not len(inflation):
        return BEST_CASE
    low, high = int(np.argmin(inflation)), int(np.argmax(inflation))
    least, most = (number(inflation[i], 2) for i in (low, high))
    times = least if least == most else f"{least} ({names[low]}) to {most} ({names[high]})"
    return (
        "σ allows for residuals like those of the earlier estimates: it is about "
        f"{times} times that under white noise."
    )


# Cell of a standard deviation that is infinite, because others absorb the parameter's effect.
NOT_ALONE = "not alone"

# Relative difference up to which two sizes are shown as one.
SAME_SIZE = 1e-2

# Share above which a standard deviation says only that nothing is known [percent].
LARGEST_PERCENT = 1000


def relative(std: float, size: float, value: float | None = None) -> str:
    """Write a standard deviation in percent of a size; "-" where there is none.

    Args:
        std: The standard deviation.
        size: The size, in the same unit.
        value: The value beside which it stands; the size is named where it is another number.
    """
    if not size or not np.isfinite(std):
        return "-"
    percent = 100.0 * std / size
    is_of_value = value is None or math.isclose(abs(value), size, rel_tol=SAME_SIZE)
    unit = " %" if is_of_value else f" % of {number(size, 2)}"
    if percent > LARGEST_PERCENT:
        return f"> {LARGEST_PERCENT}{unit}"
    # Shares from 99.5 % on are whole numbers, not powers of ten.
    return number(percent, max(len(f"{percent:.0f}"), 2), unit)


def improvement(before: float, after: float) -> str:
    """Write how a standard deviation changed: divided by a number, or times a number."""
    if not (np.isfinite(before) and np.isfinite(after) and after > 0 and before > 0):
        return "-"
    return f"÷ {before / after:.1f}" if before >= after else f"× {after / before:.1f}"


# Largest number of parameters that a sentence names with their times, length of a list of others
# [characters], and share of the motion from which on a part that tells nothing is named.
MAX_NAMED, MISSED_TEXT, NOTABLE_SHARE = 3, 60, 0.1


def when_learnt(design: Design, write: Callable[[str], str] = str) -> str:
    """Say after which time each parameter is known, and which seconds tell nothing.

    Args:
        design: The design.
        write: Writes the name of a parameter.
    """
    t = design.trajectory.t - design.trajectory.t[0]
    targets = design.targets
    asked = [j for j in design.wanted if np.isfinite(targets[j])]
    if not asked:
        return ""
    seconds = design.seconds_to(targets)
    is_stated = np.isfinite(design.labels.wanted).any()
    goal = f"a σ of {100.0 * targets[asked[0]] / design.sizes[asked[0]]:.2g} %"
    missed = [design.parameters[j] for j in asked if not np.isfinite(seconds[j])]
    if missed:
        what = "the wanted σ" if is_stated else goal
        return (
            f"One experiment does not reach {what} for {first_ones(missed, longest=MISSED_TEXT)}."
        )

    last = sorted(asked, key=lambda j: seconds[j])[-MAX_NAMED:]
    named = [f"{write(design.parameters[j])} {seconds[j]:.3g} s" for j in last]
    others = "" if len(last) == len(asked) else "others earlier, "
    end = float(seconds[last[-1]])
    reached = "Every wanted σ is reached" if is_stated else f"Every parameter reaches {goal}"
    sentence = f"{reached} after {end:.3g} s ({others}{', '.join(named)})"
    if t[-1] - end >= NOTABLE_SHARE * t[-1]:
        sentence += f"; the last {t[-1] - end:.3g} s are not needed for it"
    is_behind = (design.initial.std_over_time <= design.std_over_time)[:, asked].all(axis=1)
    begin = float(t[np.argmin(is_behind)])
    if begin >= NOTABLE_SHARE * t[-1]:
        sentence += f". Until {begin:.3g} s the initial motion tells more"
    return f"{sentence}."


def predicted_data(predictions: Sequence[Prediction]) -> str:
    """Say which data were predicted: those that no fit has seen, or each part by the others."""
    if all(prediction.held_out for prediction in predictions):
        return "recordings that were not fitted"
    return "data by fits without them"
