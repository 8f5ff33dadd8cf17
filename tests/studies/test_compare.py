"""`mjfim compare`: equal budgets, the same evaluation of every method, honest verdicts; files, exit
codes, misuse.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from numpy.testing import assert_allclose

import mjfim
from mjfim.errors import ExperimentError
from mjfim.excitation import design as design_module
from mjfim.excitation.evaluation import evaluate_task
from mjfim.excitation.limits.verification import verify
from mjfim.excitation.task import DesignTask
from mjfim.output.manifest import MANIFEST
from mjfim.output.plots.draw import save
from mjfim.output.plots.studies import compare
from mjfim.parallel.budget import StopToken, measured_by
from mjfim.records.events import Event, StudyEvent
from mjfim.records.studies import DESIGN, Comparison, MethodOutcome, MethodResult
from mjfim.studies.compare import chosen_methods
from tests.support.cart_pendulum import cart_pendulum
from tests.support.cli import MODELS, loads, misused, names, read, run, write_experiment
from tests.support.limits import excess_of
from tests.support.made_records import make_comparison, make_method_result

# The cart-pendulum over two seconds under hard limits, without weights.
PENDULUM = cart_pendulum(
    horizon=2.0,
    limits={"control": {"force": (-5.0, 5.0)}, "position": {"slide": (-0.5, 0.5)}},
    cost={"control": 0.0, "tracking": {}},
)

LIMITS = "\n[limits]\ncontrol = { force = [-5.0, 5.0] }\nposition = { slide = [-0.5, 0.5] }\n"


def row(method: str, cost: float, outcome: MethodOutcome = MethodOutcome.INSIDE) -> MethodResult:
    """A made-up result."""
    std = np.full(2, np.sqrt(abs(cost)))
    numbers = {"control": np.zeros((4, 1)), "std": std, "worst_relative_std": std[0]}
    return make_method_result(method, cost, outcome=outcome, **numbers)


def made(*rows: MethodResult, nats: float = 0.0) -> Comparison:
    """A made-up comparison."""
    names = {"parameters": ("a", "b"), "units": ("", ""), "scale": np.ones(2)}
    return make_comparison(*rows, criterion="D" if nats else "E", nats=nats, **names)


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short experiment under hard limits."""
    path = write_experiment(tmp_path_factory.mktemp("compare"))
    text = path.read_text(encoding="utf-8").replace("control = 1e-3", "control = 0.0")
    path.write_text(text.replace("slide = 0.05", "") + LIMITS, encoding="utf-8")
    return path


# ---- records


