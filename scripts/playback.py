"""Play a design on simulated robots that are not the model. Do the limits hold, does the information arrive?

    python scripts/playback.py                                    # designs for models/servo_arm.toml, hard limits, rest to rest
    python scripts/playback.py EXPERIMENT.toml                    # designs for an experiment
    python scripts/playback.py EXPERIMENT.toml DESIGN_FOLDER      # plays DESIGN_FOLDER/design.csv

Each of the runs is a robot of its own: every parameter of the experiment is off by the stated share, up or down at random, and
it stands still at its own equilibrium before it begins. It gets the rows of design.csv at the controller's rate, each one a
latency later; with --feedback the controller adds the gains times what it reads, noise included. Limits are looked at at every
engine step. What the controller sent and what was measured is a recording; `mjfim.identify` starts from the guess, with the
delay and, where the parameters move it, the start as further unknowns.

A robot that differs from the model comes closer to the limits than the plan; a plan that uses them up exceeds them. The script
says how much of each range has to be kept in reserve; --reserve makes a design that does.

Exit code 0: every unknown's 95 % interval holds the true value in at least 90 % of the runs, and all limits hold in all runs;
1: not so; 2: misuse.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from playback_robots import LATENCY, Bench, Conditions, play_all
from playback_verdict import conclusions, judge, limit_table, parameter_table, picture, summary
from rich.console import Console
from rich.markup import escape

from mjfim.errors import ExperimentError, MjfimError, unknown
from mjfim.excitation.design import design_task
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.output.archive import write_design
from mjfim.parallel import cores
from mjfim.records.serialization import write_json

MODEL = Path(__file__).resolve().parents[1] / "models" / "servo_arm.toml"
KINDS = ("position", "velocity", "acceleration", "control", "control_rate", "force", "clearance")
RESERVE = (
    "position=0.05",
    "velocity=0.3",
    "force=0.25",
)  # what 20 % wrong parameters take on the servo arm


def example() -> Experiment:
    """The bundled servo arm under hard limits, from rest to rest, its commands smooth enough for a hobby servo."""
    stated = Experiment.from_file(MODEL)
    return stated.replace(
        rate=50.0,
        playback_rate=500.0,
        horizon=4.0,
        cost={"control": 0.0},
        descent={"max_iterations": 150},
        boundary={"start": "rest", "end": "rest"},
        parameters={
            "kp_shoulder": {"prior": 4.0},
            "kp_elbow": {"prior": 3.0},
        },  # as wrong as all others
        nuisance={"delay": True},
        limits={
            "position": {
                "yaw": (-1.5, 1.5),
                "shoulder": (-0.6, 1.6),
                "elbow": (0.0, 2.2),
                "wrist": (-1.2, 1.6),
            },
            "velocity": 3.0,
            "control_rate": 5.0,
            "bandwidth": 4.0,
        },
    )


def tightened(experiment: Experiment, reserve: Mapping[str, float]) -> Experiment:
    """The experiment with limits tightened by shares of half of their ranges, by kind."""
    tables: dict[str, dict[str, tuple[float, float]]] = {}
    for limit in DesignTask.resolve(experiment).limits:
        if reserve.get(limit.kind):
            inner = reserve[limit.kind] * limit.scale
            tables.setdefault(limit.kind, {})[limit.name] = (
                limit.lower + inner,
                limit.upper - inner,
            )
    least = experiment.limits.clearance
    more = {} if least is None else {"clearance": least * (1.0 + reserve.get("clearance", 0.0))}
    return experiment.replace(limits={**tables, **more})


def made(experiment: Experiment, folder: Path, console: Console) -> Path:
    """Design, and leave it in a folder; returns its table."""
    task = DesignTask.resolve(experiment)
    with console.status("designing") as status:
        design = design_task(
            task,
            callback=lambda event: status.update(
                f"designing: iteration {event.row.iteration}, {event.row.seconds:.0f} s"
            ),
        )
    write_design(folder, design, task.system)
    margins = ", ".join(f"{kind} {margin:.3g}" for kind, margin in design.limits.items())
    console.print(
        f"designed in {design.seconds:.0f} s: {design.status.value}\nmargins, reserve taken off: {margins}"
    )
    for warning in design.warnings:
        console.print(f"warning: {warning}", style="yellow")
    return folder / "design.csv"


def reserved(words: Sequence[str]) -> dict[str, float]:
    """`kind=share ...` by kind. Raises ExperimentError."""
    found = {}
    for word in words:
        kind, _, share = word.partition("=")
        if kind not in KINDS:
            raise ExperimentError(f"--reserve: {unknown('kind of limit', kind, KINDS)}")
        try:
            found[kind] = float(share)
        except ValueError:
            raise ExperimentError(
                f"--reserve: {word!r} is not {kind}=SHARE, as in {kind}=0.2"
            ) from None
        if not 0.0 <= found[kind] < 1.0:
            raise ExperimentError(
                f"--reserve: {word!r}: a share of half of the range, at least 0 and below 1"
            )
    return found


def parsed() -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "experiment", type=Path, nargs="?", help="experiment file; default: the bundled servo arm"
    )
    parser.add_argument(
        "design", type=Path, nargs="?", help="folder of a design; default: one is made"
    )
    parser.add_argument("-o", "--output", type=Path, default=Path("out/playback"))
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument(
        "--wrong", type=float, default=0.2, help="share by which every parameter is off"
    )
    parser.add_argument(
        "--latency",
        type=float,
        help="of the control [s], whole timesteps; default: 5 ms, rounded up",
    )
    parser.add_argument(
        "--feedback", action="store_true", help="the controller uses the gains on what it measures"
    )
    parser.add_argument(
        "--noise", type=float, default=1.0, help="the robot's noise over the stated one"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=cores())
    parser.add_argument(
        "--reserve",
        nargs="+",
        metavar="KIND=SHARE",
        help="of half ranges that a design made here stays off its limits",
    )
    return parser.parse_args()


def main() -> int:
    """Design if need be, play, print, draw."""
    args, console = parsed(), Console(highlight=False, width=130)
    try:
        return played(args, console)
    except MjfimError as error:
        console.print(escape(str(error)), style="red")
        return 2


def played(args: argparse.Namespace, console: Console) -> int:
    """The work of `main`. Raises MjfimError for misuse."""
    experiment = example() if args.experiment is None else Experiment.from_file(args.experiment)
    step = float(DesignTask.resolve(experiment).system.model.opt.timestep)
    latency = np.ceil(LATENCY / step - 1e-6) * step if args.latency is None else args.latency
    conditions = Conditions(args.wrong, float(latency), args.feedback, args.noise, args.seed)
    if args.design is None:
        reserve = reserved(args.reserve or RESERVE)
        table = made(tightened(experiment, reserve), args.output / "design", console)
    else:
        table = args.design if args.design.is_file() else args.design / "design.csv"
    bench = Bench(experiment, table, conditions)
    clock = time.perf_counter()
    runs = play_all(experiment, table, conditions, args.runs, args.jobs)
    seconds = time.perf_counter() - clock
    verdict = judge(bench, runs)
    console.print(parameter_table(verdict), limit_table(verdict))
    for sentence in conclusions(verdict):
        console.print(f"• {escape(sentence)}")
    write_json(args.output / "playback.json", {**summary(verdict, conditions), "seconds": seconds})
    picture(verdict, args.output / "playback.png", conditions)
    console.print(
        f"{args.runs} runs in {seconds:.0f} s; wrote playback.json, playback.png to {args.output}/"
    )
    return 0 if verdict.ok else 1


if __name__ == "__main__":
    raise SystemExit(main())
