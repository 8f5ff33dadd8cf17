"""Design, record, identify, design again with what is known by then, until every parameter's `wanted` sigma is reached.

    python scripts/sequential.py models/cart_pendulum_guess.toml -o out/campaign --wanted 0.005   # a robot at the `true` values
    python scripts/sequential.py EXPERIMENT.toml -o out/campaign --real                           # a real one, round by round

With --real each call goes as far as it can: it identifies from all recordings so far, designs the next round into
DIR/round_K/ and ends. Play DIR/round_K/design.csv on the robot, then repeat the call with `--recordings FILE.csv ...` (or
leave the recordings as DIR/round_K/recording*.csv). The folder is all there is to remember; files that are in it already
are recognised. A simulated campaign leaves the same folder, so --real can go on from there.

DIR gets campaign.json, campaign.png, identified.xml, and a round_K/ each: design.json, design.npz, design.csv,
reference.csv, recording*.csv, estimate.json. Exit code 0: reached, 1: not (yet), 2: misuse.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from sequential_folder import Folder, told

import mjfim
from mjfim.arrays import Array
from mjfim.errors import ExperimentError, MjfimError, RecordingError
from mjfim.excitation.target_accuracy import target_accuracies
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.experiment.simulate import simulate_system
from mjfim.output.archive import write_recording
from mjfim.output.folders import check_folder
from mjfim.records.campaign import Campaign, CampaignStatus
from mjfim.records.design import Design
from mjfim.records.recording import Recording

say = Console(highlight=False, soft_wrap=True)


def table(campaign: Campaign, task: DesignTask, simulated: bool) -> Table:
    """The last round."""
    rows = Table(title=str(campaign), title_justify="left")
    for heading in (
        "parameter",
        "guess",
        "estimate",
        "formal σ",
        "wanted σ",
        *(["off by"] if simulated else []),
    ):
        rows.add_column(heading, justify="left" if heading == "parameter" else "right")
    e = campaign.estimate
    for j in task.parameters.interest.tolist() if e is not None else []:
        if e is None:
            continue
        std, aim = float(e.std[j]), float(campaign.wanted[j])
        off = [f"{(e.theta[j] - task.parameters.true[j]) / std:+.1f} σ"] if simulated else []
        words = [
            e.parameters[j],
            f"{task.parameters.guess[j]:.5g}",
            f"{e.theta[j]:.5g}",
            f"{std:.2g}",
        ]
        rows.add_row(
            *words,
            f"{aim:.2g}" if np.isfinite(aim) else "-",
            *off,
            style="" if std <= aim else "yellow",
        )
    return rows


def simulated(folder: Folder, rounds: int, seed: int) -> Campaign:
    """A campaign on a robot that is the model at its true values; the noise of round k has the seed `seed + k - 1`."""
    experiment = folder.task.experiment
    if all(spec.true is None for spec in experiment.parameters.values()):
        raise ExperimentError(
            f"{experiment.source}: no parameter states a `true` value, at which a robot could be simulated; state some, or "
            "use --real"
        )
    if list(folder.path.glob("round_*")):
        raise RecordingError(
            f"{folder.path}: holds a campaign already; take another folder, or go on with --real"
        )

    def measure(design: Design, number: int) -> Recording:
        folder.leave_design(design, number)
        recording = simulate_system(folder.task.system, design.trajectory, seed + number - 1)
        write_recording(folder.round(number) / "recording.csv", recording, folder.task.system)
        return recording

    threads = folder.task.plant.simulator.threads
    return mjfim.sequential(experiment, measure, rounds, threads=threads, report=folder.report)


def real(folder: Folder, rounds: int, files: Sequence[Path]) -> Campaign:
    """As far as the recordings go, and the next design."""
    folder.take(files)
    done = list(folder.done())
    waits = folder.designed > folder.recorded
    experiment, threads = folder.task.experiment, folder.task.plant.simulator.threads

    def measure(design: Design, number: int) -> None:
        folder.leave_design(design, number)

    if waits and not done:
        return Campaign(
            parameters=folder.task.parameters.names,
            wanted=target_accuracies(folder.task),
            rounds=(),
            status=CampaignStatus.WAITING,
        )
    limit = len(done) if waits else rounds
    campaign = mjfim.sequential(
        experiment, measure, limit, threads=threads, report=folder.report, done=done
    )
    if waits and campaign.status is CampaignStatus.EXHAUSTED and len(done) < rounds:
        return replace(campaign, status=CampaignStatus.WAITING)
    return campaign


def with_wanted(
    experiment: Experiment, relative: float | None, names: Sequence[str], guess: Array
) -> Experiment:
    """The experiment with a wanted σ, relative to the guess, of every parameter that states none."""
    if relative is None:
        return experiment
    tables = {}
    for name, value in zip(names, guess.tolist(), strict=True):
        spec = experiment.parameters.get(name)
        if (
            spec is not None
            and spec.wanted is None
            and spec.inertial is None
            and not spec.nuisance
            and value
        ):
            tables[name] = {"wanted": relative * abs(value)}
    return experiment.replace(parameters=tables)


def main() -> int:
    """Run, say, leave files."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("experiment", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--rounds", type=int, default=10, help="at most so many (default 10)")
    parser.add_argument(
        "--wanted",
        type=float,
        metavar="SHARE",
        help="of the guess, where the file states no `wanted` σ",
    )
    parser.add_argument("--seed", type=int, default=0, help="of the simulated noise")
    parser.add_argument(
        "--real", action="store_true", help="record on a real robot, a round a call"
    )
    parser.add_argument(
        "--recordings",
        type=Path,
        nargs="+",
        default=[],
        metavar="CSV",
        help="of the round that waits",
    )
    parser.add_argument("--threads", type=int, help="for MuJoCo; default: all cores")
    args = parser.parse_args()
    try:
        stated = mjfim.Experiment.from_file(args.experiment)
        first = DesignTask.resolve(stated, threads=args.threads)
        stated = with_wanted(stated, args.wanted, first.parameters.names, first.parameters.guess)
        check_folder(args.output)
        folder = Folder(args.output, DesignTask.resolve(stated, threads=args.threads))
        target_accuracies(folder.task)
        truth = not (args.real or args.recordings)
        campaign = (
            simulated(folder, args.rounds, args.seed)
            if truth
            else real(folder, args.rounds, args.recordings)
        )
        folder.leave(campaign, truth)
    except MjfimError as error:
        told.print(f"sequential: {error}", markup=False)
        return 2
    except KeyboardInterrupt:
        told.print(f"sequential: interrupted; {args.output}/ holds the rounds that are complete")
        return 1
    say.print(table(campaign, folder.task, truth))
    if campaign.status is CampaignStatus.WAITING:
        waiting = folder.round(folder.designed)
        say.print(
            f"play {waiting}/design.csv, record, then repeat this call with --recordings FILE.csv",
            markup=False,
        )
    told.print(f"wrote {args.output}/")
    return 0 if campaign.reached else 1


if __name__ == "__main__":
    sys.exit(main())
