"""`mjfim compare`: equal budgets, the same evaluation of every method, honest verdicts; files, exit
codes, misuse.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

import mjfim
from mjfim.errors import ExperimentError
from mjfim.excitation import design as design_module
from mjfim.excitation.design import design_task
from mjfim.excitation.evaluation import evaluate_task
from mjfim.excitation.limits.verification import verify
from mjfim.excitation.task import DesignTask
from mjfim.output.manifest import MANIFEST
from mjfim.output.plots.draw import save
from mjfim.output.plots.studies import compare
from mjfim.parallel.budget import StopToken, measured_by
from mjfim.records.design import Design
from mjfim.records.events import Event, StudyEvent
from mjfim.records.studies import DESIGN, Comparison, MethodOutcome, MethodResult
from mjfim.studies import compare as compare_module
from mjfim.studies.compare import chosen_methods
from tests.support.baselines import pendulum, played
from tests.support.cli import MODELS, loads, names, read, run, write_experiment
from tests.support.made_records import make_comparison, make_method_result

LIMITS = "\n[limits]\ncontrol = { force = [-5.0, 5.0] }\nposition = { slide = [-0.5, 0.5] }\n"


@cache
def small() -> Comparison:
    """A chirp and a Fourier series against the design of the cart-pendulum.

    What can be identified is known before the time of the design begins.
    """
    # Seconds of the processor, so that a busy computer decides nothing.
    with pytest.MonkeyPatch.context() as patch, measured_by(time.process_time):
        patch.delattr(design_module, "identifiability_along")
        return mjfim.compare(pendulum(), seconds=1.0, seed=1, methods=["chirp", "fourier5"])


def row(method: str, cost: float, outcome: MethodOutcome = MethodOutcome.INSIDE) -> MethodResult:
    """A made-up result."""
    std = np.full(2, np.sqrt(abs(cost)))
    return make_method_result(
        method,
        cost,
        outcome=outcome,
        control=np.zeros((4, 1)),
        std=std,
        min_eigenvalue=1.0 / cost,
        worst_relative_std=std[0],
    )


def made(*rows: MethodResult, nats: float = 0.0) -> Comparison:
    """A made-up comparison."""
    return make_comparison(
        *rows,
        criterion="D" if nats else "E",
        nats=nats,
        parameters=("a", "b"),
        units=("", ""),
        scale=np.ones(2),
    )


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short experiment under hard limits."""
    path = write_experiment(tmp_path_factory.mktemp("compare"))
    text = (
        path.read_text(encoding="utf-8")
        .replace("control = 1e-3", "control = 0.0")
        .replace("slide = 0.05", "")
    )
    path.write_text(text + LIMITS, encoding="utf-8")
    return path


# ---- records


@pytest.mark.slow
def test_each_method_has_its_budget_and_the_design_comes_last() -> None:
    c = small()
    assert [r.method for r in c.rows] == ["chirp", "fourier5", DESIGN]
    assert all(r.sound for r in c.rows)
    assert all(r.steps > 0 and r.seconds >= 0.95 for r in c.rows[:1])
    assert not c.interrupted


@pytest.mark.slow
def test_rows_hold_the_numbers_of_their_controls() -> None:
    task = DesignTask.resolve(pendulum())
    for r in small().rows:
        assert r.control is not None
        trajectory = task.plant.simulate(task.theta, r.control)
        told = evaluate_task(task, trajectory)
        np.testing.assert_allclose(r.std, told.std, rtol=1e-5)
        assert r.cost == pytest.approx(told.cost, rel=1e-5)
        assert r.criterion == pytest.approx(told.criterion, rel=1e-5)
        scale = task.parameters.scale
        worst = np.linalg.eigvalsh(told.information * np.outer(scale, scale))[0] ** -0.5
        assert r.worst_relative_std == pytest.approx(worst, rel=1e-5)
        assert r.margins == verify(task, trajectory).margins
        qpos, _, ctrl = played(pendulum(), r.control)
        assert np.abs(qpos[:, 0]).max() <= 0.5
        assert np.abs(ctrl).max() <= 5.0


