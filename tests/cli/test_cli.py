"""The command line: the whole chain, its files and exit codes, misuse, interruption, divergence."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from typer.testing import Result

import mjfim
from mjfim.excitation.design import design_task
from mjfim.excitation.evaluation import evaluate_task
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system import System
from mjfim.output import archive, plots
from mjfim.output import folders as results
from mjfim.output import rerun as rerun_log
from mjfim.recordings import read as logs
from mjfim.records.design import Status
from mjfim.records.events import DesignEvent
from tests.support.cli import (
    DESIGN,
    ESTIMATE,
    STUDY,
    loads,
    misused,
    names,
    read,
    run,
    write_experiment,
)
from tests.support.paths import MODELS


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the shortened study."""
    folder = tmp_path_factory.mktemp("cli")
    write_experiment(folder)
    return folder


@pytest.fixture(scope="module")
def study(home: Path) -> Path:
    """Its experiment file."""
    return home / "study.toml"


@pytest.fixture(scope="module")
def designed(home: Path, study: Path) -> Result:
    """`mjfim design --json` into home/out."""
    return run("design", study, "-o", home / "out", "--json")


@pytest.fixture(scope="module")
def archived(home: Path, designed: Result) -> Path:
    """The design.npz."""
    assert designed.exit_code == 0
    return home / "out" / "design.npz"


@pytest.fixture(scope="module")
def recorded(home: Path, study: Path, archived: Path) -> Path:
    """`mjfim simulate` into home/run.csv."""
    assert run("simulate", study, archived, "-o", home / "run.csv", "--seed", 1).exit_code == 0
    return home / "run.csv"


@pytest.fixture(scope="module")
def identified(home: Path, study: Path, recorded: Path) -> Result:
    """`mjfim identify --json` into home/fit."""
    return run("identify", study, recorded, "-o", home / "fit", "--json")


# ---- the chain


def test_design_leaves_its_files(home: Path, designed: Result) -> None:
    """All promised ones, nothing else."""
    assert designed.exit_code == 0
    assert names(home / "out") == DESIGN
    assert all(path.stat().st_size > 0 for path in (home / "out").iterdir())
    data = read(home / "out" / "design.json")
    assert (data["status"], data["limits"]["satisfied"]) == ("converged", True)
    assert data["final"]["eigenvalues"][0] > 10 * data["initial"]["eigenvalues"][0]


def test_design_json_is_the_file(home: Path, designed: Result) -> None:
    """stdout holds the summary and nothing else; only the way back to the experiment is the file's
    own.
    """
    data = read(home / "out" / "design.json")
    assert (home / "out" / data.pop("experiment")).resolve() == home / "study.toml"
    assert loads(designed.stdout) == data
    assert "wrote" in designed.stderr


def test_simulate_leaves_a_recording(study: Path, recorded: Path, archived: Path) -> None:
    """The design's control, noise of the stated size about the true model's outputs."""
    task = DesignTask.resolve(mjfim.Experiment.from_file(study))
    recording = logs.read_recording(recorded, task.system.channels)
    curve = archive.read_design(archived)["final"]
    assert np.array_equal(recording.ctrl, curve.ctrl)
    noise = recording.y - np.hstack([curve.qpos, curve.qvel])
    assert noise.std() == pytest.approx(0.05, rel=0.15)


def test_simulate_keeps_its_seed(home: Path, study: Path, recorded: Path, archived: Path) -> None:
    """Same seed, same file; another seed, another."""
    for seed, same in ((1, True), (2, False)):
        assert (
            run("simulate", study, archived, "-o", home / "again.csv", "--seed", seed).exit_code
            == 0
        )
        assert ((home / "again.csv").read_bytes() == recorded.read_bytes()) is same


def test_identify_leaves_its_files(home: Path, identified: Result) -> None:
    """All promised ones; the estimate lies near the truth, by its own account."""
    assert identified.exit_code == 0
    assert names(home / "fit") == ESTIMATE
    data = read(home / "fit" / "estimate.json")
    assert loads(identified.stdout) == data
    assert np.all(np.abs(np.subtract(data["theta"], [2.0, 1.0, 1.0])) < 4 * np.array(data["std"]))
    model = mujoco.MjModel.from_xml_path(str(home / "fit" / "identified.xml"))
    assert model.body("bob").mass[0] == pytest.approx(data["theta"][0], rel=1e-5)


