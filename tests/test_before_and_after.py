"""The table of figures before and now: medians, ratios, verdicts, and kept measurements."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from io import StringIO
from math import inf, nan
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

import mjfim
from mjfim.excitation.task import DesignTask
from mjfim.records.comparison import DESIGN
from mjfim.studies import compare
from scripts import benchmarks
from scripts.benchmarks import anytime, measurements, seven_hinges
from scripts.benchmarks import before_and_after as script
from scripts.benchmarks.before_and_after import Earlier, Line, Measurement, Result
from scripts.benchmarks.checkouts import ROOT, commit_hash, earlier_checkout, run_command
from scripts.benchmarks.measurements import Figure, Figures
from scripts.benchmarks.run_in_subprocess import run_in_subprocess


def line(goal: float | None = 2.0, is_larger_better: bool = False) -> Line:
    return Line(name="", figure="", goal=goal, is_larger_better=is_larger_better)


@pytest.mark.parametrize(
    ("value", "stated", "expected"),
    [
        (2.0, line(), "met"),
        (2.06, line(), "missed by 3 %"),
        (5.0, line(), "missed by a factor 2.5"),
        (inf, line(), "missed"),
        (nan, line(), "missed"),
        (0.0, line(), "met"),
        (3.0, line(None), ""),
        (403.2, line(403.15, True), "met"),
        (403.0, line(403.15, True), "missed by 0.037 %"),
        (201.575, line(403.15, True), "missed by a factor 2"),
        (0.0, line(403.15, True), "missed"),
    ],
)
def test_a_verdict_says_how_far_the_goal_is(value: float, stated: Line, expected: str) -> None:
    assert script.verdict(Figure(value), stated) == expected


def test_a_failed_measurement_misses_its_goal() -> None:
    assert script.verdict(None, line()) == "missed"


def test_a_goal_of_another_machine_is_a_ratio_to_the_earlier_commit() -> None:
    """On a machine that is half as fast, both versions take twice as long."""
    stated = script.Line(name="a", figure="b", unit="s", goal=2.5, before_there=5.0)
    text = "missed by a factor 1.6; as a ratio (≤ 0.5) met"
    assert script.verdict(Figure(4.0), stated, Figure(10.0)) == text
    assert script.verdict(Figure(4.0), stated, Figure(7.0)).endswith("missed by a factor 1.1")
    assert script.verdict(Figure(4.0), stated) == "missed by a factor 1.6"
    assert script.verdict(Figure(2.0), stated, Figure(1.0)) == "met"
    assert script.text_of(None, line()) == "failed"


def test_a_design_that_alone_finds_a_motion_meets_its_goal(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def costs(design: float, baseline: float) -> Figure:
        """J over the best baseline, with these costs."""
        found = {DESIGN: design, "random": baseline}
        results = SimpleNamespace(
            cost=lambda method, seconds: found[method],
            best_baseline=lambda seconds: (baseline, "random"),
        )
        monkeypatch.setattr(anytime, "run", lambda *arguments: [])
        monkeypatch.setattr(anytime, "Results", lambda *arguments: results)
        return measurements.beside_baselines("cart_pendulum", 1.0)["over best baseline"]

    goal = line(1.0)
    assert script.verdict(costs(2.0, 4.0), goal) == "met"
    assert script.verdict(costs(2.0, inf), goal) == "met"
    assert script.text_of(costs(2.0, inf), goal) == "0"
    assert script.verdict(costs(inf, 4.0), goal) == "missed"
    assert script.verdict(costs(inf, inf), goal) == "missed"
    assert script.text_of(costs(inf, inf), goal) == "none found"


def test_ratios_are_those_of_the_wall_and_of_the_processors() -> None:
    assert script.ratio_of(Figure(4.0, 6.0), Figure(1.0, 3.0)) == "0.25 (0.5)"
    assert script.ratio_of(Figure(4.0), Figure(1.0)) == "0.25"
    assert script.ratio_of(Figure(0.0), Figure(1.0)) == ""
    assert script.ratio_of(None, Figure(1.0)) == ""


def test_numbers_have_their_unit_and_the_time_of_the_processors() -> None:
    seconds = Line(name="", figure="", unit="s")
    assert script.text_of(Figure(1.2345, 2.3456), seconds) == "1.23 s (2.35)"
    assert script.text_of(Figure(403.15), line()) == "403.15"
    assert script.text_of(Figure(330000.0), line()) == "330,000"
    assert script.text_of(Figure(inf), seconds) == "none found"
    assert script.text_of(Figure(0.0), line(is_larger_better=True)) == "none found"


def test_medians_are_those_of_each_figure() -> None:
    runs: Sequence[Figures] = [
        {"time": Figure(wall, wall + 1.0), "steps": Figure(7.0)} for wall in (5.0, 1.0, 2.0)
    ]
    assert script.medians(runs) == {"time": Figure(2.0, 3.0), "steps": Figure(7.0)}
    assert script.medians([]) is None


def counting(calls: list[Path], failing: Path | None = None) -> Callable[[Path], Figures]:
    """A measurement that fails with one version and becomes slower with each call."""

    def run(package: Path) -> Figures:
        calls.append(package)
        if package == failing:
            raise RuntimeError("no such option")
        return {"time": Figure(float(len(calls)), 1.0)}

    return run


def test_versions_take_turns_and_kept_measurements_are_not_made_again(tmp_path: Path) -> None:
    calls: list[Path] = []
    said: list[str] = []
    earlier = Earlier(commit="1234567", folder=tmp_path / "before")
    stated = Measurement(name="made_up", run=counting(calls), lines=(), repeats=2)

    expected = Result(before={"time": Figure(2.0, 1.0)}, now={"time": Figure(3.0, 1.0)})
    assert script.measured(stated, earlier, tmp_path, said.append) == expected
    assert calls == [earlier.folder, ROOT] * 2

    assert script.measured(stated, earlier, tmp_path, said.append) == expected
    assert len(calls) == 4

    # Another commit, or another number of runs, is another measurement.
    other = replace(earlier, commit="89abcde")
    assert script.measured(stated, other, tmp_path, said.append) != expected
    assert len(calls) == 8
    script.measured(replace(stated, repeats=1), other, tmp_path, said.append)
    assert len(calls) == 10
    assert not said


def test_a_run_that_fails_is_told_and_its_measurement_is_made_again(tmp_path: Path) -> None:
    calls: list[Path] = []
    said: list[str] = []
    earlier = Earlier(commit="1234567", folder=tmp_path / "before")
    stated = Measurement(name="made_up", run=counting(calls, earlier.folder), lines=(), repeats=2)

    expected = Result(before=None, now={"time": Figure(3.0, 1.0)})
    assert script.measured(stated, earlier, tmp_path, said.append) == expected
    assert said == ["made_up, before: no such option"] * 2
    assert not list(tmp_path.iterdir())

    script.measured(stated, earlier, tmp_path, said.append)
    assert len(calls) == 8


def test_a_derived_figure_uses_the_earlier_steps() -> None:
    earlier: Figures = {"steps": Figure(1000.0), "iteration": Figure(1.0, 2.0)}
    own: Figures = {
        "steps": Figure(10.0),
        "iteration": Figure(0.2, 0.3),
        "bare step": Figure(1e-4),
    }
    derived = Line(name="", figure="ratio", derived=script._over_earlier_steps)
    found = script.figure_of(derived, Result(before=earlier, now=own), own)
    assert found is not None
    assert found.value == pytest.approx(3.0)
    assert script.figure_of(derived, Result(before=None, now=own), own) is None

    earlier["steps"] = Figure(0.0)
    assert script.figure_of(derived, Result(before=earlier, now=own), own) == Figure(inf)


def test_every_part_has_measurements_with_names_of_their_own(tmp_path: Path) -> None:
    for is_quick in (True, False):
        sizes = script.Sizes(is_quick=is_quick, hours=1.0, folder=tmp_path)
        found = [each for part in script.PARTS.values() for each in part.measurements(sizes)]
        names = [each.name for each in found]
        assert len(set(names)) == len(names)
        assert {"short_fit", "help"} <= set(names)
        assert all(Path(name).name == name for name in names)


@pytest.mark.parametrize("is_quick", [False, True])
def test_every_measurement_gets_the_arguments_of_its_function(
    is_quick: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    called: list[str] = []

    def bound(function: str, package: Path, **arguments: object) -> None:
        """Raise TypeError where the function does not take the arguments."""
        inspect.signature(getattr(measurements, function)).bind(**arguments)
        called.append(function)

    monkeypatch.setattr(script, "measure_in_subprocess", bound)
    sizes = script.Sizes(is_quick=is_quick, hours=1.0, folder=tmp_path)
    for name in ("starts", "ratios", "limits", "compare"):
        for measurement in script.PARTS[name].measurements(sizes):
            measurement.run(tmp_path)
    assert {"starts_side_by_side", "ratio_to_engine", "limited_cart_pendulum"} < set(called)


def test_the_table_has_a_row_for_each_line() -> None:
    lines = (
        Line(name="an iteration", figure="time", unit="s", goal=0.25),
        Line(name="its steps", figure="steps"),
    )
    stated = Measurement(name="arm", run=lambda package: None, lines=lines)
    result = Result(
        before={"time": Figure(0.5, 1.0), "steps": Figure(40.0)},
        now={"time": Figure(0.2, 0.4), "steps": Figure(4.0)},
    )
    table = script.empty_table("1234567")
    script.add_lines(table, stated, result)
    written = StringIO()
    Console(file=written, width=150).print(table)

    rows = [
        [cell.strip() for cell in row.strip("│").split("│")]
        for row in written.getvalue().splitlines()
        if row.startswith("│")
    ]
    assert rows == [
        ["an iteration", "0.5 s (1)", "0.2 s (0.4)", "0.4 (0.4)", "≤ 0.25 s", "met"],
        ["its steps", "40", "4", "0.1", "", ""],
    ]


def test_an_unknown_commit_is_named() -> None:
    with (
        pytest.raises(SystemExit, match="no_such_commit"),
        earlier_checkout("no_such_commit"),
    ):
        pass
    with pytest.raises(SystemExit, match="no_such_commit"):
        commit_hash("no_such_commit")


def test_a_process_uses_the_package_of_a_folder_and_these_benchmarks(tmp_path: Path) -> None:
    (tmp_path / "mjfim").mkdir()
    (tmp_path / "mjfim" / "__init__.py").write_text("")
    code = (
        "import scripts.benchmarks\n"
        "found = [mjfim.__file__, scripts.benchmarks.__file__, sys.path[0], sys.argv[1]]"
    )
    assert run_in_subprocess(code, "word", package=tmp_path) == [
        str(tmp_path / "mjfim" / "__init__.py"),
        str(ROOT / "scripts" / "benchmarks" / "__init__.py"),
        str(tmp_path),
        "word",
    ]


def test_a_command_is_that_of_its_package(tmp_path: Path) -> None:
    # Without `__init__.py`, an installed package would come first.
    (tmp_path / "mjfim").mkdir()
    (tmp_path / "mjfim" / "__init__.py").write_text("")
    (tmp_path / "mjfim" / "__main__.py").write_text(
        "import sys\nprint(sys.argv[1:], file=sys.stderr)\nsys.exit(3)\n"
    )
    run = run_command(tmp_path, ["check", "gone.toml"])
    assert run.code == 3
    assert run.messages.strip() == "['check', 'gone.toml']"
    assert run.processor > 0.0
    assert run.gigabytes > 0.0


def test_the_help_states_the_minutes_of_the_parts() -> None:
    words = script.parts_in_words()
    for name, part in script.PARTS.items():
        assert f"{name:12s} {part.minutes[0]:4g} ({part.minutes[1]:g})" in words


def test_a_measurement_without_an_earlier_one_is_kept_and_leaves_its_cell_empty(
    tmp_path: Path,
) -> None:
    calls: list[Path] = []
    earlier = Earlier(commit="1234567", folder=tmp_path / "before")
    stated = Measurement(
        name="new",
        run=counting(calls),
        lines=(Line(name="an error", figure="time", goal=2.0),),
        has_before=False,
    )
    expected = Result(before=None, now={"time": Figure(1.0, 1.0)})
    for _ in range(2):
        assert script.measured(stated, earlier, tmp_path, pytest.fail) == expected
    assert calls == [ROOT]

    table = script.empty_table("1234567")
    script.add_lines(table, stated, expected)
    assert [list(column.cells) for column in table.columns] == [
        ["an error"],
        [""],
        ["1"],
        [""],
        ["≤ 2"],
        ["met"],
    ]


def test_a_part_that_cannot_be_measured_says_why(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(script, "find_spec", lambda name: None)
    monkeypatch.setattr(script, "earlier_checkout", lambda commit: nullcontext(tmp_path / "before"))
    monkeypatch.setattr(script, "commit_hash", lambda commit: "1234567")
    written = StringIO()
    args = SimpleNamespace(
        before="1234567", results=tmp_path / "kept", quick=True, hours=1.0, only=["oracle"]
    )
    table = script.empty_table("1234567")
    script.fill(table, args, Console(file=written, width=150))
    assert "mjfim[oracle]" in written.getvalue()
    assert list(table.columns[-1].cells) == ["not measured"]


def test_errors_beside_automatic_derivatives_are_those_of_the_oracle(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    errors = {"psi": 1e-9, "A": 2e-9, "B": 3e-9, "mixed": 4e-7}
    found = SimpleNamespace(**errors, psi_closed=nan, mixed_closed=nan)
    oracle = ModuleType("mjx_oracle")
    oracle.CASES = [SimpleNamespace(model=name) for name in ("one", "other")]  # type: ignore[attr-defined]
    oracle.agreement = lambda case: found if case.model == "other" else None  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "scripts.benchmarks.mjx_oracle", oracle)
    monkeypatch.setattr(benchmarks, "mjx_oracle", oracle, raising=False)

    figures = measurements.automatic_derivatives("other")
    assert {name: figures[name].value for name in errors} == errors


def test_the_arm_of_seven_hinges_starts_within_its_limits(tmp_path: Path) -> None:
    task = DesignTask.resolve(seven_hinges.experiment(2.0, tmp_path), threads=1)
    model = task.system.model
    assert model.nv == model.nu == 7
    assert task.is_limited
    assert len(task.theta) == 11

    # The control at the beginning holds the pose against gravity.
    qpos = task.initial.qpos
    assert np.abs(qpos[:3] - seven_hinges.HOME).max() < 1e-4
    assert np.abs(task.initial.qvel).max() < min(seven_hinges.SPEEDS)


def test_a_design_is_compared_with_the_best_series_that_keeps_the_limits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def row(method: str, sigma: float, is_sound: bool = True) -> SimpleNamespace:
        return SimpleNamespace(method=method, worst_relative_std=sigma, sound=is_sound)

    rows = [row("fourier5", 0.5), row("fourier15", 0.1, False), row(DESIGN, 0.4)]
    monkeypatch.setattr(
        compare, "compare_task", lambda *args, **options: SimpleNamespace(rows=rows)
    )
    found = measurements.design_over_series(2.0, 1.0)
    assert found["series"].value == 0.5
    assert found["over best series"].value == pytest.approx(0.8)

    # A design that leaves a limit has no figure.
    rows[-1] = row(DESIGN, 0.4, False)
    assert measurements.design_over_series(2.0, 1.0)["over best series"].value == inf


def test_the_parses_and_compilations_of_a_design_are_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def resolved_twice(experiment: mjfim.Experiment, **options: object) -> None:
        for _ in range(2):
            DesignTask.resolve(experiment, threads=1)

    monkeypatch.setattr(mjfim, "design", resolved_twice)
    found = measurements.model_work("cart_pendulum")
    assert (found["parses"].value, found["compilations"].value) == (2.0, 2.0)