def test_the_verdict_names_the_methods_that_beat_the_design() -> None:
    c = made(
        row("a", 2.0),
        row("b", 0.5),
        row("c", 0.4, MethodOutcome.OUTSIDE),
        row("d", 0.9995),
        row(DESIGN, 1.0),
    )
    assert [r.method for r in c.beating] == [
        "b"
    ]  # not what leaves the limits, nor what is no better
    assert not c.verdict.ok
    assert "beaten by b (J 50 % lower)" in c.findings[0]
    assert c.best is not None
    assert c.best.method == "b"
    won = made(row("a", 2.0), row(DESIGN, 1.0))
    assert won.verdict.ok
    assert "J 50 % lower than that of the best baseline, a" in won.findings[0]
    assert "as good as" in made(row("a", 1.0), row(DESIGN, 1.0)).findings[0]
    assert made(row("a", 1.0), row(DESIGN, 1.0)).verdict.ok


def test_a_design_that_violates_limits_has_lost() -> None:
    c = made(row("a", 2.0), row(DESIGN, 1.0, MethodOutcome.OUTSIDE))
    assert not c.verdict.ok
    assert [r.method for r in c.beating] == ["a"]
    assert "violates a limit" in c.findings[0]
    assert not made(
        row("a", 2.0, MethodOutcome.NOTHING), row(DESIGN, 1.0, MethodOutcome.OUTSIDE)
    ).verdict.ok
    assert not made(row("a", 2.0)).verdict.ok  # no design, no win


def test_logarithms_are_compared_by_their_difference() -> None:
    c = made(row("a", -1.0), row(DESIGN, -3.0), nats=2.0)
    assert c.verdict.ok
    assert c.gain(c.rows[1], c.rows[0]) == pytest.approx(1.0 - np.exp(-1.0))


def test_only_applicable_methods_are_run() -> None:
    hard = DesignTask.resolve(pendulum()).system
    assert chosen_methods(hard, None)[:2] == ("chirp", "multisine")
    assert chosen_methods(hard, ["steps", "design", "steps"]) == ("steps",)
    with pytest.raises(ExperimentError, match="did you mean 'chirp'"):
        chosen_methods(hard, ["chrip"])


@pytest.mark.slow
def test_a_request_to_stop_keeps_finished_methods_and_the_best_of_the_last() -> None:
    token = StopToken()

    def stop_in_the_second_method(event: Event) -> None:
        if isinstance(event, StudyEvent) and event.index == 1 and event.share > 0.3:
            token.request()

    c = mjfim.compare(
        pendulum(),
        seconds=2.0,
        methods=["chirp", "steps"],
        callback=stop_in_the_second_method,
        stop=token,
    )
    assert [(r.method, r.note) for r in c.rows] == [("chirp", ""), ("steps", "interrupted")]
    assert np.isfinite(c.rows[1].cost)
    assert c.interrupted
    assert not c.verdict.ok
    assert "not run" in c.findings[0]
    assert "nterrupted" in c.findings[1]


@pytest.mark.parametrize("budget", [{"seconds": 0.0}, {"seconds": np.inf}])
def test_budgets_must_be_positive(budget: dict[str, float]) -> None:
    with pytest.raises(ExperimentError, match="positive"):
        mjfim.compare(pendulum(), **budget)


# ---- the picture


@pytest.mark.slow
def test_the_picture_has_a_row_per_method() -> None:
    """The best method is on top."""
    cells, bars = compare(small()).panels
    best_first = sorted(small().rows, key=lambda r: r.cost)
    assert cells.y.names == [r.title for r in best_first]
    assert cells.x.names == ["m", "l", "c"]
    assert cells.cells is not None
    design = small().rows[2]
    for values, r in zip(np.exp(cells.cells.values), best_first, strict=True):
        np.testing.assert_allclose(values, r.std / design.std)
    assert [float(mark.x[0]) for mark in bars.marks if mark.kind == "bars"] == pytest.approx(
        [r.worst_relative_std for r in best_first]
    )


@pytest.mark.parametrize(
    "rows",
    [
        (row("a", 1.0),),
        (row("a", 1e-4), row("b", 1.0, MethodOutcome.OUTSIDE), row(DESIGN, 0.5)),
        (
            replace(
                row("a", 1.0, MethodOutcome.NONE),
                control=None,
                worst_relative_std=np.nan,
                std=np.full(2, np.nan),
            ),
        ),
        (replace(row(DESIGN, 1.0), std=np.full(2, np.inf)),),
    ],
)
def test_the_picture_of_any_result_is_drawn(rows: tuple[MethodResult, ...], tmp_path: Path) -> None:
    save(compare(made(*rows)), tmp_path / "x.png")
    assert imread(tmp_path / "x.png").std() > 0.0