def test_identify_several_recordings(
    home: Path, study: Path, recorded: Path, identified: Result, tmp_path: Path
) -> None:
    """Two recordings tell more than one, and each gets its picture; newton arrives at the same
    place.
    """
    assert (
        run(
            "simulate", study, home / "out" / "design.npz", "-o", tmp_path / "b.csv", "--seed", 5
        ).exit_code
        == 0
    )
    result = run(
        "identify",
        study,
        recorded,
        tmp_path / "b.csv",
        "-o",
        tmp_path / "fit",
        "--method",
        "newton",
    )
    assert result.exit_code == 0
    assert names(tmp_path / "fit") == (ESTIMATE - {"fit.png"}) | {"fit_1.png", "fit_2.png"}
    both, one = read(tmp_path / "fit" / "estimate.json"), loads(identified.stdout)
    assert np.all(np.array(both["std"]) < 0.85 * np.array(one["std"]))
    assert both["recordings"] == [str(recorded), str(tmp_path / "b.csv")]


def test_montecarlo_leaves_its_files(home: Path, study: Path, archived: Path) -> None:
    """For the start and the design, at a lower measurement rate."""
    words = (
        "montecarlo",
        study,
        archived,
        "-o",
        home / "mc",
        "--trials",
        20,
        "--seed",
        3,
        "--measure-rate",
        25,
    )
    result = run(*words, "--json")
    assert result.exit_code == 0
    assert names(home / "mc") == STUDY
    data = read(home / "mc" / "montecarlo.json")
    assert loads(result.stdout) == data
    assert data["measure_rate"] == pytest.approx(25.0)
    assert [(data[name]["trials"], data[name]["failed"]) for name in ("initial", "final")] == [
        (20, 0)
    ] * 2
    assert np.all(np.diag(data["final"]["crlb"]) < np.diag(data["initial"]["crlb"]))


def test_replay_saves(home: Path, archived: Path, identified: Result, tmp_path: Path) -> None:
    """From a folder, a recording, an archive; into folders that do not exist yet."""
    for source in (home / "out", home / "out" / "design.rrd", archived, home / "fit"):
        target = tmp_path / "new" / f"{source.name}.rrd"
        result = run("replay", source, "--save", target)
        assert (result.exit_code, target.is_file()) == (0, True), result.stderr
        assert target.read_bytes()[:4] == b"RRF2"
    assert (tmp_path / "new" / "out.rrd").read_bytes() == (home / "out" / "design.rrd").read_bytes()


def test_replay_of_a_lonely_archive(study: Path, archived: Path, tmp_path: Path) -> None:
    """Without its design.json it needs to be told the experiment."""
    shutil.copy(archived, tmp_path)
    target = tmp_path / "x.rrd"
    result = run("replay", tmp_path / "design.npz", "--save", target)
    assert (result.exit_code, target.exists()) == (2, False)
    assert "name the experiment with --experiment" in result.stderr
    assert (
        run("replay", tmp_path / "design.npz", "--save", target, "--experiment", study).exit_code
        == 0
    )
    assert target.is_file()


@pytest.mark.slow
def test_second_run_into_the_same_folder(home: Path, study: Path, archived: Path) -> None:
    """Replaces the first; other files there are left alone."""
    (home / "out" / "notes.txt").write_text("mine", encoding="utf-8")
    first = read(home / "out" / "design.json")
    try:
        result = run("design", study, "-o", home / "out", "--threads", 1)
        assert result.exit_code == 0
        assert names(home / "out") == DESIGN | {"notes.txt"}
    finally:
        (home / "out" / "notes.txt").unlink()
    second = read(home / "out" / "design.json")
    assert second["seconds"] != first["seconds"]
    assert second["final"]["cost"] == pytest.approx(first["final"]["cost"], rel=1e-6)


