"""Whether `identify --select` finds the term that a model lacks, over many simulated robots.

    python -m scripts.benchmarks selection [--runs 100] [--seed 0] [-o FILE.json]

The robot is the cart-pendulum with one physical term that the identified model lacks: friction,
damping or a spring in a joint, rotor inertia, another gain of the motor, a tilted base, a wrong
zero or scale of a sensor, a delay, or a term of the library: Stribeck friction, friction that
differs by direction, the lag of a motor. The kind of the term changes from run to run, and its size
is random. As many robots lack nothing. Each robot is recorded four times for 4 s under a multisine,
and identified twice: as the experiment states it, and with the selection of terms. The script
counts how often the right term is chosen first, how often `misfit` remains, how often a term is
chosen where none is missing, and how often the 95 % intervals hold the true values.
"""

from __future__ import annotations

import re
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

import mjfim
from mjfim.arrays import record
from mjfim.errors import WrongLogError
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system import simulate_system
from mjfim.files import write_json
from mjfim.parallel import cores
from mjfim.records.estimate import Estimate
from scripts.benchmarks.child import ROOT, in_processes, new_table, options_of

# Recordings of each robot, and their duration [s].
RECORDINGS = 4
HORIZON = 4.0

# Control of all recordings.
CONTROL = {"kind": "multisine", "amplitude": 4.0, "frequency": 0.4, "harmonics": 6}

# Name of the missing term among the parameters of the robot.
MISSING = "missing"

# Wanted shares.
WANTED_RIGHT = 0.90
WANTED_WITHOUT_MISFIT = 0.90
WANTED_NOTHING = 0.95


@record
class Kind:
    """A kind of term that the model lacks.

    Attributes:
        words: The term in words.
        path: Target of its parameter.
        low: Smallest size [unit of the target].
        high: Largest size [unit of the target].
        terms: Terms of the library that the robot has, and the model lacks.
        known: Parameters that the robot and the model have besides, to which the term adds.
        integrator: Integrator of the robot and the model, or empty for that of the MJCF.
    """

    words: str
    path: str
    low: float
    high: float
    terms: dict[str, Any] = field(default_factory=dict)
    known: dict[str, Any] = field(default_factory=dict)
    integrator: str = ""


# Stribeck and asymmetric friction extend dry friction, which the model has.
DRY_FRICTION = {"dry": {"target": "joint/slide:frictionloss", "guess": 0.3, "true": 0.4}}


# The sizes change the motion by a few standard deviations of the noise at least.
KINDS = (
    Kind(words="dry friction of the slide", path="joint/slide:frictionloss", low=0.2, high=1.0),
    Kind(words="damping of the slide", path="joint/slide:damping", low=0.3, high=1.0),
    Kind(words="quadratic damping of the slide", path="joint/slide:damping[1]", low=0.3, high=1.0),
    Kind(words="a spring in the slide", path="joint/slide:stiffness", low=1.0, high=8.0),
    Kind(words="rotor inertia of the slide", path="joint/slide:armature", low=0.3, high=1.0),
    Kind(words="dry friction of the hinge", path="joint/hinge:frictionloss", low=0.2, high=0.8),
    Kind(words="a spring in the hinge", path="joint/hinge:stiffness", low=0.5, high=3.0),
    Kind(words="another gain of the motor", path="actuator/force:gainprm[0]", low=1.1, high=1.3),
    Kind(words="a tilt of the base", path="option:gravity[0]", low=0.2, high=0.8),
    Kind(words="a bias of the angle", path="output/qpos:hinge:bias", low=0.03, high=0.15),
    Kind(words="a wrong scale of the angle", path="output/qpos:hinge:scale", low=0.05, high=0.15),
    Kind(words="a delay of the readings", path="output:delay", low=0.02, high=0.06),
    Kind(
        words="a lag of the motor",
        path="term/force_actuator_lag:time_constant",
        low=0.03,
        high=0.12,
        terms={"force_actuator_lag": {"kind": "actuator_lag", "actuator": "force"}},
    ),
    Kind(
        words="Stribeck friction of the slide",
        path="term/slide_stribeck:excess",
        low=0.4,
        high=1.0,
        terms={"slide_stribeck": {"kind": "stribeck", "joint": "slide", "values": {"speed": 0.3}}},
        known=DRY_FRICTION,
        integrator="implicitfast",
    ),
    Kind(
        words="friction of the slide that differs by direction",
        path="term/slide_asymmetric_friction:offset",
        low=0.2,
        high=0.4,
        terms={
            "slide_asymmetric_friction": {"kind": "asymmetric_friction", "joint": "slide"},
        },
        known=DRY_FRICTION,
    ),
)