@pytest.mark.slow
def test_rows_hold_the_numbers_of_their_controls(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each method has its budget, and the design comes last.

    What can be identified is known before the time of the design begins.
    """
    # Seconds of the processor, so that a busy computer decides nothing.
    monkeypatch.delattr(design_module, "identifiability_along")
    with measured_by(time.process_time):
        found = mjfim.compare(PENDULUM, seconds=1.0, seed=1, methods=["chirp", "fourier5"])
    task = DesignTask.resolve(PENDULUM)
    assert [r.method for r in found.rows] == ["chirp", "fourier5", DESIGN]
    assert not found.interrupted
    assert found.rows[0].seconds >= 0.95
    for r in found.rows:
        trajectory = task.plant.simulate(task.theta, r.control)
        told = evaluate_task(task, trajectory)
        assert_allclose(r.std, told.std, rtol=1e-5)
        assert r.cost == pytest.approx(told.cost, rel=1e-5)
        assert r.criterion == pytest.approx(told.criterion, rel=1e-5)
        scale = task.parameters.scale
        worst = np.linalg.eigvalsh(told.information * np.outer(scale, scale))[0] ** -0.5
        assert r.worst_relative_std == pytest.approx(worst, rel=1e-5)
        assert r.margins == verify(task, trajectory).margins
        assert max(excess_of(task, r.control).values()) <= 0.0


def test_the_verdict_names_the_methods_that_beat_the_design() -> None:
    """What leaves the limits counts as little as what is no better."""
    outside = row("c", 0.4, MethodOutcome.OUTSIDE)
    c = made(row("a", 2.0), row("b", 0.5), outside, row("d", 0.9995), row(DESIGN, 1.0))
    assert [r.method for r in c.beating] == ["b"]
    assert not c.verdict.ok
    assert "beaten by b (J 50 % lower)" in c.findings[0]
    assert c.best.method == "b"
    for cost, words in (
        (2.0, "J 50 % lower than that of the best baseline, a"),
        (1.0, "as good as"),
    ):
        won = made(row("a", cost), row(DESIGN, 1.0))
        assert won.verdict.ok
        assert words in won.findings[0]


def test_a_design_that_violates_limits_has_lost() -> None:
    outside = row(DESIGN, 1.0, MethodOutcome.OUTSIDE)
    c = made(row("a", 2.0), outside)
    assert not c.verdict.ok
    assert [r.method for r in c.beating] == ["a"]
    assert "violates a limit" in c.findings[0]
    assert not made(row("a", 2.0, MethodOutcome.NOTHING), outside).verdict.ok
    assert not made(row("a", 2.0)).verdict.ok  # no design, no win


def test_logarithms_are_compared_by_their_difference() -> None:
    c = made(row("a", -1.0), row(DESIGN, -3.0), nats=2.0)
    assert c.verdict.ok
    assert c.gain(c.rows[1], c.rows[0]) == pytest.approx(1.0 - np.exp(-1.0))


def test_a_budget_is_finite() -> None:
    with pytest.raises(ExperimentError, match="positive"):
        mjfim.compare(PENDULUM, seconds=np.inf)


def test_only_applicable_methods_are_run() -> None:
    hard = DesignTask.resolve(PENDULUM).system
    assert chosen_methods(hard, None)[:2] == ("chirp", "multisine")
    assert chosen_methods(hard, ["steps", "design", "steps"]) == ("steps",)


@pytest.mark.slow
def test_a_request_to_stop_keeps_finished_methods_and_the_best_of_the_last() -> None:
    token = StopToken()

    def stop_in_the_second_method(event: Event) -> None:
        if isinstance(event, StudyEvent) and event.index == 1 and event.share > 0.3:
            token.request()

    c = mjfim.compare(
        PENDULUM,
        seconds=2.0,
        methods=["chirp", "steps"],
        callback=stop_in_the_second_method,
        stop=token,
    )
    assert [(r.method, r.note) for r in c.rows] == [("chirp", ""), ("steps", "interrupted")]
    assert np.isfinite(c.rows[1].cost)
    assert c.interrupted and not c.verdict.ok
    assert "not run" in c.findings[0]


@pytest.mark.parametrize(
    "rows",
    [
        (row("a", 1.0),),
        (row("a", 1e-4), row("b", 1.0, MethodOutcome.OUTSIDE), row(DESIGN, 0.5)),
        (replace(row("a", np.nan, MethodOutcome.NONE), control=None),),
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
    words = ("compare", study, "-o", out, "--seconds", 1)
    with measured_by(time.process_time):
        result = run(*words, "--methods", "chirp,steps", "--json")
        controls = {f"control_{name}.csv" for name in ("chirp", "steps", DESIGN)}
        further = {MANIFEST, "report.html", "compare.json", "compare.npz", "compare.png"}
        assert names(out) == controls | further
        again = run(*words, "--methods", "chirp", "-v")
    assert (result.exit_code, again.exit_code) == (0, 0), result.stderr + again.stderr
    told = loads(result.stdout)
    assert [m["method"] for m in told["methods"]] == ["chirp", "steps", DESIGN]
    assert told["ok"] is True
    assert told["budget"] == {"seconds": 1.0}
    assert all(len(m["std"]) == 3 and m["limits"]["margins"] for m in told["methods"])
    assert names(out) == controls - {"control_steps.csv"} | further
    assert "The design is" in " ".join(again.stdout.split())
    assert "…" not in again.stdout  # every number whole

    # A control of it is the initial control of another experiment.
    control = {"control": str(out / "control_chirp.csv"), "keyframe": "hanging"}
    stated = mjfim.Experiment.from_file(study).replace(initial=control)
    task = DesignTask.resolve(stated)
    reached = read(out / "compare.json")["methods"][0]["cost"]
    assert task.problem.point(task.initial).cost == pytest.approx(reached, rel=1e-6)


def test_a_design_that_is_beaten_is_no_success(
    study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    beaten = made(row("chirp", 0.5), row(DESIGN, 1.0))
    monkeypatch.setattr(mjfim, "compare", lambda *_, **__: beaten)
    result = run("compare", study, "-o", tmp_path, "--methods", "chirp")
    assert result.exit_code == 1
    assert "beaten by chirp" in result.stderr
    told = read(tmp_path / "compare.json")
    assert (told["ok"], told["best"], told["beating"]) == (False, "chirp", ["chirp"])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--methods", "chirp,chrip"), "did you mean 'chirp'"),
        (("--methods", " , "), "no baseline is named"),
        (("--methods", "design"), "no baseline is named"),
        (("--seconds", 0), "positive"),
    ],
)
def test_misuse(words: tuple[object, ...], said: str, study: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    misused(run("compare", study, "-o", out, *words), said)
    assert not out.exists()


@pytest.mark.slow
def test_a_chirp_that_never_ends_at_rest_found_nothing() -> None:
    """It was evaluated, and no size of it keeps all limits."""
    rig = mjfim.Experiment.from_file(MODELS / "cart_pendulum_rig.toml").replace(horizon=1.0)
    chirp = mjfim.compare(rig, methods=("chirp",), seconds=1.0, progress=False).rows[0]
    assert chirp.outcome is MethodOutcome.NOTHING and chirp.steps > 0
