"""Random design problems under hard limits: what a design claims is judged by plain MuJoCo."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import mjfim
from mjfim.errors import MjfimError
from mjfim.experiment.system import System
from mjfim.output.archive import write_design
from mjfim.records.design import Design, keeps_limits
from tests.fuzz.outcome import Case, Outcome
from tests.fuzz.plants import Plant, Range, Rng, about_zero, random_plant
from tests.fuzz.player import (
    ROUNDING,
    ROUNDING_WITH_FEEDBACK,
    model_with_force_sensors,
    play,
    read_reference,
    read_rows,
)
from tests.fuzz.workers import announce

# Time of one design [s]; the iterations end most of them before.
SECONDS = 15.0


@dataclass(frozen=True, kw_only=True)
class Problem:
    """A design problem.

    Attributes:
        xml: The MJCF.
        tables: Tables of the experiment file.
        ranges: Range of every limit by kind and name.
        description: What was random in it, in words.
        ignored: Pairs of bodies that may come closer than the clearance.
    """

    xml: str
    tables: dict[str, Any]
    ranges: dict[tuple[str, str], Range]
    description: str
    ignored: tuple[tuple[str, str], ...] = ()


def run(case: Case, folder: Path) -> Outcome:
    """Design an experiment for a random problem, and judge what the design claims."""
    rng = case.rng
    plant = random_plant(rng)
    tables = random_tables(rng, plant)
    problem = Problem(
        xml=plant.xml,
        tables=tables,
        ranges=all_ranges(plant, tables),
        description=describe(plant, tables),
    )
    return attempt(case, folder, problem)


def attempt(
    case: Case,
    folder: Path,
    problem: Problem,
    omissions: Callable[[Design], list[str]] = lambda design: [],
) -> Outcome:
    """Design an experiment for a problem, and judge what the design claims.

    Args:
        case: The case.
        folder: Empty folder for its files.
        problem: The problem.
        omissions: Describes what a design does not say although it should.
    """
    announce(problem.description)
    (folder / "plant.xml").write_text(problem.xml, encoding="utf-8")
    source = str(folder / "fuzz.toml")
    try:
        experiment = mjfim.Experiment(**problem.tables, directory=folder, source=source)
        design = mjfim.design(experiment, threads=1)
    except MjfimError as error:
        text = str(error)
        complaint = "" if text.strip() else "the message of the refusal is empty"
        description = f"{problem.description}; {text}"
        return Outcome(case=case, group="refused", description=description, complaint=complaint)

    # Without a design inside the limits nothing is claimed, but a limit has to be named.
    if not keeps_limits(design):
        return Outcome(case=case, group="infeasible", description=problem.description)

    system = System.resolve(experiment, threads=1)
    write_design(folder, design, system)
    found = [*violations(problem, folder), *omissions(design)]
    return Outcome(
        case=case, group="claimed", description=problem.description, complaint="; ".join(found)
    )


def violations(problem: Problem, folder: Path) -> list[str]:
    """Describe what is violated where design.csv of a folder is played with and without feedback,
    and in the values of reference.csv.
    """
    model = model_with_force_sensors(mujoco.MjSpec.from_file(str(folder / "plant.xml")))
    rows = read_rows(folder / "design.csv")
    period = 1.0 / problem.tables.get("playback_rate", problem.tables["rate"])

    judge = partial(play, model, rows, problem.ranges, period, ignored=problem.ignored)
    found = judge().sentences(ROUNDING)
    with_feedback = judge(feedback=True)
    found += [f"with gains: {text}" for text in with_feedback.sentences(ROUNDING_WITH_FEEDBACK)]

    reference = read_reference(read_rows(folder / "reference.csv"), problem.ranges)
    found += [f"in reference.csv: {text}" for text in reference.sentences(ROUNDING)]
    return found


def narrowed(
    ranges: dict[tuple[str, str], Range], stated: dict[str, dict[str, Any]]
) -> dict[tuple[str, str], Range]:
    """Ranges of the MJCF, narrowed by those that the file states, by kind and name."""
    found = dict(ranges)
    for kind, table in stated.items():
        for name, value in table.items():
            low, high = value if isinstance(value, tuple) else (-value, value)
            lower, upper = found.get((kind, name), (-np.inf, np.inf))
            found[kind, name] = (max(low, lower), min(high, upper))
    return found


def all_ranges(plant: Plant, tables: dict[str, Any]) -> dict[tuple[str, str], Range]:
    """Range of every limit by kind and name: where MJCF and file state one, both hold."""
    stated = {kind: table for kind, table in tables["limits"].items() if kind != "bandwidth"}
    ranges = narrowed(plant.ranges, stated)

    boundary = tables["boundary"]
    if boundary.get("end", "free") != "free":
        for joint in plant.joints:
            for kind in ("position", "velocity"):
                ranges[f"end_{kind}", joint.name] = (-boundary[kind], boundary[kind])
    return ranges


def random_tables(rng: Rng, plant: Plant) -> dict[str, Any]:
    """Tables of a random experiment file for a plant."""
    substeps = int(rng.choice([1, 2, 4, 5]))
    sample = substeps * plant.timestep
    samples = int(rng.integers(20, 60))
    horizon = samples * sample

    targets = [f"body/link{i}:mass" for i in range(len(plant.joints))]
    targets += [
        f"joint/{joint.name}:damping"
        for joint in plant.joints
        if float(joint.attributes["damping"]) > 0.0
    ]
    count = min(int(rng.integers(1, 4)), len(targets))
    chosen = rng.choice(targets, count, replace=False).tolist()
    tables: dict[str, Any] = {
        "model": "plant.xml",
        "rate": 1.0 / sample,
        "horizon": horizon,
        "parameters": {f"p{i}": {"target": target} for i, target in enumerate(chosen)},
        "noise": {"state": 0.01},
        "cost": {"control": 0.0, "criterion": str(rng.choice(["E", "A", "D"]))},
        "limits": _limits(rng, plant, horizon),
        "boundary": _boundary(rng, plant),
        "initial": {"control": _control(rng, plant, horizon)},
        "descent": {
            "max_iterations": int(rng.integers(3, 16)),
            "seconds": SECONDS,
            "starts": int(rng.choice([1, 1, 1, 2])),
        },
    }

    # With a playback rate, the limit of a control's rate holds from row to row.
    if substeps > 1 and rng.random() < 0.3:
        tables["playback_rate"] = 1.0 / plant.timestep
    return tables


def _limits(rng: Rng, plant: Plant, horizon: float) -> dict[str, Any]:
    """Random limits; each joint and each actuator states some of them."""
    limits: dict[str, Any] = {}

    for joint in plant.joints:
        speed = joint.reach / horizon * rng.uniform(0.5, 5.0)
        wanted = {
            "position": about_zero(rng, joint.reach * rng.choice([1.0, 0.3, 0.05]), 0.05),
            "velocity": speed,
            "acceleration": speed / horizon * rng.uniform(3.0, 30.0),
        }
        state_some(rng, limits, joint.name, wanted, (0.5, 0.4, 0.3))

    for drive in plant.drives:
        effort = drive.joint.effort / abs(float(drive.attributes["gear"]))
        wanted = {
            "control": about_zero(rng, drive.control),
            "control_rate": drive.control / horizon * rng.uniform(2.0, 40.0),
            "force": about_zero(rng, effort),
        }
        state_some(rng, limits, drive.name, wanted, (0.4, 0.3, 0.3))

    if rng.random() < 0.15:
        limits["bandwidth"] = float(rng.uniform(2.0, 6.0)) / horizon
    return limits


def state_some(
    rng: Rng,
    limits: dict[str, Any],
    name: str,
    wanted: dict[str, Any],
    chances: tuple[float, ...],
) -> None:
    """State each limit of a joint or an actuator with a chance."""
    for (kind, value), chance in zip(wanted.items(), chances, strict=True):
        if rng.random() < chance and isinstance(limits.get(kind, {}), dict):
            stated = value if isinstance(value, tuple) else float(value)
            limits.setdefault(kind, {})[name] = stated


def _boundary(rng: Rng, plant: Plant) -> dict[str, Any]:
    """A random boundary; most problems state none."""
    boundary: dict[str, Any] = {"position": 0.01, "velocity": 0.02}

    # Joints that fall and have no drive cannot stand still: most of such problems are refused.
    can_rest = plant.gravity == 0.0 or len(plant.drives) == len(plant.joints)
    if not can_rest and rng.random() < 0.9:
        return boundary
    if rng.random() < 0.3:
        boundary["start"] = "rest"
    end = str(rng.choice(["free", "free", "free", "rest", "periodic"]))
    return {**boundary, "end": end}


def _control(rng: Rng, plant: Plant, horizon: float) -> dict[str, Any]:
    """A random initial control, small or of the size of the range."""
    size = float(rng.choice([0.01, 0.1, 0.5]))
    return {
        "kind": str(rng.choice(["sine", "chirp", "multisine"])),
        "amplitude": {drive.name: size * drive.control for drive in plant.drives},
        "frequency": float(rng.uniform(0.5, 3.0)) / horizon,
    }


def describe(plant: Plant, tables: dict[str, Any]) -> str:
    """Describe a problem in a line."""
    joints = ", ".join(joint.kind for joint in plant.joints)
    drives = ", ".join(drive.tag for drive in plant.drives)
    limits = ", ".join(sorted({kind for kind, _ in all_ranges(plant, tables)}))
    boundary = tables["boundary"]
    ends = f"{boundary.get('start', 'given')} to {boundary.get('end', 'free')}"
    return (
        f"{joints}; {drives}; {plant.integrator} {plant.timestep:g} s; gravity "
        f"{plant.gravity:g}; {ends}; limits on {limits}"
    )
