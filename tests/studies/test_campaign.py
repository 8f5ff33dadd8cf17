"""Campaigns: they reach the targets and the truth, gain by redesigns, name suspicious results, and
can be continued.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import chi2
from typer.testing import Result

import mjfim
from mjfim.arrays import Array
from mjfim.cli.campaign import with_target_accuracies
from mjfim.errors import ExperimentError, SimulationDivergedError, UnidentifiableError
from mjfim.excitation.evaluation import evaluate_task
from mjfim.excitation.task import DesignTask
from mjfim.files import write_json
from mjfim.output.campaign_folder import (
    SETTINGS_FILE,
    campaign_settings,
    require_same_settings,
)
from mjfim.output.manifest import MANIFEST
from mjfim.parallel.budget import StopToken
from mjfim.records.design import Design, Status
from mjfim.records.studies import Campaign, CampaignStatus, RecordedRound
from mjfim.records.trajectory import Recording
from mjfim.studies import campaign as campaign_module
from mjfim.studies.campaign import restate_experiment
from tests.support.cart_pendulum import cart_pendulum
from tests.support.cli import (
    PROCESS,
    misused,
    names,
    read,
    run,
    write_empty_figures,
    write_wrong_guess,
)
from tests.support.made_records import bare_estimate
from tests.support.numerics import cart_task
from tests.support.paths import MODELS

# Whole jobs: these tests run in `.ci/run` only.
pytestmark = pytest.mark.slow

# Its guesses are 25 to 40 % off.
STUDY = mjfim.Experiment.from_file(MODELS / "cart_pendulum_guess.toml").replace(
    horizon=1.0,
    initial={"control": {"kind": "sine", "amplitude": 2.0, "frequency": 0.8}},
    descent={"starts": 1, "tolerance": 1e-3, "max_iterations": 30},
    parameters={name: {"wanted": 0.008} for name in "mlc"},
    rehearsal={"robots": 4},
)


def robot(design: Design, number: int) -> Recording:
    """The model at its true values."""
    return mjfim.simulate(STUDY, design.trajectory, seed=number)


# A measurement that must not be called: the robot is not asked to move.
NEVER = Mock(side_effect=AssertionError)


@pytest.fixture(scope="module")
def campaign() -> Campaign:
    """A campaign from the wrong guess to the target accuracy."""
    return mjfim.run_campaign(STUDY, robot)


@pytest.fixture(scope="module")
def truth() -> DesignTask:
    """The study at its true values."""
    return DesignTask.resolve(STUDY.replace(cost={"linearize_at": "true"}))


def test_a_campaign_ends_at_the_targets_and_at_the_true_values(
    campaign: Campaign, truth: DesignTask
) -> None:
    assert campaign.reached and campaign.status is CampaignStatus.REACHED
    assert 2 <= len(campaign.rounds) <= 5, "one round would not test a redesign"
    last = campaign.estimate
    assert (last.std <= 0.008).all()
    error = last.theta - truth.parameters.true
    assert (np.abs(error) < 3.0 * last.std).all()
    assert error @ np.linalg.solve(last.covariance, error) < chi2.ppf(0.999, 3)
    assert not campaign.warnings and not campaign.short


def test_a_redesign_gains_more_information_than_repeating_the_first_design(
    campaign: Campaign, truth: DesignTask
) -> None:
    """For about the same effort: information that is there already makes later rounds neither
    gentler nor wilder.
    """
    controls = [r.control for r in campaign.rounds]
    motions = [truth.plant.simulate(truth.theta, control) for control in controls]
    told = [evaluate_task(truth, motion).information for motion in motions]
    repeated = len(told) * np.linalg.eigvalsh(told[0])[0]
    assert np.linalg.eigvalsh(np.sum(told, axis=0))[0] > 1.03 * repeated
    efforts = [float((control**2).sum()) for control in controls]
    assert 0.8 * efforts[0] < min(efforts) <= max(efforts) < 1.25 * efforts[0]


def test_the_guess_of_an_inertia_moves_where_the_recordings_determine_it(tmp_path: Path) -> None:
    """Coordinate by coordinate, by the same names in the same order; what does not show stays where
    it was stated.
    """
    tables = {
        "c": {"target": "joint/hinge:damping"},
        "bob": {"inertial": "bob", "coordinates": "barycentric"},
        "d": {"target": "joint/slide:damping"},
    }
    base = cart_task(tmp_path, parameters=tables)
    p = base.parameters
    theta = p.guess + 0.01 * p.magnitude
    data = np.diag(1e4 / p.magnitude**2)
    shown = bare_estimate(p.names, theta, 0.01 * p.magnitude, data=data)
    moved = DesignTask.resolve(restate_experiment(base, theta, shown))
    assert moved.parameters.names == p.names
    assert_allclose(moved.theta, theta)
    assert_allclose(moved.parameters.scale, p.scale)
    data[3, 3] = 0.0
    kept = DesignTask.resolve(restate_experiment(base, theta, replace(shown, data=data)))
    assert_allclose(kept.theta[1:11], p.guess[1:11])
    assert_allclose(kept.theta[[0, 11]], theta[[0, 11]])


def test_robust_redesigns_sample_around_the_estimate(campaign: Campaign) -> None:
    wide, last = (
        DesignTask.resolve(STUDY.replace(robust={"samples": 6})),
        campaign.rounds[0].estimate,
    )
    around = DesignTask.resolve(restate_experiment(wide, last.theta, last))
    before, after = (task.samples_of_parameters.thetas for task in (wide, around))
    assert (np.abs(after - last.theta) <= 2.51 * last.std).all()
    assert np.ptp(before, axis=0).min() > 10 * np.ptp(after, axis=0).max()


def test_friction_that_the_model_lacks_makes_the_result_doubtful(tmp_path: Path) -> None:
    """A target is not reached where the estimate is wrong by many standard deviations."""
    text = (MODELS / "cart_pendulum.xml").read_text(encoding="utf-8")
    rubbing = text.replace('axis="1 0 0"/>', 'axis="1 0 0" frictionloss="1.0"/>', 1)
    (tmp_path / "robot.xml").write_text(rubbing, encoding="utf-8")
    rough = STUDY.replace(model=str(tmp_path / "robot.xml"))
    easy = STUDY.replace(
        parameters={name: {"wanted": 0.03} for name in "mlc"}, fit={"bootstrap": 0}
    )
    found = mjfim.run_campaign(
        easy, lambda d, k: mjfim.simulate(rough, d.trajectory, seed=k), rounds=2
    )
    assert found.estimate.misfit
    assert found.status is CampaignStatus.DOUBTFUL and not found.reached
    assert any("misfit" in sentence for sentence in found.warnings)


def test_a_redesign_expects_the_noise_that_the_recordings_show() -> None:
    loud = STUDY.replace(noise={"state": 4.0 * STUDY.noise["state"]})
    estimated = STUDY.replace(fit={"noise": "estimated", "bootstrap": 0})
    found = mjfim.run_campaign(
        estimated, lambda d, k: mjfim.simulate(loud, d.trajectory, seed=k), rounds=2
    )
    first, last = found.rounds
    told = last.estimate.data - first.estimate.data
    assert_allclose(np.diag(last.design.data), np.diag(told), rtol=0.3)


def earlier(campaign: Campaign) -> RecordedRound:
    """The first round, as another call reads it from its folder."""
    first = campaign.rounds[0]
    return first.design, first.recordings


def after_two(campaign: Campaign, second: Recording) -> Campaign:
    """The campaign after its first round and a second one with this recording."""
    done = [earlier(campaign), (None, (second,))]
    fit = {"segments": "whole", "bootstrap": 0}
    return mjfim.run_campaign(STUDY.replace(fit=fit), NEVER, rounds=2, done=done)


def test_a_round_without_progress_is_named(campaign: Campaign) -> None:
    """Three rows of a recording are no progress; the rounds are used up, and it says what is
    missing.
    """
    whole = campaign.rounds[0].recordings[0]
    found = after_two(campaign, replace(whole, t=whole.t[:3], ctrl=whole.ctrl[:2], y=whole.y[:3]))
    assert found.status is CampaignStatus.EXHAUSTED and not found.reached
    assert any("round 2: no progress" in sentence for sentence in found.warnings)
    assert "wanted 0.008" in found.short and "wanted 0.008" in found.words


def test_an_estimate_that_jumps_is_named(campaign: Campaign) -> None:
    """The bob loses a tenth of its mass between two rounds."""
    light = STUDY.replace(parameters={"m": {"true": 1.8}})
    found = after_two(campaign, mjfim.simulate(light, campaign.designs[1].trajectory, seed=1))
    assert any(sentence.startswith("round 2: m moved") for sentence in found.warnings)


def test_interrupted_while_recording(campaign: Campaign) -> None:
    token = StopToken()

    def stop_in_the_second_round(design: Design, number: int) -> Recording:
        if number == 2:
            token.request()
        return robot(design, number)

    found = mjfim.run_campaign(STUDY, stop_in_the_second_round, stop=token)
    assert found.status is CampaignStatus.INTERRUPTED and found.pending is not None
    (first,) = found.rounds
    expected = campaign.rounds[0].estimate.theta
    assert_allclose(first.estimate.theta, expected, rtol=1e-9)


def test_a_design_that_violates_limits_is_not_played(
    campaign: Campaign, monkeypatch: pytest.MonkeyPatch
) -> None:
    outside = replace(campaign.designs[0], status=Status.INFEASIBLE)
    monkeypatch.setattr(campaign_module, "design_task", lambda *args, **kwargs: outside)
    found = mjfim.run_campaign(STUDY, NEVER)
    assert (
        found.status is CampaignStatus.INFEASIBLE and found.pending is outside and not found.rounds
    )


def test_without_a_design_at_the_estimate_the_parameters_of_the_last_design_are_used(
    campaign: Campaign, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, asked = campaign.rounds[0], []

    def fails_once(run: object, theta: Array) -> Design:
        asked.append(theta)
        if len(asked) == 1:
            raise SimulationDivergedError("too fast")
        return campaign.designs[1]

    monkeypatch.setattr(campaign_module._CampaignRun, "_redesign", fails_once)
    found = mjfim.run_campaign(STUDY, robot, rounds=2, done=[earlier(campaign)])
    assert_array_equal(asked, [first.estimate.theta, first.theta])
    (said,) = [text for text in found.warnings if "no design could be made at the estimate" in text]
    assert "too fast" in said


def test_messages_about_faulty_requests_name_valid_values() -> None:
    for experiment, options, message in (
        (cart_pendulum(), {}, r"parameters\.m\.wanted"),
        (STUDY.replace(earlier=("design.json",)), {}, "recordings alone"),
        (STUDY, {"rounds": 0}, "0 rounds"),
    ):
        with pytest.raises(ExperimentError, match=message):
            mjfim.run_campaign(experiment, NEVER, **options)


def test_unidentifiable_targets_are_reported_before_the_robot_moves() -> None:
    """Only the sum of the cart's mass and of the drive's inertia can be identified."""
    tables = {
        "cart": {"target": "body/cart:mass", "wanted": 0.01},
        "rotor": {"target": "joint/slide:armature", "guess": 0.1, "wanted": 0.01},
    }
    both = STUDY.replace(parameters=tables, descent={"max_iterations": 2})
    with pytest.raises(UnidentifiableError, match=r"cart, rotor can be reached.*cart \+ rotor"):
        mjfim.run_campaign(both, NEVER)


def write_study(folder: Path) -> Path:
    """The study as a file."""
    for name in ("cart_pendulum.xml", "cart_pendulum.csv"):
        shutil.copy(MODELS / name, folder)
    return write_wrong_guess(folder / "study.toml", first="rehearsal.robots = 4")


WANTED = ("--wanted", 0.0055)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a campaign by the command line, beside the file of its study."""
    home = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        write_empty_figures(patch)
        result = run("campaign", write_study(home), *WANTED, "--seed", 5, "-o", home / "whole")
    assert result.exit_code == 0, result.stderr
    return home / "whole"