# ---- the command line


@pytest.mark.slow
def test_files_table_and_exit_code(study: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with measured_by(time.process_time):
        result = run(
            "compare", study, "-o", out, "--seconds", 2, "--methods", "chirp,steps", "--json"
        )
    assert result.exit_code == 0, result.stderr
    told = loads(result.stdout)
    assert told == read(out / "compare.json")
    assert [m["method"] for m in told["methods"]] == ["chirp", "steps", DESIGN]
    assert told["ok"] is True
    assert told["budget"] == {"seconds": 2.0}
    assert all(len(m["std"]) == 3 and m["limits"]["margins"] for m in told["methods"])
    controls = {f"control_{m}.csv" for m in ("chirp", "steps", DESIGN)}
    files = {MANIFEST, "report.html", *controls, *(f"compare.{e}" for e in ("json", "npz", "png"))}
    assert names(out) == files
    assert imread(out / "compare.png").shape[0] > 300
    with measured_by(time.process_time):
        again = run("compare", study, "-o", out, "--seconds", 2, "--methods", "chirp", "-v")
    assert again.exit_code == 0, again.stderr
    assert names(out) == files - {"control_steps.csv"}
    for word in ("mjfim's design", "worst σ", "σ of each parameter", "m (kg)", "The design is"):
        assert word in " ".join(again.stdout.split())
    assert "…" not in again.stdout  # every number whole
    # a control of it is the initial control of another experiment
    text = study.read_text(encoding="utf-8").replace(
        '"cart_pendulum.csv"', f'"{out / "control_chirp.csv"}"'
    )
    (study.parent / "next.toml").write_text(text, encoding="utf-8")
    task = DesignTask.resolve(mjfim.Experiment.from_file(study.parent / "next.toml"))
    reached = next(m for m in read(out / "compare.json")["methods"] if m["method"] == "chirp")
    assert task.problem.point(task.initial).cost == pytest.approx(reached["cost"], rel=1e-6)


def worse(design: Callable[..., Design]) -> Callable[..., Design]:
    """A design that returns its initial control."""

    def rigged(task: DesignTask, *args: Any, **kwargs: Any) -> Design:
        found = design_task(task, *args, **kwargs)
        gentle = task.plant.simulate(task.theta, 0.05 * task.control)
        return replace(found, final=evaluate_task(task, gentle))

    return rigged


@pytest.mark.slow
def test_a_design_that_is_worse_is_reported_as_beaten(
    study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compare_module, "design_task", worse(design_task))
    with measured_by(time.process_time):
        result = run("compare", study, "-o", tmp_path, "--seconds", 1, "--methods", "chirp", "-v")
    assert result.exit_code == 1
    assert "beaten by chirp" in " ".join(result.stdout.split())
    assert "beaten by chirp" in result.stderr
    told = read(tmp_path / "compare.json")
    assert (told["ok"], told["best"], told["beating"]) == (False, "chirp", ["chirp"])


def test_misuse(study: Path, tmp_path: Path) -> None:
    for words, said in (
        ((tmp_path / "no.toml", "-o", tmp_path / "o"), "no.toml"),
        ((study, "-o", tmp_path / "o", "--methods", "chirp,sweep"), "unknown method 'sweep'"),
        ((study, "-o", tmp_path / "o", "--methods", " , "), "no baseline is named"),
        ((study, "-o", tmp_path / "o", "--methods", "design"), "no baseline is named"),
        ((study, "-o", tmp_path / "o", "--seconds", 0), "positive"),
        ((study, "-o", study), study.name),
        ((study,), "--output"),
    ):
        result = run("compare", *words)
        assert result.exit_code == 2, words
        assert said in result.stderr
        assert "Traceback" not in result.stderr
    assert not (tmp_path / "o").exists()


@pytest.mark.slow
def test_a_chirp_that_never_ends_at_rest_found_nothing() -> None:
    """It was evaluated, and no size of it keeps all limits."""
    rig = mjfim.Experiment.from_file(MODELS / "cart_pendulum_rig.toml").replace(horizon=1.0)
    found = mjfim.compare(rig, methods=("chirp",), seconds=1.0, progress=False)
    chirp = next(each for each in found.rows if each.method == "chirp")
    assert chirp.outcome is MethodOutcome.NOTHING and chirp.steps > 0
