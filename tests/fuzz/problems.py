"""Random design problems under hard limits: what a design claims is judged by plain MuJoCo."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import mujoco
import numpy as np

import mjfim
from mjfim.errors import MjfimError
from mjfim.experiment.system import System
from mjfim.output.archive import write_data
from mjfim.records.design import keeps_limits
from tests.fuzz.bad_inputs import Tables, pick
from tests.fuzz.mechanisms import Mechanism
from tests.fuzz.outcome import Case, Outcome, announce
from tests.fuzz.plants import Plant, Ranges, Rng, about_zero, random_plant
from tests.fuzz.player import (
    NEAREST,
    PLACE,
    ROUNDING,
    ROUNDING_WITH_FEEDBACK,
    TURN,
    play,
    read_reference,
    read_rows,
    stated_ranges,
)

# Time of one design [s]; the iterations end most of them before.
SECONDS = 15.0


def run(case: Case, folder: Path) -> Outcome:
    """Design an experiment for a random problem, and judge what the design claims.

    Args:
        case: The case; its plant is a chain or a mechanism.
        folder: Empty folder for its files.
    """
    rng = case.rng
    plant = random_plant(rng) if case.kind == "problem" else Mechanism(rng)
    tables = random_tables(rng, plant)
    if case.kind == "mechanism":
        complicate(rng, plant, tables)
    description = describe(plant, tables)
    announce(description)

    (folder / "plant.xml").write_text(plant.xml, encoding="utf-8")
    source = str(folder / "fuzz.toml")
    try:
        experiment = mjfim.Experiment(**tables, directory=folder, source=source)
        design = mjfim.design(experiment, threads=1)
    except MjfimError as error:
        text = str(error)
        complaint = "" if text.strip() else "the message of the refusal is empty"
        about = f"{description}; {text}"
        return Outcome(case=case, group="refused", description=about, complaint=complaint)

    # Without a design inside the limits nothing is claimed, but a limit has to be named.
    if not keeps_limits(design):
        return Outcome(case=case, group="infeasible", description=description)

    write_data(folder, design, System.resolve(experiment, threads=1))
    found = [*violations(plant, tables, folder), *omissions(plant, design.warnings)]
    complaint = "; ".join(found)
    return Outcome(case=case, group="claimed", description=description, complaint=complaint)


def violations(plant: Plant, tables: Tables, folder: Path) -> list[str]:
    """Describe what is violated where design.csv of a folder is played with and without feedback,
    and in the values of reference.csv.
    """
    model = mujoco.MjModel.from_xml_path(str(folder / "plant.xml"))
    rows, ranges = read_rows(folder / "design.csv"), all_ranges(plant, tables)
    period = 1.0 / tables.get("playback_rate", tables["rate"])
    ignored = tables["limits"].get("ignored", ())

    judge = partial(play, model, rows, ranges, period, ignored=ignored)
    found = judge().sentences(ROUNDING)
    with_feedback = judge(feedback=True)
    found += [f"with gains: {text}" for text in with_feedback.sentences(ROUNDING_WITH_FEEDBACK)]

    reference = read_reference(read_rows(folder / "reference.csv"), ranges)
    return found + [f"in reference.csv: {text}" for text in reference.sentences(ROUNDING)]


def omissions(plant: Plant, warnings: tuple[str, ...]) -> list[str]:
    """Describe what a design does not keep, and what its warnings do not say either."""
    told = "\n".join(warnings)
    unheld = [drive.name for drive in plant.drives if not drive.is_held]
    return [f"no warning names the range of {name}" for name in unheld if name not in told]


def all_ranges(plant: Plant, tables: Tables) -> Ranges:
    """Range of every limit by kind and name: where MJCF and file state one, both hold."""
    ranges, limits = dict(plant.ranges), tables["limits"]
    for limit, (low, high) in stated_ranges(limits, [each.name for each in plant.joints]).items():
        lower, upper = ranges.get(limit, (-np.inf, np.inf))
        ranges[limit] = (max(low, lower), min(high, upper))

    if "clearance" in limits:
        least = limits["clearance"]
        ranges["clearance", NEAREST] = (least, 2.0 * least)
    boundary = tables["boundary"]
    if boundary.get("end", "free") != "free":
        parts = {"ball": TURN, "free": (*PLACE, *TURN)}
        for joint in plant.joints:
            for part in parts.get(joint.kind, ("",)):
                for kind in ("position", "velocity"):
                    bound = boundary[kind]
                    ranges[f"end_{kind}", f"{joint.name}{part}"] = (-bound, bound)
    return ranges


def random_tables(rng: Rng, plant: Plant) -> Tables:
    substeps = int(rng.choice([1, 2, 4, 5]))
    sample = substeps * plant.timestep
    horizon = int(rng.integers(20, 60)) * sample
    count = min(int(rng.integers(1, 4)), len(plant.targets))
    chosen = rng.choice(plant.targets, count, replace=False).tolist()
    tables = {
        "model": "plant.xml",
        "rate": 1.0 / sample,
        "horizon": horizon,
        "parameters": {f"p{i}": {"target": target} for i, target in enumerate(chosen)},
        "noise": {"state": 0.01},
        "cost": {"control": 0.0, "criterion": str(rng.choice(["E", "A", "D"]))},
        "limits": _limits(rng, plant, horizon),
        "boundary": _boundary(rng, plant),
        # A control that is small, or of the size of the range.
        "initial": {"control": _control(rng, plant, horizon)},
        "descent": {
            "max_iterations": int(rng.integers(3, 16)),
            "seconds": SECONDS,
            "starts": int(rng.choice([1, 1, 1, 2])),
        },
        "rehearsal": {"robots": 4},
    }

    # With a playback rate, the limit of a control's rate holds from row to row.
    if substeps > 1 and rng.random() < 0.3:
        tables["playback_rate"] = 1.0 / plant.timestep
    return tables


def _limits(rng: Rng, plant: Plant, horizon: float) -> Tables:
    """Random limits; each slide or hinge and each actuator states some of them."""
    limits = {}
    for joint in plant.joints:
        if joint.is_scalar:
            speed = joint.reach / horizon * rng.uniform(0.5, 5.0)
            wanted = {
                "position": about_zero(rng, joint.reach * rng.choice([1.0, 0.3, 0.05]), 0.05),
                "velocity": speed,
                "acceleration": speed / horizon * rng.uniform(3.0, 30.0),
            }
            _state_some(rng, limits, joint.name, wanted, (0.5, 0.4, 0.3))
    for drive in plant.drives:
        wanted = {
            "control": about_zero(rng, drive.control),
            "control_rate": drive.control / horizon * rng.uniform(2.0, 40.0),
            "force": about_zero(rng, drive.force),
        }
        _state_some(rng, limits, drive.name, wanted, (0.4, 0.3, 0.3))
    if rng.random() < 0.15:
        limits["bandwidth"] = rng.uniform(2.0, 6.0) / horizon
    return limits


def _state_some(
    rng: Rng,
    limits: Tables,
    name: str,
    wanted: Tables,
    chances: tuple[float, ...],
) -> None:
    for (kind, value), chance in zip(wanted.items(), chances, strict=True):
        if rng.random() < chance:
            stated = value if isinstance(value, tuple) else float(value)
            limits.setdefault(kind, {})[name] = stated


def _boundary(rng: Rng, plant: Plant) -> Tables:
    """A random boundary; most problems state none."""
    boundary = {"position": 0.01, "velocity": 0.02}
    if not plant.can_rest and rng.random() < 0.9:
        return boundary
    if rng.random() < 0.3:
        boundary["start"] = "rest"
    return {**boundary, "end": str(rng.choice(["free", "free", "free", "rest", "periodic"]))}


def _control(rng: Rng, plant: Plant, horizon: float) -> Tables:
    """A random initial control."""
    size = rng.choice([0.01, 0.1, 0.5])
    return {
        "kind": str(rng.choice(["sine", "chirp", "multisine"])),
        "amplitude": {drive.name: size * drive.control for drive in plant.drives} or 1.0,
        "frequency": rng.uniform(0.5, 3.0) / horizon,
    }


def complicate(rng: Rng, plant: Plant, tables: Tables) -> None:
    """Add to the tables what only mechanisms have, or what chains do not state."""
    limits, horizon = tables["limits"], tables["horizon"]
    tables["initial"]["keyframe"] = "start"

    # A control without a range needs a weight.
    bounded = {*limits.get("control", {}), *(n for k, n in plant.ranges if k == "control")}
    weights = {
        drive.name: 0.0 if drive.name in bounded else 1e-3 / drive.control**2
        for drive in plant.drives
    }
    tables["cost"]["control"] = weights or 0.0

    for joint in plant.joints:
        if joint.is_scalar:
            continue
        speed = joint.reach / horizon
        size = joint.reach * rng.uniform(0.5, 2.0)
        box = tuple(about_zero(rng, size) for _ in PLACE)
        wanted = {
            "position": box if joint.kind == "free" else (0.0, rng.uniform(0.4, 2.0)),
            "velocity": speed * rng.uniform(0.5, 5.0),
            "acceleration": speed / horizon * rng.uniform(5.0, 50.0),
            "angular_velocity": rng.uniform(0.5, 5.0) / horizon,
            "tilt": rng.uniform(0.3, 1.5),
        }
        _state_some(rng, limits, joint.name, wanted, (0.4, 0.3, 0.2, 0.3, 0.4))

    for kind, power in (("velocity", 1), ("acceleration", 2)):
        if rng.random() < 0.15:
            fastest = max(joint.reach for joint in plant.joints) / horizon**power
            limits[kind] = fastest * rng.uniform(3.0, 30.0)
    if plant.collides and rng.random() < 0.6:
        shortest = min(joint.length for joint in plant.joints)
        limits["clearance"] = shortest * rng.uniform(0.001, 0.1)
        if len(plant.joints) > 2 and rng.random() < 0.3:
            limits["ignored"] = (("link0", "link2"),)

    if rng.random() < 0.15:
        tables["descent"] |= pick(rng, ({"fourier": (1.0 / horizon,)}, {"repeats": (2,)}))
    if rng.random() < 0.1:
        for parameter in tables["parameters"].values():
            parameter["prior"] = 1e-3
        tables["robust"] = {"over": str(rng.choice(["mean", "worst"])), "samples": 2}


def describe(plant: Plant, tables: Tables) -> str:
    """Describe a problem in a line."""
    boundary = tables["boundary"]
    words = [*plant.features, f"{boundary.get('start', 'given')} to {boundary.get('end', 'free')}"]
    words += [key for key in ("fourier", "repeats") if key in tables["descent"]]
    words += ["robust"] if "robust" in tables else []
    kinds = {kind for kind, _ in all_ranges(plant, tables)}
    return "; ".join([*words, f"limits on {', '.join(sorted(kinds))}"])