def require_equal_rounds(folder: Path, other: Path) -> None:
    """Assert that the campaigns of two folders have the same rounds."""
    rounds = [read(place / "campaign.json")["rounds"] for place in (folder, other)]
    assert len(rounds[1]) >= 2
    for one, two in zip(*rounds, strict=True):
        for key in ("theta", "std", "predicted", "designed_at"):
            assert_allclose(one[key], two[key], rtol=1e-6)


@pytest.mark.usefixtures("empty_figures")
def test_round_by_round_is_the_simulated_campaign(whole: Path, tmp_path: Path) -> None:
    """Calls that share nothing but the folder design and estimate as one call does; misuse is
    named.
    """
    apart = tmp_path / "apart"

    def call(*words: object, code: int) -> Result:
        """Run the verb on the study."""
        result = run("campaign", whole.parent / "study.toml", *words)
        assert result.exit_code == code, result.stderr
        return result

    assert read(whole / "campaign.json")["reached"]
    assert {"campaign.png", "identified.xml"} <= names(whole)

    shown = call("-o", apart, *WANTED, "--real", code=1)
    files: list[object] = []
    last = len(read(whole / "campaign.json")["rounds"])
    for k in range(1, last + 1):
        assert f"round_{k}/design.csv" in shown.stdout.replace("\n", "")
        if k == 1:  # asked again, it still waits
            call("-o", apart, *WANTED, "--real", code=1)

        # Recordings that are in the folder already do no harm.
        files += ["--recordings", whole / f"round_{k}" / "recording.csv"]
        shown = call("-o", apart, *WANTED, *files, code=0 if k == last else 1)

    second = read(apart / "campaign.json")
    assert second["reached"]
    assert not second["simulated"]
    require_equal_rounds(apart, whole)

    assert "real robot" in call("-o", apart, *WANTED, "--resume", code=2).stderr
    assert "wanted" in call("-o", tmp_path / "none", "--real", code=2).stderr


