"""The text of a first experiment file: TOML with a comment for every choice."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import tomlkit
from tomlkit.items import InlineTable, Table

from mjfim.excitation.limits.limits import limits_of_model
from mjfim.model.limited_elements import QUATERNION_PLACE
from mjfim.model.paths import unit_of
from mjfim.studies.first_experiment.candidates import Candidate
from mjfim.studies.first_experiment.propose import Proposal

# Comments above tables and keys.
ABOVE = {
    "initial.control": ["The control from which a design starts."],
    "initial.free": [
        "Releases that a design may choose [m or rad]. A push is a velocity,",
        'for example "qvel:<joint>" = [-1.0, 1.0].',
    ],
    "nuisance": ["The error of the release is unknown; the fit reads it from each log."],
    "parameters": ["Unknown parameters. `mjfim list MODEL` lists every path."],
    "boundary": ['end = "rest" lets the motion also end at a standstill.'],
}

# Comments behind keys.
BEHIND = {
    "rate": "samples and controls [Hz]",
    "horizon": "duration of the experiment [s]",
    "cost.control": "the ranges bound the control; no weight is needed",
    "descent.seconds": "time budget of a design [s]; more gives better designs",
}


def experiment_text(proposal: Proposal) -> str:
    """The experiment file of a proposal."""
    model = proposal.compiled
    above = {**ABOVE, **_about(proposal)}
    behind = {
        **BEHIND,
        **{f"parameters.{each.name}": _meaning(model, each) for each in proposal.chosen},
    }
    document = tomlkit.document()
    for line in (
        f"A first experiment for {proposal.model}, proposed by `mjfim init`.",
        "Next: mjfim check FILE says what can be identified,",
        "mjfim design FILE -o DIR designs the motion that identifies it best.",
        "Check what only you know: the noise, the limits, and which parameters you do not trust.",
        *proposal.remarks,
    ):
        document.add(tomlkit.comment(line))

    for key, value in proposal.values().items():
        if isinstance(value, Mapping):
            document.add(key, _table(key, value, above, behind))
            continue
        entry = tomlkit.item(value)
        document.add(key, entry.comment(behind[key]) if key in behind else entry)
    _add_others(document["parameters"], proposal)
    return tomlkit.dumps(document).rstrip() + "\n"


def _about(proposal: Proposal) -> dict[str, list[str]]:
    """Comments about what is stated for this model."""
    model, start = proposal.compiled, proposal.start
    noise = [
        "Standard deviations of the measurements. To measure them, hold the robot still for 10 s,",
        "record, and take the standard deviation of each column.",
    ]
    if proposal.noise[0].stated:
        noise = ["Standard deviations of the sensors, as the MJCF states them."]

    initial = [f"The release, at rest, away from {start.reason}."]
    if proposal.release is None:
        initial = [f"The start: {start.reason}."]
        names = [model.key(i).name for i in range(model.nkey)]
        others = [name for name in names if name and name != start.keyframe]
        initial += [f"Other keyframes: {', '.join(others)}."] if others else []

    limits = []
    kinds = dict.fromkeys(limit.kind.replace("_", " ") for limit in limits_of_model(model))
    if kinds:
        limits = [
            f"The ranges of the MJCF always hold ({', '.join(kinds)}):",
            "`mjfim list MODEL --kind limits` shows them.",
        ]
    limits += [
        "Further limits: velocity, acceleration, control_rate, force, clearance,",
        "for example: velocity = 2.0",
    ]
    if any(kind in QUATERNION_PLACE for kind in model.jnt_type.tolist()):
        limits.append("Of free and ball joints also: tilt, angular_velocity, in radians.")
    return {"noise": noise, "initial": initial, "limits": limits}


def _table(
    place: str,
    values: Mapping[str, Any],
    above: Mapping[str, Sequence[str]],
    behind: Mapping[str, str],
) -> Table:
    """A table with its comments; tables in it stand in one line, except for the control."""
    table = tomlkit.table()
    for line in above.get(place, ()):
        table.add(tomlkit.comment(line))
    for key, value in values.items():
        name = f"{place}.{key}"
        if name == "initial.control":
            table.add(tomlkit.comment(above[name][0]))
            table.add(key, _table(name, value, {}, {}))
            continue
        for line in above.get(name, ()):
            table.add(tomlkit.comment(line))
        entry = tomlkit.item(_inline(value))
        table.add(key, entry.comment(behind[name]) if name in behind else entry)
    return table


def _inline(value: Any) -> Any:
    """A value whose tables are written in one line."""
    if isinstance(value, Mapping):
        table: InlineTable = tomlkit.inline_table()
        for key, entry in value.items():
            table.add(key, _inline(entry))
        return table
    if isinstance(value, list) and value and isinstance(value[0], Mapping):
        array = tomlkit.array()
        for entry in value:
            array.append(_inline(entry))
        return array
    return value


def _add_others(table: Any, proposal: Proposal) -> None:
    """Add the parameters that are not proposed as comments."""
    if not proposal.others:
        return
    table.add(tomlkit.nl())
    table.add(tomlkit.comment("Further parameters. Uncomment those that you do not trust;"))
    table.add(tomlkit.comment("`mjfim check` says which ones can be identified together."))
    for each in proposal.others:
        name, written = tomlkit.key(each.name).as_string(), _inline(each.table()).as_string()
        meaning = _meaning(proposal.compiled, each)
        table.add(tomlkit.comment(f"{name} = {written}  # {meaning}"))


def _meaning(model: Any, each: Candidate) -> str:
    """Meaning of a parameter, with its unit."""
    unit = unit_of(model, each.path)
    return f"{each.meaning} [{unit}]" if unit else each.meaning