@record
class Outcome:
    """Outcome of one run.

    Attributes:
        kind: The missing term in words; empty where none is missing.
        chosen: The chosen terms as paths, in their order.
        is_right: Whether the missing term was chosen first.
        is_alternative: Whether the missing term was named among those that predict as well as the
            first one.
        misfit: Whether a misfit remains after the selection.
        misfit_before: Whether an identification without selection raises a misfit.
        inside: Whether the interval holds the true value, for each parameter of the experiment.
        inside_before: The same without selection.
        seconds: Time of the selection [s].
        passes: Simulations of all data by the selection.
    """

    kind: str
    chosen: tuple[str, ...]
    is_right: bool
    is_alternative: bool
    misfit: bool
    misfit_before: bool
    inside: tuple[bool, ...]
    inside_before: tuple[bool, ...]
    seconds: float
    passes: float


@record
class Job:
    """One run of the study.

    Attributes:
        seed: Seed of the study.
        number: Number of the run.
        kind: The missing term, or None.
    """

    seed: int
    number: int
    kind: Kind | None


def stated(kind: Kind | None, folder: Path) -> mjfim.Experiment:
    """The experiment as the user states it.

    Args:
        kind: The missing term, or None.
        folder: Empty folder for an MJCF with another integrator.
    """
    base = mjfim.Experiment.from_file(ROOT / "models" / "cart_pendulum.toml")
    base = base.replace(horizon=HORIZON, initial={"control": CONTROL})
    if kind is None or not kind.integrator:
        return base if kind is None else base.replace(parameters=kind.known)

    # The bristle of Stribeck friction is unstable under the integrator RK4 of the MJCF.
    text = (ROOT / "models" / "cart_pendulum.xml").read_text(encoding="utf-8")
    changed = text.replace('integrator="RK4"', f'integrator="{kind.integrator}"')
    assert changed != text
    path = folder / "cart_pendulum.xml"
    path.write_text(changed, encoding="utf-8")
    return base.replace(model=str(path), parameters=kind.known)


def run(job: Job) -> Outcome:
    """Record and identify one robot.

    Args:
        job: The run.

    Returns:
        Outcome of the run.
    """
    rng = np.random.default_rng([job.seed, job.number, int(job.kind is None)])
    with tempfile.TemporaryDirectory() as folder:
        return _run(job, rng, stated(job.kind, Path(folder)))


def _run(job: Job, rng: np.random.Generator, experiment: mjfim.Experiment) -> Outcome:
    """Record and identify one robot, whose experiment is stated."""
    robot = experiment
    if job.kind is not None:
        value = float(rng.uniform(job.kind.low, job.kind.high))
        robot = experiment.replace(
            terms=job.kind.terms,
            parameters={MISSING: {"target": job.kind.path, "guess": value, "true": value}},
        )

    # The last parameter of the robot is the one that the experiment lacks.
    task = DesignTask.resolve(robot, threads=1)
    true = task.parameters.true[: len(experiment.parameters)]
    seeds = rng.integers(2**31, size=RECORDINGS)
    recordings = [simulate_system(task.system, task.initial, int(seed)) for seed in seeds]

    # Without a selection, whole recordings are compared: short segments would hide a misfit.
    whole = experiment.replace(fit={"segments": "whole"})
    begun = time.perf_counter()
    try:
        before = mjfim.identify(whole, recordings, threads=1, progress=False)
        begun = time.perf_counter()
        found = mjfim.select_terms(experiment, recordings, threads=1, progress=False)
    except WrongLogError as error:
        return _refused(job, str(error), time.perf_counter() - begun)
    seconds = time.perf_counter() - begun

    selection = found.selection
    assert selection is not None
    added = [step for step in selection.steps if step.decision.value == "added"]
    path = "" if job.kind is None else job.kind.path
    first = added[0].path if added else ""
    steps = sum(len(recording.ctrl) for recording in recordings) * task.plant.simulator.substeps
    return Outcome(
        kind="" if job.kind is None else job.kind.words,
        chosen=tuple(term.path for term in selection.terms),
        is_right=bool(path) and first == path,
        is_alternative=bool(added) and path in [other.path for other in added[0].alternatives],
        misfit=found.misfit,
        misfit_before=before.misfit,
        inside=_inside(found, true),
        inside_before=_inside(before, true),
        seconds=seconds,
        passes=found.steps / steps,
    )


def _refused(job: Job, message: str, seconds: float) -> Outcome:
    """The outcome where the log is refused, because an error of an encoder explains it."""
    named = re.search(r"another (zero|scale) of (qpos:\w+);", message)
    kind = {"zero": "bias", "scale": "scale"}.get(named[1] if named else "")
    path = f"output/{named[2]}:{kind}" if named else "?"
    return Outcome(
        kind="" if job.kind is None else job.kind.words,
        chosen=(path,),
        is_right=job.kind is not None and job.kind.path == path,
        is_alternative=False,
        misfit=False,
        misfit_before=True,
        inside=(),
        inside_before=(),
        seconds=seconds,
        passes=0.0,
    )


