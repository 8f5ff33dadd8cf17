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
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

import mjfim
from mjfim.arrays import Array
from mjfim.errors import WrongLogError
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system import simulate_system
from mjfim.parallel import cores
from mjfim.records.estimate import Estimate
from scripts.benchmarks.child import (
    ROOT,
    Outcome,
    options_of,
    percent,
    share,
    study,
    table_of,
    values_of,
)

# Recordings of each robot, and their duration [s].
RECORDINGS = 4
HORIZON = 4.0

# Control of all recordings.
CONTROL = {"kind": "multisine", "amplitude": 4.0, "frequency": 0.4, "harmonics": 6}

# Kinds of terms that the model lacks: path of the parameter, smallest and largest size [unit of the
# path]. They change the motion by a few standard deviations of the noise at least.
STRIBECK, ASYMMETRIC = (
    "Stribeck friction of the slide",
    "friction of the slide that differs by direction",
)
LAG = "a lag of the motor"
KINDS = {
    "dry friction of the slide": ("joint/slide:frictionloss", 0.2, 1.0),
    "damping of the slide": ("joint/slide:damping", 0.3, 1.0),
    "quadratic damping of the slide": ("joint/slide:damping[1]", 0.3, 1.0),
    "a spring in the slide": ("joint/slide:stiffness", 1.0, 8.0),
    "rotor inertia of the slide": ("joint/slide:armature", 0.3, 1.0),
    "dry friction of the hinge": ("joint/hinge:frictionloss", 0.2, 0.8),
    "a spring in the hinge": ("joint/hinge:stiffness", 0.5, 3.0),
    "another gain of the motor": ("actuator/force:gainprm[0]", 1.1, 1.3),
    "a tilt of the base": ("option:gravity[0]", 0.2, 0.8),
    "a bias of the angle": ("output/qpos:hinge:bias", 0.03, 0.15),
    "a wrong scale of the angle": ("output/qpos:hinge:scale", 0.05, 0.15),
    "a delay of the readings": ("output:delay", 0.02, 0.06),
    LAG: ("term/force_actuator_lag:time_constant", 0.03, 0.12),
    STRIBECK: ("term/slide_stribeck:excess", 0.4, 1.0),
    ASYMMETRIC: ("term/slide_asymmetric_friction:offset", 0.2, 0.4),
}

# Terms of the library that a robot of a kind has, and the model lacks.
TERMS: dict[str, dict[str, Any]] = {
    LAG: {"force_actuator_lag": {"kind": "actuator_lag", "actuator": "force"}},
    STRIBECK: {"slide_stribeck": {"kind": "stribeck", "joint": "slide", "values": {"speed": 0.3}}},
    ASYMMETRIC: {"slide_asymmetric_friction": {"kind": "asymmetric_friction", "joint": "slide"}},
}

# The last two extend dry friction, which their model has.
DRY_FRICTION = {"dry": {"target": "joint/slide:frictionloss", "guess": 0.3, "true": 0.4}}


# What is missing from a robot that lacks nothing.
COMPLETE = "complete"


def inside(found: Estimate, true: Array) -> Any:
    """Whether the intervals of the parameters of the experiment hold their true values."""
    low, high = found.interval[: len(true)].T
    return ((low <= true) & (true <= high)).tolist()