def test_reports_name_the_parameters(
    study: Path, recorded: Path, archived: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without --json stdout is for people: every number in full, whatever the terminal."""
    for name in ("write_design_folder", "write_estimate_folder", "write_study_folder"):
        monkeypatch.setattr(results, name, lambda *_: [])
    for words in (
        ("design", study),
        ("identify", study, recorded),
        ("montecarlo", study, archived, "--trials", 4),
    ):
        result = run(*words, "-o", tmp_path / "nothing")
        assert result.exit_code == 0
        assert "N m s/rad" in result.stdout
        assert "parameter" in result.stdout
        assert not re.search(r"\d[.e-]*…", result.stdout), result.stdout  # a number cut off


# ---- exit code 1: ran, but did not reach its goal


@pytest.fixture
def no_files(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where files are not the question, drawing them would only take time."""
    for name in ("write_design_folder", "write_estimate_folder", "write_study_folder"):
        monkeypatch.setattr(results, name, lambda *_: [])


@pytest.mark.usefixtures("no_files")
@pytest.mark.parametrize(
    ("lines", "status", "satisfied"),
    [
        ({"max_iterations": "1"}, "max_iterations", True),
        (
            {"max_iterations": "40\n[limits]\nvelocity = { slide = 1e-3 }\nenforce = false"},
            "converged",
            False,
        ),
    ],
    ids=["not-converged", "limits-violated"],
)
def test_design_that_misses_its_goal(
    tmp_path: Path, lines: dict[str, str], status: str, satisfied: bool
) -> None:
    """Exit code 1 and a summary that says why."""
    result = run("design", write_experiment(tmp_path, **lines), "-o", tmp_path / "out", "--json")
    data = loads(result.stdout)
    assert (result.exit_code, data["status"], data["limits"]["satisfied"]) == (1, status, satisfied)
    assert bool(data["warnings"]) is not satisfied


def test_misfit(study: Path, recorded: Path, tmp_path: Path) -> None:
    """A recording that the model cannot explain: results are written, the exit code and the text
    say so.
    """
    header, *rows = recorded.read_text(encoding="utf-8").splitlines()
    cells = [row.split(",") for row in rows]
    bent = [[t, u, str(float(s) + 0.5 * float(t)), *rest] for t, u, s, *rest in cells]
    odd = tmp_path / "odd.csv"
    odd.write_text("\n".join([header, *(",".join(row) for row in bent)]) + "\n", encoding="utf-8")
    result = run("identify", study, odd, "-o", tmp_path / "fit")
    assert result.exit_code == 1
    assert read(tmp_path / "fit" / "estimate.json")["misfit"] is True
    assert "misfit: residuals are" in " ".join(result.stdout.split())


# ---- exit code 2: misuse


BAD_LINES: dict[str, tuple[dict[str, str], list[str]]] = {
    "unknown key": (
        {"horizon": "1.0\nhorizn = 2"},
        ["study.toml", "horizn", "unknown key", "horizon"],
    ),
    "bad value": ({"rate": "-1"}, ["study.toml", "rate", "greater than 0"]),
    "bad rate": ({"rate": "33.0"}, ["study.toml", "rate: 33 Hz", "valid"]),
    "bad syntax": ({"rate": ""}, ["study.toml", "not valid TOML"]),
    "no model": ({"model": '"gone.xml"'}, ["gone.xml", "no such model file"]),
    "no table": ({"start": '"gone.csv"'}, ["gone.csv", "no such file"]),
    "bad joint": ({"tracking": "{ slid = 1 }"}, ["study.toml", "cost.tracking", "hinge, slide"]),
}


@pytest.mark.parametrize("name", BAD_LINES)
def test_bad_experiment(name: str, tmp_path: Path) -> None:
    """Nothing is written."""
    lines, fragments = BAD_LINES[name]
    write_experiment(tmp_path, **lines)
    misused(run("design", tmp_path / "study.toml", "-o", tmp_path / "a" / "b"), *fragments)
    assert names(tmp_path) == {"study.toml", "cart_pendulum.xml", "cart_pendulum.csv"}


def test_missing_inputs(study: Path, archived: Path, tmp_path: Path) -> None:
    """No experiment, no design, no recording, nothing to replay."""
    out = tmp_path / "out"
    misused(
        run("design", tmp_path / "gone.toml", "-o", out),
        "gone.toml",
        "cannot read the experiment file",
    )
    misused(
        run("simulate", study, tmp_path / "gone.npz", "-o", out / "r.csv"),
        "gone.npz: no such design file",
    )
    misused(
        run("montecarlo", study, tmp_path / "gone.npz", "-o", out), "gone.npz: no such design file"
    )
    misused(run("identify", study, tmp_path / "gone.csv", "-o", out), "gone.csv: no such file")
    misused(run("replay", tmp_path / "gone", "--save", out / "x.rrd"), "no such file or folder")
    (tmp_path / "notes.txt").touch()
    misused(
        run("replay", tmp_path / "notes.txt", "--save", out / "x.rrd"),
        "folder of results, an .rrd file or a design",
    )
    misused(run("replay", tmp_path / "notes.txt", "--save", out / "x.txt"), "ends in .rrd")
    (tmp_path / "notes.txt").unlink()
    misused(run("replay", tmp_path / "gone.rrd", "--save", out / "x.rrd"), "gone.rrd: no such file")
    misused(run("replay", tmp_path, "--save", out / "x.rrd"), "no design.rrd or estimate.rrd")
    misused(
        run("identify", study, archived, "-o", out, "--method", "magic"),
        "'magic'",
        "least_squares, newton",
    )
    assert names(tmp_path) == set()


@pytest.mark.parametrize(
    "words",
    [
        ("design", "study.toml"),
        ("design", "study.toml", "-o", "x", "--starts", "0"),
        ("simulate", "study.toml", "design.npz", "-o", "x", "--seed", "-1"),
        ("montecarlo", "study.toml", "design.npz", "-o", "x", "--trials", "1"),
        ("identify", "study.toml", "-o", "x"),
        ("dessign", "study.toml", "-o", "x"),
    ],
)
def test_wrong_options(
    words: tuple[str, ...], home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Exit code 2 with a hint at --help."""
    monkeypatch.chdir(tmp_path)
    result = run(*words)
    assert result.exit_code == 2
    assert "--help" in result.stderr
    assert "Traceback" not in result.stderr
    assert names(tmp_path) == set()


def test_output_is_a_file(study: Path, archived: Path, recorded: Path, tmp_path: Path) -> None:
    """Said before the work, and the file stays."""
    taken = tmp_path / "taken"
    taken.write_text("mine", encoding="utf-8")
    for place in (taken, taken / "below"):
        misused(run("design", study, "-o", place), "taken: is a file; -o needs a folder")
        misused(
            run("identify", study, recorded, "-o", place), "taken: is a file; -o needs a folder"
        )
        misused(
            run("montecarlo", study, archived, "-o", place, "--trials", 2),
            "taken: is a file; -o needs a folder",
        )
    assert taken.read_text(encoding="utf-8") == "mine"


def test_unwritable_folder(study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Said before the work; root may write everywhere, so the answer of the system is made up."""
    asked = []

    def deny(path: Path, mode: int) -> bool:
        if mode == os.W_OK:
            asked.append(Path(path))
        return mode != os.W_OK

    monkeypatch.setattr(os, "access", deny)
    misused(
        run("design", study, "-o", tmp_path / "new" / "out"),
        f"{tmp_path}: no permission to write here",
    )
    assert asked == [tmp_path]
    assert names(tmp_path) == set()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_really_unwritable_folder(study: Path, tmp_path: Path) -> None:
    """The same, with a folder that the system protects."""
    tmp_path.chmod(0o500)
    try:
        misused(
            run("design", study, "-o", tmp_path / "out"), f"{tmp_path}: no permission to write here"
        )
    finally:
        tmp_path.chmod(0o700)


@pytest.mark.parametrize("place", ["folder", "file/below.csv"])
def test_recording_cannot_be_written(
    place: str, study: Path, archived: Path, tmp_path: Path
) -> None:
    """A folder, a path below a file."""
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    misused(run("simulate", study, archived, "-o", tmp_path / place), "-o")
    assert names(tmp_path) == {"folder", "file"}


def test_replay_into_a_folder(home: Path, designed: Result, tmp_path: Path) -> None:
    """--save needs a file."""
    misused(run("replay", home / "out", "--save", tmp_path), str(tmp_path))


def test_disk_full(study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the system says, in one message."""

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device", str(tmp_path / "out" / "design.npz"))

    monkeypatch.setattr(np, "savez_compressed", full)
    result = run("design", study, "-o", tmp_path / "out")
    assert isinstance(result.exception, SystemExit), repr(result.exception)
    assert result.exit_code in (1, 2)
    assert re.search(r"^mjfim: .*design\.npz.*No space left on device", result.stderr, re.MULTILINE)


def test_design_of_another_model(archived: Path, tmp_path: Path) -> None:
    """simulate, montecarlo and replay refuse it."""
    path = write_experiment(tmp_path)
    xml = (tmp_path / "cart_pendulum.xml").read_text(encoding="utf-8")
    more = '<body name="rider"><joint name="ride"/><geom size=".1" mass="1"/></body></worldbody>'
    key = 'qpos="0 3.141592653589793 0"'
    xml = xml.replace("</worldbody>", more).replace('qpos="0 3.141592653589793"', key)
    (tmp_path / "cart_pendulum.xml").write_text(xml, encoding="utf-8")
    said = ("design.npz: made for (nq, nv, nu) = (2, 2, 1)", "(3, 3, 1)")
    misused(run("simulate", path, archived, "-o", tmp_path / "out" / "r.csv"), *said)
    misused(run("montecarlo", path, archived, "-o", tmp_path / "out"), *said)
    misused(
        run("replay", archived, "--experiment", path, "--save", tmp_path / "out" / "x.rrd"), *said
    )
    assert "out" not in names(tmp_path)


def test_bad_recordings(study: Path, recorded: Path, tmp_path: Path) -> None:
    """Named with file and column; the good one beside it does not help."""
    header, *rows = recorded.read_text(encoding="utf-8").splitlines()
    cases = {
        "no-control.csv": (
            [header.replace("ctrl:force", "force"), *rows],
            "'ctrl:force' is missing",
        ),
        "short.csv": ([header, *rows[:2]], "too few rows (2)"),
        "gap.csv": ([header, *rows[:20], *rows[30:]], "a gap of 0.11 s after data row 20"),
        "text.csv": (
            [header, *rows[:5], "0.05,0,0,high,0,0", *rows[6:]],
            "'qpos:hinge' is not numeric",
        ),
        "hole.csv": (
            [header, "0,,0,0,0,0", *rows[1:]],
            "'ctrl:force') has no value in the first row",
        ),
        "unmeasured.csv": (
            [header.replace("qpos", "q").replace("qvel", "v"), *rows],
            "no measured column",
        ),
    }
    for name, (lines, said) in cases.items():
        (tmp_path / name).write_text("\n".join(lines) + "\n", encoding="utf-8")
        misused(
            run("identify", study, recorded, tmp_path / name, "-o", tmp_path / "out"), name, said
        )
    assert names(tmp_path) == set(cases)


# ---- starts that cannot work


def test_start_that_excites_nothing(tmp_path: Path) -> None:
    """Upright at rest without control: no parameter acts."""
    nothing = '{ kind = "constant", amplitude = 0.0 }'
    path = write_experiment(tmp_path, start=nothing, keyframe='"upright"')
    xml = (tmp_path / "cart_pendulum.xml").read_text(encoding="utf-8")
    xml = xml.replace("<keyframe>", '<keyframe><key name="upright" qpos="0 0"/>')
    (tmp_path / "cart_pendulum.xml").write_text(xml, encoding="utf-8")
    misused(run("design", path, "-o", tmp_path / "out"), "the initial control does not excite: ")
    assert "out" not in names(tmp_path)


def test_parameter_that_does_nothing(tmp_path: Path) -> None:
    """It is named alone."""
    path = write_experiment(tmp_path)
    more = '[parameters.paint]\ntarget = "geom/cart:size[0]"\n'
    path.write_text(path.read_text(encoding="utf-8") + more, encoding="utf-8")
    misused(
        run("design", path, "-o", tmp_path / "out"),
        "parameters.paint changes nothing in the measured outputs",
    )


def test_start_that_excites_next_to_nothing(tmp_path: Path) -> None:
    """Hanging at rest without control: what rounding moves is not information."""
    path = write_experiment(
        tmp_path, start='{ kind = "constant", amplitude = 0.0 }', max_iterations="1"
    )
    misused(
        run("design", path, "-o", tmp_path / "out"),
        "the initial control does not excite: ",
        "m, l and c",
        "Other controls do",
    )


def test_start_that_diverges(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One message of ours, none of MuJoCo's, and no log file."""
    monkeypatch.chdir(tmp_path)
    path = write_experiment(tmp_path, start='{ kind = "sine", amplitude = 1e12 }')
    misused(run("design", path, "-o", tmp_path / "out"), "diverges under this control")
    assert capfd.readouterr() == ("", "")
    assert names(tmp_path) == {"study.toml", "cart_pendulum.xml", "cart_pendulum.csv"}


def test_trials_that_diverge(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A step into divergence is a step too long: the descent goes on, silently."""
    monkeypatch.chdir(tmp_path)
    diverged = []
    experiment = mjfim.Experiment.from_file(
        write_experiment(tmp_path, horizon="0.5", tolerance="1e-7")
    )
    for amplitude in np.geomspace(1.2e4, 4.8e4, 7):
        wave = {"kind": "sine", "frequency": 2.0, "amplitude": float(amplitude)}
        descent = {"max_iterations": 4, "coarse": 1}
        task = DesignTask.resolve(experiment.replace(initial={"control": wave}, descent=descent))
        project = task.plant.project

        def spy(*words: Any, project: Any = project) -> Any:
            trial = project(*words)
            diverged.append(trial is None)
            return trial

        monkeypatch.setattr(task.plant, "project", spy)
        result = design_task(task)
        assert result.final.cost < result.initial.cost
    assert any(diverged), "no trial diverged: this test has lost its object"
    assert capfd.readouterr() == ("", "")
    assert "MUJOCO_LOG.TXT" not in names(tmp_path)


def test_montecarlo_of_a_diverging_design(study: Path, archived: Path, tmp_path: Path) -> None:
    """A control that the true model does not survive."""
    with np.load(archived) as data:
        arrays = {key: data[key] for key in data.files}
    np.savez(tmp_path / "wild.npz", **{**arrays, "ctrl": np.full_like(arrays["ctrl"], 1e15)})
    for verb, place, *more in (("simulate", "r.csv"), ("montecarlo", "mc", "--trials", 2)):
        words = (verb, study, tmp_path / "wild.npz", "-o", tmp_path / place, *more)
        misused(run(*words), "diverges at the true parameters")
    assert names(tmp_path) == {"wild.npz"}


# ---- interruption


def interrupt(*_: object, **__: object) -> None:
    """What Ctrl-C does."""
    os.kill(os.getpid(), signal.SIGINT)
    for _ in range(1000):  # the handler runs between two instructions
        pass


@pytest.mark.parametrize("verb", ["design", "identify", "montecarlo"])
def test_interrupted_before_a_result(
    verb: str,
    study: Path,
    archived: Path,
    recorded: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Exit code 1, one message, nothing on disk."""
    monkeypatch.setattr(System, "resolve", interrupt)
    inputs = {"design": [], "identify": [recorded], "montecarlo": [archived]}[verb]
    result = run(verb, study, *inputs, "-o", tmp_path / "out")
    assert (result.exit_code, result.stdout) == (1, "")
    assert result.stderr == "mjfim: interrupted before there was a result; nothing was written\n"
    assert names(tmp_path) == set()


def test_interrupted_while_writing(
    study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The message must not deny files that are there."""
    monkeypatch.setattr(plots, "save", interrupt)
    result = run("design", study, "-o", tmp_path / "out")
    assert "design.npz" in names(tmp_path / "out")
    assert "nothing was written" not in result.stderr


def test_interrupted_on_the_coarse_level() -> None:
    """The best so far is better than the start, also before the stated sample rate is reached."""
    rates = []

    def interrupt_fifth(event: DesignEvent) -> None:
        rates.append(event.row.rate)
        if event.row.iteration == 5:
            interrupt()

    experiment = mjfim.Experiment.from_file(MODELS / "cart_pendulum.toml")
    result = mjfim.design(experiment, callback=interrupt_fifth)
    assert set(rates) == {25.0}
    assert result.status is Status.INTERRUPTED
    assert result.final.cost < 0.1 * result.initial.cost


# ---- as a process

MJFIM = [sys.executable, "-W", "error", "-m", "mjfim"]


def test_help() -> None:
    """Names what each verb does, writes nothing to stderr."""
    done = subprocess.run(
        [*MJFIM, "--help"], capture_output=True, text=True, check=False, timeout=60
    )
    assert (done.returncode, done.stderr) == (0, "")
    for verb in ("design", "simulate", "identify", "montecarlo", "replay"):
        assert re.search(rf"^\W*{verb}\s+[A-Z]", done.stdout, re.MULTILINE), verb


def test_misuse_as_a_process(tmp_path: Path) -> None:
    """The same message and exit code outside of the test runner; warnings would be errors."""
    path = write_experiment(tmp_path, rate="33.0")
    words = [*MJFIM, "design", path, "-o", tmp_path / "out"]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"mjfim: {path}: rate: 33 Hz is not")
    assert len(done.stderr.splitlines()) == 1
    assert "out" not in names(tmp_path)


def test_interrupted_design_leaves_the_best_so_far(tmp_path: Path) -> None:
    """SIGINT in the middle: exit code 1, all files, readable, better than the start."""
    path = write_experiment(tmp_path, tolerance="1e-12", max_iterations="200\nstarts = 10000")
    words = [*MJFIM, "design", path, "-o", tmp_path / "out", "--threads", "1"]
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        told = iter(process.stderr.readline, "")
        try:
            assert any(line.startswith("iteration  20 ") for line in told)
            process.send_signal(signal.SIGINT)
            _, rest = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 1
    assert "Traceback" not in rest
    assert "wrote" in rest
    out = tmp_path / "out"
    assert names(out) == DESIGN
    data = read(out / "design.json")
    assert data["status"] == "interrupted"
    assert data["final"]["eigenvalues"][0] > 5 * data["initial"]["eigenvalues"][0]
    task = DesignTask.resolve(mjfim.Experiment.from_file(path))
    curves = archive.read_design(out / "design.npz")
    assert evaluate_task(task, curves["final"]).cost == pytest.approx(
        data["final"]["cost"], rel=1e-6
    )
    assert all(file.read_bytes()[:4] == b"\x89PNG" for file in out.glob("*.png"))
    assert (out / "design.rrd").read_bytes()[:4] == b"RRF2"


def test_replay_of_an_archive_leaves_the_full_picture_alone(
    home: Path, designed: Result, monkeypatch
) -> None:
    """design.rrd holds more than the archive beside it."""
    shown: list[Path] = []
    monkeypatch.setattr(rerun_log, "show", shown.append)
    before = (home / "out" / "design.rrd").read_bytes()
    assert run("replay", home / "out" / "design.npz").exit_code == 0
    assert (home / "out" / "design.rrd").read_bytes() == before
    assert shown[0].is_file()
    assert shown[0].parent != home / "out"


def test_version() -> None:
    """As the package says."""
    result = run("--version")
    assert (result.exit_code, result.stdout) == (0, f"{mjfim.__version__}\n")


@pytest.mark.slow
def test_stale_pictures_of_an_older_estimate_are_removed(
    study: Path, recorded: Path, tmp_path: Path
) -> None:
    """Two recordings, then one, into the same folder."""
    run("identify", study, recorded, recorded, "-o", tmp_path / "e")
    (tmp_path / "e" / "fitness.png").touch()  # the user's own
    assert {"fit_1.png", "fit_2.png"} <= names(tmp_path / "e")
    run("identify", study, recorded, "-o", tmp_path / "e")
    assert {n for n in names(tmp_path / "e") if n.startswith("fit")} == {"fit.png", "fitness.png"}
