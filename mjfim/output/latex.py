r"""Tables of results as LaTeX, for papers: `\input` the file.

It needs the packages booktabs and graphicx. Tables that are wider than the text are scaled down.
"""

from __future__ import annotations

import numpy as np

from mjfim.output.summary_parts import Cell, Quantity, Summary, SummaryTable
from mjfim.output.vocabulary import shown_word

# What stands at the top of the file.
HEADER = r"""% Tables of mjfim; the preamble of the document needs \usepackage{booktabs,graphicx}.
\providecommand{\atmostlinewidth}[1]{\sbox0{#1}%
  \ifdim\wd0>\linewidth\resizebox{\linewidth}{!}{\usebox0}\else\usebox0\fi}"""

# Characters that mean something else to LaTeX.
SPECIAL = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "$": r"\$",
    "&": r"\&",
    "#": r"\#",
    "%": r"\%",
    "_": r"\_",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': "''",
}

# Characters of units and formulas as commands of mathematics.
MATHEMATICS = {
    "×": r"\times",
    "÷": r"\div",
    "▶": r"\triangleright",
    "•": r"\bullet",
    "·": r"\cdot",
    "±": r"\pm",
    "∞": r"\infty",
    "−": "-",
    "→": r"\to",
    "≤": r"\le",
    "≥": r"\ge",
    "√": r"\surd",
    "°": r"^\circ",
    "′": "'",
    "∂": r"\partial",
    "α": r"\alpha",
    "β": r"\beta",
    "γ": r"\gamma",
    "δ": r"\delta",
    "Δ": r"\Delta",
    "ζ": r"\zeta",
    "θ": r"\theta",
    "λ": r"\lambda",
    "μ": r"\mu",
    "ρ": r"\rho",
    "σ": r"\sigma",
    "τ": r"\tau",
    "φ": r"\phi",
    "χ": r"\chi",
    "ψ": r"\psi",
    "ω": r"\omega",
    "Ω": r"\Omega",
    "⁻": "^{-}",
    **{raised: f"^{{{k}}}" for k, raised in enumerate("⁰¹²³⁴⁵⁶⁷⁸⁹")},
    **{lowered: f"_{{{k}}}" for k, lowered in enumerate("₀₁₂₃₄₅₆₇₈₉")},
}

# Marks of text that LaTeX writes with letters of ASCII.
PUNCTUATION = {"–": "--", "—": "---", "…": r"\dots{}", "’": "'", "“": "``", "”": "''"}

# What stands for each of these characters.
WRITTEN = {
    **SPECIAL,
    **{character: f"${command}$" for character, command in MATHEMATICS.items()},
    **PUNCTUATION,
}


def render_tables(summary: Summary) -> str:
    """Render all tables of a summary, each as an environment `table` with its title as caption.

    Args:
        summary: The summary.
    """
    return "\n\n".join([HEADER, *(render_table(table) for table in summary.tables)]) + "\n"


def render_table(table: SummaryTable) -> str:
    """Render a table with the rules of the package booktabs.

    Args:
        table: The table.
    """
    alignment = "".join("l" if column.left else "r" for column in table.columns)
    lines = [
        r"\begin{table}",
        r"  \centering",
        *([rf"  \caption{{{escape(table.title)}}}"] if table.title else []),
        rf"  \atmostlinewidth{{\begin{{tabular}}{{{alignment}}}",
        r"    \toprule",
        *_groups(table),
        _line([escape(str(column.heading)) for column in table.columns]),
        r"    \midrule",
        *(_line([_written(cell) for cell in row.cells]) for row in table.rows),
        r"    \bottomrule",
        r"  \end{tabular}}",
    ]
    if table.note:
        lines.append(rf"  \par\smallskip {escape(table.note)}")
    return "\n".join([*lines, r"\end{table}"])


def escape(text: str) -> str:
    """Return a text on one line as LaTeX; letters beyond ASCII and Greek stay as they are.

    Args:
        text: The text.
    """
    return "".join(WRITTEN.get(character, character) for character in " ".join(text.split()))


def _groups(table: SummaryTable) -> list[str]:
    """Return the line with headings above several columns, and the rules below them."""
    if not table.groups:
        return []

    cells, rules, column = [], [], 0
    for group in table.groups:
        # Empty cells stand before a group.
        cells += [""] * (group.first - column)
        span = group.last - group.first + 1
        word = escape(shown_word(group.trajectory))
        cells.append(rf"\multicolumn{{{span}}}{{c}}{{{word}}}")
        rules.append(rf"\cmidrule(lr){{{group.first + 1}-{group.last + 1}}}")
        column = group.last + 1

    cells += [""] * (len(table.columns) - column)
    return [_line(cells), f"    {' '.join(rules)}"]


def _line(cells: list[str]) -> str:
    """Return a line of a table."""
    return rf"    {' & '.join(cells)} \\"


def _written(cell: Cell) -> str:
    """Return a cell; numbers stand in mathematics, with a power of ten in place of e-05."""
    if not isinstance(cell, Quantity) or not np.isfinite(cell.value):
        return escape(str(cell))

    mantissa, _, exponent = f"{cell.value:.{cell.digits}g}".partition("e")
    power = rf" \times 10^{{{int(exponent)}}}" if exponent else ""
    return f"${mantissa}{power}${_suffix(cell.suffix)}"


def _suffix(suffix: str) -> str:
    """Return the text behind a number; its space does not break the line."""
    joint = "~" if suffix.startswith(" ") else ""
    return joint + escape(suffix.strip())