@pytest.mark.usefixtures("empty_figures")
def test_a_killed_campaign_is_resumed(whole: Path, tmp_path: Path) -> None:
    """Its result is that of a campaign that nobody stopped, wherever in a round it was killed."""
    killed = tmp_path / "killed"
    words = ("campaign", whole.parent / "study.toml", *WANTED, "--seed", 5, "-o")

    # A process that is killed as soon as its first round is complete.
    command = [*PROCESS, *map(str, words), str(killed)]
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True
    ) as process:
        try:
            assert any(line.startswith("round 1:") for line in process.stderr)
        finally:
            process.kill()
    assert not (killed / "campaign.json").exists()

    # What remains of the second round if the campaign is killed at several moments of it.
    incomplete = {
        "while-writing": {"design.npz", "design.csv"},
        "before-recording": {"design.npz", "design.csv", "reference.csv", "design.json"},
    }
    for name, kept in incomplete.items():
        folder = tmp_path / name
        shutil.copytree(whole, folder)
        for path in (folder / "round_2").iterdir():
            if path.name not in kept | {MANIFEST}:
                path.unlink()
        for number in range(3, 10):
            shutil.rmtree(folder / f"round_{number}", ignore_errors=True)

    for folder in (killed, *(tmp_path / name for name in incomplete)):
        result = run(*words, folder, "--resume")
        assert result.exit_code == 0, result.stderr
        require_equal_rounds(folder, whole)


