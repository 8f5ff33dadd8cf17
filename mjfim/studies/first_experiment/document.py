"""The text of a first experiment file: TOML with a comment for every choice."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import tomlkit
from tomlkit.items import InlineTable, Table

from mjfim.excitation.limits import limits_of_model
from mjfim.model.orientation import QUATERNION_PLACE
from mjfim.model.paths import unit_of
from mjfim.studies.first_experiment.candidates import Candidate
from mjfim.studies.first_experiment.propose import SECONDS, Proposal

# How to measure noise.
HOW_TO_MEASURE = (
    "Standard deviations of the measurements. To measure them, hold the robot still for 10 s,",
    "record, and take the standard deviation of each column.",
)


def experiment_text(proposal: Proposal) -> str:
    """The experiment file of a proposal.

    Args:
        proposal: The proposal.

    Returns:
        TOML text that `Experiment.from_file` reads.
    """
    document = tomlkit.document()
    for line in _head(proposal):
        document.add(tomlkit.comment(line))

    values = proposal.values()
    document.add("model", values["model"])
    document.add("rate", _commented(values["rate"], "samples and controls [Hz]"))
    document.add("horizon", _commented(values["horizon"], "duration of the experiment [s]"))
    document.add(tomlkit.nl())

    document.add("initial", _initial(proposal, values["initial"]))
    document.add("parameters", _parameters(proposal))
    document.add("noise", _noise(proposal))
    if proposal.release is not None:
        document.add("nuisance", _nuisance(values["nuisance"]))
    document.add("limits", _limits(proposal, values.get("limits", {})))
    if proposal.rest:
        document.add("boundary", _boundary())
    if proposal.release is None:
        document.add("cost", _cost())
    document.add("descent", _descent())
    return tomlkit.dumps(document).rstrip() + "\n"


def _head(proposal: Proposal) -> Sequence[str]:
    """Lines at the head of the file."""
    return (
        f"A first experiment for {proposal.model}, proposed by `mjfim init`.",
        "Next: mjfim check FILE says what can be identified,",
        "mjfim design FILE -o DIR designs the motion that identifies it best.",
        "Check what only you know: the noise, the limits, and which parameters you do not trust.",
        *proposal.remarks,
    )


def _commented(value: Any, comment: str) -> Any:
    """A value with a comment behind it."""
    return tomlkit.item(value).comment(comment)


def _inline(values: Mapping[str, Any]) -> InlineTable:
    """A table in one line."""
    table = tomlkit.inline_table()
    for key, value in values.items():
        table.add(key, _plain(value))
    return table


def _plain(value: Any) -> Any:
    """A value whose tables are written in one line."""
    if isinstance(value, Mapping):
        return _inline(value)
    if isinstance(value, list) and value and isinstance(value[0], Mapping):
        array: Any = tomlkit.array()
        for entry in value:
            array.append(_inline(entry))
        return array
    return value


def _initial(proposal: Proposal, values: Mapping[str, Any]) -> Table:
    """Initial state and control."""
    table = tomlkit.table()
    start = proposal.start
    if proposal.release is not None:
        return _release(proposal, values)
    table.add(tomlkit.comment(f"The start: {start.reason}."))
    others = [
        name
        for name in (proposal.compiled.key(i).name for i in range(proposal.compiled.nkey))
        if name and name != start.keyframe
    ]
    if others:
        table.add(tomlkit.comment(f"Other keyframes: {', '.join(others)}."))

    for key in ("keyframe", "qpos", "act"):
        if key in values:
            table.add(key, values[key])

    table.add(tomlkit.comment("The control from which a design starts."))
    control = tomlkit.table()
    for key, value in values["control"].items():
        control.add(key, _plain(value))
    table.add("control", control)
    return table


def _release(proposal: Proposal, values: Mapping[str, Any]) -> Table:
    """Release of a model without actuators."""
    table = tomlkit.table()
    table.add(tomlkit.comment(f"The release, at rest, away from {proposal.start.reason}."))
    table.add("qpos", values["qpos"])
    table.add(
        tomlkit.comment("Releases that a design may choose [m or rad]. A push is a velocity,")
    )
    table.add(tomlkit.comment('for example "qvel:<joint>" = [-1.0, 1.0].'))
    table.add("free", _inline(values["free"]))
    return table


def _nuisance(values: Mapping[str, Any]) -> Table:
    """Errors of the release."""
    table = tomlkit.table()
    table.add(
        tomlkit.comment("The error of the release is unknown; the fit reads it from each log.")
    )
    table.add("initial", _inline(values["initial"]))
    return table


def _parameters(proposal: Proposal) -> Table:
    """The unknown parameters; the others as comments."""
    table = tomlkit.table()
    table.add(tomlkit.comment("Unknown parameters. `mjfim list MODEL` lists every path."))
    for each in proposal.chosen:
        entry = _inline(each.table())
        entry.comment(_meaning(proposal, each))
        table.add(each.name, entry)

    if proposal.others:
        table.add(tomlkit.nl())
        table.add(tomlkit.comment("Further parameters. Uncomment those that you do not trust;"))
        table.add(tomlkit.comment("`mjfim check` says which ones can be identified together."))
        for each in proposal.others:
            name = tomlkit.key(each.name).as_string()
            written = _inline(each.table()).as_string()
            table.add(tomlkit.comment(f"{name} = {written}  # {_meaning(proposal, each)}"))
    return table


def _meaning(proposal: Proposal, each: Candidate) -> str:
    """Meaning of a parameter, with its unit."""
    unit = unit_of(proposal.compiled, each.path)
    return f"{each.meaning} [{unit}]" if unit else each.meaning


def _noise(proposal: Proposal) -> Table:
    """The noise table."""
    table = tomlkit.table()
    if proposal.noise[0].stated:
        table.add(tomlkit.comment("Standard deviations of the sensors, as the MJCF states them."))
    else:
        for line in HOW_TO_MEASURE:
            table.add(tomlkit.comment(line))
    for each in proposal.noise:
        table.add(each.key, each.sigma)
    return table


def _limits(proposal: Proposal, stated: Mapping[str, Any]) -> Table:
    """Stated limits; those of the MJCF as comments."""
    model = proposal.compiled
    table = tomlkit.table()
    kinds = list(dict.fromkeys(limit.kind for limit in limits_of_model(model)))
    if kinds:
        names = ", ".join(kind.replace("_", " ") for kind in kinds)
        table.add(tomlkit.comment(f"The ranges of the MJCF always hold ({names}):"))
        table.add(tomlkit.comment("`mjfim list MODEL --kind limits` shows them."))
    table.add(
        tomlkit.comment("Further limits: velocity, acceleration, control_rate, force, clearance,")
    )
    table.add(tomlkit.comment("for example: velocity = 2.0"))
    if any(kind in QUATERNION_PLACE for kind in model.jnt_type.tolist()):
        table.add(
            tomlkit.comment("Of free and ball joints also: tilt, angular_velocity, in radians.")
        )
    for key, value in stated.items():
        table.add(key, _inline(value))
    return table


def _boundary() -> Table:
    """Beginning and end."""
    table = tomlkit.table()
    table.add(tomlkit.comment('end = "rest" lets the motion also end at a standstill.'))
    table.add("start", "rest")
    return table


def _cost() -> Table:
    """The cost."""
    table = tomlkit.table()
    table.add("control", _commented(0.0, "the ranges bound the control; no weight is needed"))
    return table


def _descent() -> Table:
    """The time budget."""
    table = tomlkit.table()
    table.add(
        "seconds", _commented(SECONDS, "time budget of a design [s]; more gives better designs")
    )
    return table
