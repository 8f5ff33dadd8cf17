"""Behaviour that all verbs share: help, version, reports, exit code 2 for misuse."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

import mjfim
from tests.support.cli import PROCESS, done, misused, names, run, write_experiment

# Calls in the fixture `folder`, with words of the message.
MISUSES = [
    # Files that do not exist or are of another kind.
    ("design gone.toml -o new", "gone.toml: no such file"),
    ("simulate study.toml gone.npz -o new/r.csv", "gone.npz: no such file"),
    ("simulate study.toml empty", "empty/design.npz: no such file"),
    ("simulate study.toml study.toml", "study.toml: give the folder of a design"),
    ("montecarlo study.toml gone.npz -o new", "gone.npz: no such file"),
    ("identify study.toml gone.csv -o new", "gone.csv: no such file"),
    ("identify study.toml run.csv notes.txt -o new", "notes.txt: column 't' is missing"),
    ("check study.toml gone.csv", "gone.csv: no such file"),
    ("check study.toml --design gone.npz", "gone.npz: no such file"),
    ("replay gone --save new/x.rrd", "gone: no such file or folder"),
    ("replay notes.txt --save new/x.rrd", "folder of results, an .rrd file or a design"),
    ("replay notes.txt --save new/x.txt", "ends in .rrd"),
    ("replay gone.rrd --save new/x.rrd", "gone.rrd: no such file"),
    ("replay . --save new/x.rrd", ".: no design.rrd or estimate.rrd"),
    ("report .", ".: holds no result; a report needs one of campaign.npz, "),
    ("report nowhere", "nowhere: no such folder"),
    ("compare-robots out gone -o new", "out/estimate.npz: this file is missing"),
    ("watch study.toml --stream gone.csv", "gone.csv: no such file"),
    ("payload study.toml run.csv -o new --body bob --from gone", "gone: no such file"),
    ("payload study.toml run.csv -o new --body bob --without gone.csv", "gone.csv: no such"),
    # A model and an experiment in the place of the other.
    ("validate cart_pendulum.xml", "`mjfim init cart_pendulum.xml` writes a first one"),
    ("check cart_pendulum.xml", "`mjfim init cart_pendulum.xml` writes a first one"),
    ("design cart_pendulum.xml -o new", "`mjfim init cart_pendulum.xml` writes a first one"),
    ("init study.toml -o new", "study.toml: an experiment file, but a model"),
    ("list study.toml", "study.toml: an experiment file, but a model"),
    # Places where nothing can be written, and files that are not replaced.
    ("design study.toml -o notes.txt", "notes.txt: is a file; -o needs a folder"),
    ("identify study.toml run.csv -o notes.txt/x", "notes.txt: is a file; -o needs a folder"),
    ("montecarlo study.toml out -o notes.txt", "notes.txt: is a file; -o needs a folder"),
    ("simulate study.toml out -o notes.txt/r.csv", "notes.txt: is a file; -o needs a folder"),
    ("simulate study.toml out -o empty", "empty: is a folder; -o and --save need a file"),
    ("replay out --save empty", "empty"),
    ("simulate study.toml out -o study.toml --force", "study.toml: this result would replace"),
    ("simulate study.toml out -o study.toml", "study.toml: this result would replace"),
    ("simulate study.toml out -o out/design.npz --force", "design.npz: this result would"),
    ("simulate study.toml out -o cart_pendulum.xml --force", "which is an input of the same run"),
    ("simulate study.toml out -o cart_pendulum.csv --force", "which is an input of the same run"),
    ("init cart_pendulum.xml -o cart_pendulum.xml --force", "which is an input of the same run"),
    ("init cart_pendulum.xml -o notes.txt", "notes.txt: not listed in .mjfim.json"),
    ("simulate study.toml out -o r.csv --video film.gif", "film.gif: not listed in"),
    ("simulate study.toml out -o r.csv --video film.avi", "film.avi: the name of a video ends in"),
    # Values of options.
    ("design study.toml -o new --executor local:0", "not a number of processes"),
    ("design study.toml -o new --executor dask:no.json", "no such file"),
    ("design study.toml -o new --executor cluster", "state local, local:N"),
    ("check study.toml --executor cluster", "state local, local:N"),
    ("compare study.toml -o new --executor cluster", "state local, local:N"),
    ("campaign study.toml -o new --executor cluster", "state local, local:N"),
    ("montecarlo study.toml out -o new --executor cluster", "state local, local:N"),
    ("identify study.toml run.csv -o new --executor cluster", "state local, local:N"),
    ("payload study.toml run.csv -o new", "body: name the body"),
    ("payload study.toml run.csv -o new --body bib", "body: unknown body 'bib'"),
    ("payload study.toml run.csv -o new --body world", "body: 'world' does not move"),
    ("payload study.toml run.csv -o new --body bob --size -1", "size: -1"),
    ("worth study.toml --add gyro:bob", "SENSOR=SIGMA"),
    ("export out -o new --to ros", "--to: unknown target 'ros' (did you mean 'ros2'?)"),
    ("export out -o new --to ros2-bag --storage zip", "--storage: unknown format 'zip'"),
    ("export out -o new --to ros2 --positions speed", "--positions: unknown kind 'speed'"),
    ("export out -o new --to ros2 --positions command", "not every driven joint has one"),
    ("export out -o new --to ros2 --experiment none.toml", "none.toml: no such file"),
    ("export out -o new --to lerobot --unit turn", "--unit: unknown unit 'turn'"),
    ("export out -o notes.txt --to ros2", "notes.txt: not listed in .mjfim.json"),
    ("export out -o out/design.npz --to ros2 --force", "is an input"),
    ("list cart_pendulum.xml xyzzy", "no path or name contains 'xyzzy'"),
    ("init cart_pendulum.xml -o a.toml --parameters frictions", "unknown group 'frictions'"),
    ("init cart_pendulum.xml -o a.toml --payload hand", "payload: unknown body 'hand'"),
    ("validate", "validate needs an experiment file, or --schema"),
]


@pytest.mark.parametrize(("words", "said"), MISUSES)
def test_misuse_is_one_message_and_changes_no_file(words: str, said: str, folder: Path) -> None:
    def contents() -> dict[Path, bytes]:
        return {path: path.read_bytes() for path in folder.rglob("*.*") if path.is_file()}

    before = contents()
    misused(run(words), said)
    assert contents() == before
    assert not (folder / "new").exists()


# Lines of the study that are replaced, with words of the message.
DESIGN = "design study.toml -o a/b"
WRONG_STUDIES: list[tuple[str, dict[str, str], str]] = [
    (DESIGN, {"horizon": "1.0\nhorizn = 2"}, "study.toml: horizn: unknown key"),
    (DESIGN, {"rate": ""}, "not valid TOML"),
    (DESIGN, {"start": '"gone.csv"'}, "gone.csv: no such file"),
    (DESIGN, {"start": '{ kind = "sine", amplitude = 1e12 }'}, "diverges under this control"),
    (
        "check study.toml",
        {"horizon": "1.005", "start": '{ kind = "sine" }'},
        "study.toml: horizon: 1.005 s is not",
    ),
    (DESIGN, {"tracking": "{ slid = 1 }"}, "cost.tracking"),
    (
        DESIGN,
        {"max_iterations": '1\n[parameters.paint]\ntarget = "geom/cart:size[0]"'},
        "parameters.paint changes nothing in the measured outputs",
    ),
]


@pytest.mark.parametrize(("words", "lines", "said"), WRONG_STUDIES)
def test_a_wrong_experiment_is_one_message(
    words: str,
    lines: dict[str, str],
    said: str,
    here: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """It is one of mjfim, none of MuJoCo, and there is no log file."""
    write_experiment(here, **lines)
    misused(run(words), said)
    assert capfd.readouterr() == ("", "")
    assert names(here) == {"study.toml", "cart_pendulum.xml", "cart_pendulum.csv"}


@pytest.mark.parametrize(
    ("files", "proposed"),
    [
        (("arm.xml",), "mjfim init arm.xml -o arm.toml"),
        (("my arm.urdf", "pyproject.toml"), "mjfim init 'my arm.urdf' -o 'my arm.toml'"),
        (("arm.xml", "arm.toml"), "mjfim check arm.toml"),
        (("arm.xml", "leg.xml"), ""),
        ((), ""),
    ],
)
def test_without_a_verb_the_first_command_is_proposed(
    files: tuple[str, ...], proposed: str, here: Path
) -> None:
    """Where the folder holds one experiment, or else one model."""
    for name in files:
        (here / name).touch()
    result = run()
    assert result.exit_code == 2 and "Usage: " in result.stdout
    assert " ".join(result.stderr.split()) == (
        f"mjfim: in this folder: {proposed}" if proposed else ""
    )


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("design study.toml", "--help"),
        ("design study.toml -o x --starts 0", "--help"),
        ("simulate study.toml design.npz -o x --seed -1", "--help"),
        ("montecarlo study.toml design.npz -o x --trials 1", "--help"),
        ("identify study.toml -o x", "--help"),
        ("dessign study.toml -o x", "--help"),
        ("check study.toml --threads 1000000", "less than or equal to"),
        ("design study.toml -o x --starts 1000000000", "less than or equal to"),
        ("rehearse made -o x --robots 1000000000", "less than or equal to"),
    ],
)
def test_wrong_options(words: str, said: str, here: Path) -> None:
    """Exit code 2 and a message that names --help, or the bound of an amount."""
    result = done(words, code=2)
    assert said in " ".join(result.stderr.replace("│", " ").split())
    assert "Traceback" not in result.stderr
    assert names(here) == set()


def test_design_of_another_model(folder: Path) -> None:
    """The verbs simulate and montecarlo refuse a design of another model."""
    model = folder / "cart_pendulum.xml"
    xml = model.read_text(encoding="utf-8")
    more = '<body name="rider"><joint name="ride"/><geom size=".1" mass="1"/></body></worldbody>'
    key = 'qpos="0 3.141592653589793 0"'
    xml = xml.replace("</worldbody>", more).replace('qpos="0 3.141592653589793"', key)
    model.write_text(xml, encoding="utf-8")
    for words in ("simulate study.toml out -o new/r.csv", "montecarlo study.toml out -o new"):
        said = ("design.npz: made for (nq, nv, na, nu) = (2, 2, 0, 1)", "(3, 3, 0, 1)")
        misused(run(words), *said)
        assert not (folder / "new").exists()


def test_misuse_as_a_process(tmp_path: Path) -> None:
    """A process ends with one message and exit code 2; warnings are errors there."""
    path = write_experiment(tmp_path, rate="33.0")
    words = [*PROCESS, "design", path, "-o", tmp_path / "out"]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"mjfim: {path}: rate: at 33 Hz, a sample is not")
    assert len(done.stderr.splitlines()) == 1
    assert "out" not in names(tmp_path)


def test_version() -> None:
    """The version is that of the package."""
    result = run("--version")
    assert (result.exit_code, result.stdout) == (0, f"{mjfim.__version__}\n")
