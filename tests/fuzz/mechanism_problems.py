"""Random design problems on mechanisms: ball and free joints, contacts, tendons, closed loops."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mjfim.records.design import Design
from tests.fuzz.bad_inputs import pick
from tests.fuzz.mechanisms import Mechanism, random_mechanism
from tests.fuzz.outcome import Case, Outcome
from tests.fuzz.plants import Range, Rng, about_zero
from tests.fuzz.player import NEAREST, PLACE
from tests.fuzz.problems import SECONDS, Problem, attempt, narrowed, state_some


def run(case: Case, folder: Path) -> Outcome:
    """Design an experiment for a random mechanism, and judge what the design claims."""
    rng = case.rng
    mechanism = random_mechanism(rng)
    tables = random_tables(rng, mechanism)
    problem = Problem(
        xml=mechanism.xml,
        tables=tables,
        ranges=all_ranges(mechanism, tables),
        description=describe(mechanism, tables),
        ignored=tables["limits"].get("ignored", ()),
    )
    return attempt(case, folder, problem, lambda design: omissions(mechanism, design))


def omissions(mechanism: Mechanism, design: Design) -> list[str]:
    """Describe what a design does not keep and does not say either."""
    told = "\n".join(design.warnings)
    return [
        f"no warning names the range of {name}" for name in mechanism.unheld if name not in told
    ]


def all_ranges(mechanism: Mechanism, tables: dict[str, Any]) -> dict[tuple[str, str], Range]:
    """Range of every limit by kind and name: where MJCF and file state one, both hold."""
    joints = [link.name for link in mechanism.links]
    turning = [link.name for link in mechanism.links if not link.is_scalar]
    drives = [actuator.name for actuator in mechanism.actuators]
    owners = dict.fromkeys(("position", "velocity", "acceleration"), joints)
    owners |= dict.fromkeys(("tilt", "angular_velocity"), turning)

    stated: dict[str, dict[str, Any]] = {}
    for kind, value in tables["limits"].items():
        if kind in ("bandwidth", "clearance", "ignored"):
            continue
        whole = dict.fromkeys(owners.get(kind, drives), value)
        stated[kind] = by_coordinate(value) if isinstance(value, dict) else whole
    ranges = narrowed(mechanism.ranges, stated)

    if "clearance" in tables["limits"]:
        least = tables["limits"]["clearance"]
        ranges["clearance", NEAREST] = (least, 2.0 * least)
    boundary = tables["boundary"]
    if boundary.get("end", "free") != "free":
        parts = {"ball": (".rx", ".ry", ".rz"), "free": (".x", ".y", ".z", ".rx", ".ry", ".rz")}
        for link in mechanism.links:
            for part in parts.get(link.kind, ("",)):
                for kind in ("position", "velocity"):
                    bound = boundary[kind]
                    ranges[f"end_{kind}", f"{link.name}{part}"] = (-bound, bound)
    return ranges


def by_coordinate(stated: dict[str, Any]) -> dict[str, Any]:
    """A table in which the three ranges of a free joint have the names of its coordinates."""
    table = {}
    for name, value in stated.items():
        is_box = isinstance(value, tuple) and len(value) == len(PLACE)
        parts = zip(PLACE, value, strict=True) if is_box else [("", value)]
        table.update({f"{name}{part}": each for part, each in parts})
    return table


def random_tables(rng: Rng, mechanism: Mechanism) -> dict[str, Any]:
    """Tables of a random experiment file for a mechanism."""
    substeps = int(rng.choice([1, 2, 4, 5]))
    sample = substeps * mechanism.timestep
    horizon = int(rng.integers(15, 40)) * sample

    count = min(int(rng.integers(1, 3)), len(mechanism.targets))
    chosen = rng.choice(mechanism.targets, count, replace=False).tolist()
    limits = _limits(rng, mechanism, horizon)
    bounded = {*limits.get("control", {}), *(n for k, n in mechanism.ranges if k == "control")}

    # A control without a range needs a weight.
    weights = {
        actuator.name: 0.0 if actuator.name in bounded else 1e-3 / actuator.control**2
        for actuator in mechanism.actuators
    }
    tables: dict[str, Any] = {
        "model": "plant.xml",
        "rate": 1.0 / sample,
        "horizon": horizon,
        "parameters": {f"p{i}": {"target": target} for i, target in enumerate(chosen)},
        "noise": {"state": 0.01},
        "limits": limits,
        "cost": {"control": weights or 0.0, "criterion": str(rng.choice(["E", "A", "D"]))},
        "boundary": _boundary(rng, mechanism),
        "initial": {"keyframe": "start", "control": _control(rng, mechanism, horizon)},
        "descent": {
            "max_iterations": int(rng.integers(3, 10)),
            "seconds": SECONDS,
            "starts": int(rng.choice([1, 1, 1, 2])),
        },
    }
    if substeps > 1 and rng.random() < 0.3:
        tables["playback_rate"] = 1.0 / mechanism.timestep
    if rng.random() < 0.15:
        tables["descent"] |= pick(rng, ({"fourier": (1.0 / horizon,)}, {"repeats": (2,)}))
    if rng.random() < 0.1:
        for parameter in tables["parameters"].values():
            parameter["prior"] = 1e-3
        tables["robust"] = {"over": str(rng.choice(["mean", "worst"])), "samples": 2}
    _limit_in_space(rng, limits, mechanism, horizon)
    return tables


def _limit_in_space(rng: Rng, limits: dict[str, Any], mechanism: Mechanism, horizon: float) -> None:
    """Add random limits of ball and free joints; some are stated by one number for all."""
    for link in (link for link in mechanism.links if not link.is_scalar):
        is_free, speed = link.kind == "free", link.reach / horizon
        size = link.reach * rng.uniform(0.5, 2.0)
        box = tuple(about_zero(rng, size) for _ in PLACE)
        wanted = {
            "position": box if is_free else (0.0, float(rng.uniform(0.4, 2.0))),
            "velocity": speed * rng.uniform(0.5, 5.0),
            "acceleration": speed / horizon * rng.uniform(5.0, 50.0),
            "angular_velocity": rng.uniform(0.5, 5.0) / horizon,
            "tilt": rng.uniform(0.3, 1.5),
        }
        state_some(rng, limits, link.name, wanted, (0.4, 0.3, 0.2, 0.3, 0.4))


def _limits(rng: Rng, mechanism: Mechanism, horizon: float) -> dict[str, Any]:
    """Random limits: by name, or one number for all names."""
    limits: dict[str, Any] = {}
    for link in mechanism.links:
        speed = link.reach / horizon * rng.uniform(0.5, 5.0)
        wanted = {
            "position": about_zero(rng, link.reach * rng.choice([1.0, 0.3]), 0.3),
            "velocity": speed,
            "acceleration": speed / horizon * rng.uniform(5.0, 50.0),
        }
        if link.is_scalar:
            state_some(rng, limits, link.name, wanted, (0.5, 0.3, 0.2))
    for actuator in mechanism.actuators:
        wanted = {
            "control": about_zero(rng, actuator.control),
            "control_rate": actuator.control / horizon * rng.uniform(5.0, 40.0),
            "force": about_zero(rng, actuator.force),
        }
        state_some(rng, limits, actuator.name, wanted, (0.4, 0.2, 0.3))

    # One number holds for all joints to which such a limit applies.
    for kind, power in (("velocity", 1), ("acceleration", 2)):
        if rng.random() < 0.15:
            fastest = max(link.reach for link in mechanism.links) / horizon**power
            limits[kind] = float(fastest * rng.uniform(3.0, 30.0))
    if mechanism.collides and rng.random() < 0.6:
        shortest = min(link.length for link in mechanism.links)
        limits["clearance"] = float(shortest * rng.uniform(0.001, 0.1))
        if len(mechanism.links) > 2 and rng.random() < 0.3:
            limits["ignored"] = (("link0", "link2"),)
    if rng.random() < 0.1:
        limits["bandwidth"] = float(rng.uniform(2.0, 5.0)) / horizon
    return limits


def _boundary(rng: Rng, mechanism: Mechanism) -> dict[str, Any]:
    """A random boundary; most problems state none."""
    boundary: dict[str, Any] = {"position": 0.01, "velocity": 0.02}
    if not mechanism.can_rest and rng.random() < 0.9:
        return boundary
    if rng.random() < 0.2:
        boundary["start"] = "rest"
    return {**boundary, "end": str(rng.choice(["free", "free", "free", "rest", "periodic"]))}


def _control(rng: Rng, mechanism: Mechanism, horizon: float) -> dict[str, Any]:
    """A random initial control, small or of the size of the range."""
    size = float(rng.choice([0.01, 0.1, 0.3]))
    amplitude = {a.name: size * a.control for a in mechanism.actuators}
    return {
        "kind": str(rng.choice(["sine", "chirp", "multisine"])),
        "amplitude": amplitude or 1.0,
        "frequency": float(rng.uniform(0.5, 3.0)) / horizon,
    }


def describe(mechanism: Mechanism, tables: dict[str, Any]) -> str:
    """Describe a problem in a line."""
    boundary = tables["boundary"]
    ends = f"{boundary.get('start', 'given')} to {boundary.get('end', 'free')}"
    words = [*mechanism.features, ends, f"limits on {', '.join(sorted(tables['limits']))}"]
    words += [key for key in ("fourier", "repeats") if key in tables["descent"]]
    if "robust" in tables:
        words.append("robust")
    return "; ".join(words)