def _inside(found: Estimate, true: np.ndarray) -> tuple[bool, ...]:
    """Whether the intervals of the parameters of the experiment hold their true values."""
    low, high = found.interval[: len(true)].T
    return tuple(((low <= true) & (true <= high)).tolist())


def study(jobs: Sequence[Job]) -> list[Outcome]:
    """Run many robots on all cores, and print each outcome, so that a study may be stopped.

    Args:
        jobs: The runs.

    Returns:
        Outcomes of all runs.
    """
    found = []
    for outcome in in_processes(run, jobs):
        chosen = ", ".join(outcome.chosen) or "nothing"
        after = "misfit" if outcome.misfit else "no misfit"
        print(f"{outcome.kind or 'complete'}: {chosen}; {after}", flush=True)
        found.append(outcome)
    return found


def kinds_table(found: Sequence[Outcome]) -> Table:
    """Make a table of the selections by kind of the missing term.

    Args:
        found: Outcomes of the runs with a missing term.

    Returns:
        Table with one row for each kind, and one for all.
    """
    headings = "missing term, runs, right first, named as alternative, misfit before, misfit after"
    headings = f"{headings}, inside before, inside after, chosen instead"
    table = new_table("Robots with a term that the model lacks", *headings.split(", "))
    for words in [*dict.fromkeys(outcome.kind for outcome in found), "all"]:
        group = [outcome for outcome in found if words in (outcome.kind, "all")]
        wrong = Counter(o.chosen[0] if o.chosen else "none" for o in group if not o.is_right)
        table.add_row(
            words,
            str(len(group)),
            _percent([o.is_right for o in group]),
            _percent([o.is_alternative for o in group]),
            _percent([o.misfit_before for o in group]),
            _percent([o.misfit for o in group]),
            _percent([flag for o in group for flag in o.inside_before]),
            _percent([flag for o in group for flag in o.inside]),
            ", ".join(f"{name} ({count})" for name, count in wrong.items())
            if words != "all"
            else "",
        )
    return table


def share(flags: Sequence[bool]) -> float:
    """Share of true values; 0 of none."""
    return float(np.mean(flags)) if flags else 0.0


def _percent(flags: Sequence[bool]) -> str:
    """Share of true values in percent."""
    return f"{100.0 * share(flags):.0f} %" if flags else "-"


def main() -> int:
    """Run both studies and print the shares; return 1 where a share is too small."""
    parser = options_of(__doc__)
    parser.add_argument("--runs", type=int, default=100, help="robots of each of both studies")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--output", type=Path, help="JSON file with the shares")
    args = parser.parse_args()
    if args.runs < 1:
        parser.error(f"--runs is {args.runs}; it must be 1 or more")

    clock = time.perf_counter()
    numbers = range(args.runs)
    jobs = [Job(seed=args.seed, number=i, kind=KINDS[i % len(KINDS)]) for i in numbers]
    lacking = study(jobs)
    complete = study([Job(seed=args.seed, number=i, kind=None) for i in numbers])

    right = share([outcome.is_right for outcome in lacking])
    without_misfit = share([not outcome.misfit for outcome in lacking])
    nothing = share([not outcome.chosen for outcome in complete])
    inside = share([flag for outcome in lacking for flag in outcome.inside])
    inside_complete = share([flag for outcome in complete for flag in outcome.inside])
    seconds = float(np.median([outcome.seconds for outcome in (*lacking, *complete)]))
    passes = float(np.median([outcome.passes for outcome in lacking]))

    console = Console(width=180)
    console.print(kinds_table(lacking))
    console.print(
        f"right term first: {100 * right:.0f} % ({100 * WANTED_RIGHT:.0f} % wanted)\n"
        f"without misfit after the selection: {100 * without_misfit:.0f} % "
        f"({100 * WANTED_WITHOUT_MISFIT:.0f} % wanted)\n"
        f"no term where none is missing: {100 * nothing:.0f} % "
        f"({100 * WANTED_NOTHING:.0f} % wanted)\n"
        f"misfit where none is missing: "
        f"{100 * share([o.misfit for o in complete]):.0f} %\n"
        f"true values inside the 95 % intervals: {100 * inside:.1f} % where a term is missing, "
        f"{100 * inside_complete:.1f} % where none is\n"
        f"median selection: {seconds:.1f} s on one thread, {passes:.0f} passes over the data\n"
        f"{2 * args.runs} selections in {time.perf_counter() - clock:.0f} s on {cores()} cores"
    )

    if args.output is not None:
        summary = {
            "runs": args.runs,
            "right": right,
            "without_misfit": without_misfit,
            "nothing": nothing,
            "inside": inside,
            "inside_complete": inside_complete,
            "seconds": seconds,
            "passes": passes,
        }
        write_json(args.output, summary)

    is_good = (
        right >= WANTED_RIGHT
        and without_misfit >= WANTED_WITHOUT_MISFIT
        and nothing >= WANTED_NOTHING
    )
    return 0 if is_good else 1
