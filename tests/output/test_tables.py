"""Tables of results as Markdown and as LaTeX: complete, escaped, with the marks of their rules."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import unicodedata
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mjfim.output import latex, markdown
from mjfim.output.summaries.monte_carlo import describe_study
from mjfim.output.summary_parts import (
    Column,
    ColumnGroup,
    Name,
    Quantity,
    Row,
    Summary,
    SummaryTable,
)
from tests.support.made_records import make_study
from tests.support.paths import ROOT

# A name with every character that Markdown or LaTeX could take for a mark of its own.
HOSTILE = r"a|b*c`d<e>f_g\h{i}j$k&l#m%n~o^p_[q]"


def made_table(*, title: str = "Accuracy", note: str = "") -> SummaryTable:
    """Make a table with groups, numbers of all sizes and a hostile name."""
    numbers = (1.65e-5, 0.25, np.inf, np.nan)
    cells = (Name(name=HOSTILE, unit="N m²"), *(Quantity(value=n, suffix=" %") for n in numbers))
    headings = ("", "λ₁", "σ", "×", "Δ")
    return SummaryTable(
        key="k",
        title=title,
        columns=tuple(Column(heading=h, left=not i) for i, h in enumerate(headings)),
        rows=(Row(cells=cells), Row(cells=("x_1", "–", "·", "0.8 … 1.2", "−1"))),
        groups=(
            ColumnGroup(trajectory="initial", first=1, last=2),
            ColumnGroup(trajectory="final", first=3, last=4),
        ),
        note=note,
    )


def unescaped(text: str, mark: str) -> int:
    """Count a character without a backslash before it."""
    return len(re.findall(rf"(?<!\\){re.escape(mark)}", text))


def test_markdown_has_a_cell_for_every_column_and_escapes_marks() -> None:
    lines = markdown.render_table(made_table()).splitlines()
    assert [unescaped(line, "|") for line in lines] == [6] * 4
    assert lines[1] == "| :-- | --: | --: | --: | --: |"
    assert "initial: λ₁" in lines[0] and "designed: ×" in lines[0]
    assert r"a\|b\*c\`d\<e\>f_g\\h{i}" in lines[2]
    assert "| 1.65e-05 % | 0.25 % | ∞ | - |" in lines[2]


def test_markdown_may_move_details_to_the_right() -> None:
    table = made_table()
    columns = tuple(replace(column, detail=i == 1) for i, column in enumerate(table.columns))
    moved = markdown.render_table(replace(table, columns=columns), details_last=True)
    first, _, _, last = moved.splitlines()
    assert first.endswith("| initial: λ₁ |")
    assert last == "| x_1 | · | 0.8 … 1.2 | −1 | – |"


def test_latex_has_a_cell_for_every_column_and_escapes_marks() -> None:
    text = latex.render_table(made_table(note="50 % of θ"))
    lines = text.splitlines()
    rows = [line for line in lines if line.endswith(r"\\") and "multicolumn" not in line]
    assert [unescaped(row, "&") for row in rows] == [4] * 3
    assert unescaped(text, "{") == unescaped(text, "}")
    assert all(unescaped(line, "$") % 2 == 0 for line in lines)
    assert not any(unescaped(line, mark) for line in rows for mark in "#%~^|" if "~\\%" not in line)

    assert r"\multicolumn{2}{c}{initial} & \multicolumn{2}{c}{designed} \\" in text
    assert r"\cmidrule(lr){2-3} \cmidrule(lr){4-5}" in text
    assert r"$1.65 \times 10^{-5}$~\%" in text
    assert r"\textbackslash{}h\{i\}j\$k\&l\#m\%n\textasciitilde{}o\textasciicircum{}p\_" in text
    assert r"50 \% of $\theta$" in text
    assert text.isascii()


@pytest.mark.parametrize("rule", ["toprule", "midrule", "bottomrule"])
def test_latex_has_the_rules_of_booktabs(rule: str) -> None:
    assert latex.render_table(made_table()).count(rf"\{rule}") == 1


def test_all_tables_of_a_study_are_written_with_their_titles() -> None:
    summary = describe_study(make_study(), ("kg", "m", ""))
    in_markdown, in_latex = markdown.render_tables(summary), latex.render_tables(summary)
    assert len(summary.tables) == 5
    for table in summary.tables:
        assert f"## {markdown.escape(table.title)}\n" in in_markdown
        assert rf"\caption{{{latex.escape(table.title)}}}" in in_latex
    assert in_latex.replace("é", "e").isascii()


def test_line_breaks_do_not_break_a_table() -> None:
    table = made_table(title="two\nlines")
    summary = Summary(title="A\nB", outcome="", parts=(table,))
    assert "# A B\n" in markdown.render_tables(summary)
    assert r"\caption{two lines}" in latex.render_tables(summary)


def test_latex_knows_every_character_of_the_tables() -> None:
    """Words of summaries and records hold no character that LaTeX refuses."""
    files = [*(ROOT / "mjfim" / "output" / "summaries").glob("*.py")]
    files += [ROOT / "mjfim" / "output" / "summary_parts.py"]
    files += (ROOT / "mjfim" / "records").glob("*.py")
    nodes = [node for file in files for node in ast.walk(ast.parse(file.read_text("utf-8")))]
    texts = [node.value for node in nodes if isinstance(node, ast.Constant)]
    used = {character for text in texts if isinstance(text, str) for character in text}

    # LaTeX reads letters with accents as they are.
    unknown = {
        c for c in used if not latex.escape(c).isascii() and not unicodedata.decomposition(c)
    }
    assert unknown == set()


@pytest.mark.slow
def test_tables_with_hostile_names_are_compiled(tmp_path: Path) -> None:
    compiler = shutil.which("pdflatex")
    if compiler is None:
        pytest.skip("pdflatex is not installed")
    table = made_table(title=HOSTILE + '"σ ± × ÷ ▶ 10⁻⁷', note="50 % of σ²; a_1 & b")
    wide = SummaryTable(
        key="wide",
        title="Wide",
        columns=tuple(Column(heading=f"a long heading {k}") for k in range(12)),
        rows=(Row(cells=tuple(f"{k}" for k in range(12))),),
    )
    summary = Summary(title="", outcome="", parts=(table, table, wide))
    lines = [r"\documentclass{article}", r"\usepackage{booktabs,graphicx}", r"\begin{document}"]
    lines += [latex.render_tables(summary), r"\end{document}", ""]
    (tmp_path / "tables.tex").write_text("\n".join(lines), encoding="utf-8")

    ended = subprocess.run(
        [compiler, "-draftmode", "-interaction=nonstopmode", "-halt-on-error", "tables.tex"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        encoding="utf-8",
        errors="replace",
        timeout=60.0,
        check=False,
    )
    if "booktabs.sty' not found" in ended.stdout:
        pytest.skip("this LaTeX has no package booktabs")
    assert ended.returncode == 0, ended.stdout[-2000:]

    # A table that is wider than the text is scaled down.
    assert "Overfull" not in ended.stdout