def test_a_campaign_is_not_continued_by_mistake(tmp_path: Path) -> None:
    """The folder holds a round; simulated and real recordings do not mix."""
    study, folder = write_study(tmp_path), tmp_path / "out"
    (folder / "round_1").mkdir(parents=True)
    words = ("campaign", study, "--wanted", 0.1, "-o", folder)
    misused(run(*words), f"{folder}: this folder holds a campaign already", "--resume", "--real")

    (folder / "campaign.json").write_text('{"simulated": false}', encoding="utf-8")
    misused(run(*words, "--resume"), f"{folder}: the recordings", "real robot", "--real")


def test_a_campaign_is_continued_with_its_own_settings_only(tmp_path: Path) -> None:
    """The seed, every key of the experiment, and the contents of its files are compared."""
    study, folder = write_study(tmp_path), tmp_path / "out"
    (folder / "round_1").mkdir(parents=True)

    def refused(*words: object, said: Sequence[str]) -> None:
        """The campaign is not continued."""
        misused(run("campaign", study, "-o", folder, "--resume", *words), *said)

    refused("--wanted", 0.1, said=("settings.json: no such file", "another folder"))
    stated = with_target_accuracies(mjfim.Experiment.from_file(study), 0.1)
    write_json(folder / SETTINGS_FILE, campaign_settings(stated, seed=5))
    told = ("--seed was 5, is 6", "parameters.c.wanted was 0.13", "is 0.27")
    message = f"{folder}: --resume needs the settings"
    refused("--wanted", 0.2, "--seed", 6, said=(message, *told))

    # A comment in the experiment file changes nothing, a comment in the model may.
    study.write_text(study.read_text(encoding="utf-8") + "# end\n", encoding="utf-8")
    require_same_settings(folder, campaign_settings(stated, seed=5))
    model = tmp_path / "cart_pendulum.xml"
    model.write_text(model.read_text(encoding="utf-8") + "<!-- end -->\n", encoding="utf-8")
    refused("--wanted", 0.1, "--seed", 5, said=["the file cart_pendulum.xml was changed"])