def run(seed: int, number: int, lacks: bool) -> Outcome:
    """Record and identify one robot.

    Args:
        seed: Seed of the study.
        number: Number of the run, which decides the term that the model lacks.
        lacks: Whether it lacks a term.
    """
    rng = np.random.default_rng([seed, number, int(not lacks)])
    experiment = mjfim.Experiment.from_file(ROOT / "models" / "cart_pendulum.toml")
    experiment = experiment.replace(horizon=HORIZON, initial={"control": CONTROL})
    robot, words, path = experiment, COMPLETE, ""
    with tempfile.TemporaryDirectory() as folder:
        if lacks:
            words = list(KINDS)[number % len(KINDS)]
            path, low, high = KINDS[words]
            if words in (STRIBECK, ASYMMETRIC):
                experiment = experiment.replace(parameters=DRY_FRICTION)
            if words == STRIBECK:
                # The bristle of Stribeck friction is unstable under the integrator of the MJCF.
                text = (ROOT / "models" / "cart_pendulum.xml").read_text(encoding="utf-8")
                model = Path(folder) / "cart_pendulum.xml"
                model.write_text(text.replace("RK4", "implicitfast"), encoding="utf-8")
                experiment = experiment.replace(model=str(model))
            value = float(rng.uniform(low, high))
            missing = {"target": path, "guess": value, "true": value}
            terms = TERMS.get(words, {})
            robot = experiment.replace(terms=terms, parameters={"missing": missing})

        # The last parameter of the robot is the one that the experiment lacks.
        task = DesignTask.resolve(robot, threads=1)
        true = task.parameters.true[: len(experiment.parameters)]
        seeds = rng.integers(2**31, size=RECORDINGS)
        recordings = [simulate_system(task.system, task.initial, int(each)) for each in seeds]

        # Without a selection, whole recordings are compared: short segments would hide a misfit.
        whole = experiment.replace(fit={"segments": "whole"})
        begun = time.perf_counter()
        try:
            before = mjfim.identify(whole, recordings, threads=1, progress=False)
            begun = time.perf_counter()
            found = mjfim.select_terms(experiment, recordings, threads=1, progress=False)
        except WrongLogError as error:
            # The log is refused, because an error of an encoder explains it.
            named = re.search(r"another (zero|scale) of (qpos:\w+);", str(error))
            fault = {"zero": "bias", "scale": "scale"}.get(named[1] if named else "")
            first = f"output/{named[2]}:{fault}" if named else "?"
            chosen, alternatives = [first], set()
            judged = {"misfit": False, "misfit before": True, "inside": [], "inside before": []}
        else:
            selection = found.selection
            assert selection is not None
            chosen = [term.path for term in selection.terms]
            added = [step for step in selection.steps if step.decision.value == "added"]
            first = added[0].path if added else ""
            alternatives = {other.path for step in added[:1] for other in step.alternatives}
            judged = {
                "misfit": found.misfit,
                "misfit before": before.misfit,
                "inside": inside(found, true),
                "inside before": inside(before, true),
            }
    return {
        "missing term": words,
        "chosen": chosen,
        "right": lacks and first == path,
        "alternative": path in alternatives,
        "nothing": not chosen,
        **judged,
        "seconds": time.perf_counter() - begun,
    }


def main() -> int:
    """Run both studies and print the shares; return 1 where a share is too small."""
    args = options_of(__doc__, runs=100).parse_args()

    clock = time.perf_counter()
    jobs = [(args.seed, i, lacks) for lacks in (True, False) for i in range(args.runs)]
    found = study(run, jobs, args.processes, args.output)
    for each in found:
        terms = ", ".join(each["chosen"]) or "nothing"
        print(f"{each['missing term']}: {terms}; {'misfit' if each['misfit'] else 'no misfit'}")
    lacking, complete = found[: args.runs], found[args.runs :]

    columns = {
        "right first": percent("right"),
        "named as alternative": percent("alternative"),
        "misfit before": percent("misfit before"),
        "misfit after": percent("misfit"),
        "inside before": percent("inside before"),
        "inside after": percent("inside"),
    }
    console = Console(width=180)
    title = "Robots with a term that the model lacks"
    console.print(table_of(title, lacking, ["missing term"], columns, has_all=True))
    wanted = (
        ("right term first", share(lacking, "right"), 0.90),
        (
            "without misfit after the selection",
            1.0 - share(lacking, "misfit"),
            0.90,
        ),
        ("no term where none is missing", share(complete, "nothing"), 0.95),
    )
    for words, value, least in wanted:
        console.print(f"{words}: {100 * value:.0f} % ({100 * least:.0f} % wanted)")
    console.print(
        f"misfit where none is missing: {100 * share(complete, 'misfit'):.0f} %\n"
        f"true values inside the 95 % intervals: {100 * share(lacking, 'inside'):.1f} % "
        f"where a term is missing, {100 * share(complete, 'inside'):.1f} % where none is\n"
        f"median selection: {np.median(values_of(found, 'seconds')):.1f} s on one thread\n"
        f"{len(found)} selections in {time.perf_counter() - clock:.0f} s on {cores()} cores"
    )
    return 0 if all(value >= least for _, value, least in wanted) else 1
