"""The player as a file of its own: `player.py` of this package with a design filled in."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from pprint import pformat
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.files import replacing
from mjfim.model.coordinates import state_names, tangent_names
from mjfim.output.playback import GAIN_NOTE, design_columns
from mjfim.output.robot.plan import Drive, RobotPlan

# Lines of the player between which the design stands.
BEGIN = "# ---- the design, which `mjfim export` writes"
END = "# ---- end of the design"

# Longest line of the settings in the file [characters].
WIDTH = 100


def write_player(path: Path, plan: RobotPlan) -> None:
    """Write a stand-alone program that plays a design.

    Args:
        path: File to write.
        plan: The design.
    """
    with replacing(path) as temporary:
        temporary.write_text(player_source(plan), encoding="utf-8")


def player_source(plan: RobotPlan) -> str:
    """Source of the program that plays a design.

    Args:
        plan: The design.
    """
    template = files("mjfim.output.robot").joinpath("player.py").read_text(encoding="utf-8")
    before, _, rest = template.partition(BEGIN)
    _, _, after = rest.partition(END)

    # Names of a model are arbitrary texts; they stand in the file as quoted literals only.
    note = _literal(_sentences(GAIN_NOTE))
    settings = pformat(_settings(plan), width=WIDTH, sort_dicts=False)
    rows = "\n".join(f"    {_literal(row)}," for row in _rows(plan))
    design = f"GAINS = {note}\nSETTINGS = {settings}\nROWS = [\n{rows}\n]"
    return f"{before}{BEGIN}\n\n{design}\n\n{END}{after}"


def _literal(text: str) -> str:
    """A text as a literal of Python."""
    return repr(text)


def _sentences(note: str) -> str:
    """The note as sentences."""
    return f"{note[0].upper()}{note[1:]}."


def _settings(plan: RobotPlan) -> Mapping[str, Any]:
    """Names, sizes and limits; None stands for no limit, and for the last control."""
    space = plan.system.space
    sigma = dict(zip(plan.system.outputs.names, _sigma(plan).tolist(), strict=True))
    scalars = zip(space.scalar_q.tolist(), space.scalar_v.tolist(), strict=True)
    return {
        "name": plan.name,
        "controls": list(plan.system.controls),
        "state": list(state_names(plan.system.model)),
        "sigma": [sigma.get(name) for name in state_names(plan.system.model)],
        "deviation": list(tangent_names(plan.system.model)),
        "sizes": [space.nq, space.nv, space.na],
        "scalars": [list(pair) for pair in scalars],
        "quaternions": [list(pair) for pair in space.quaternions],
        "lower": [_finite(drive.lower) for drive in plan.drives],
        "upper": [_finite(drive.upper) for drive in plan.drives],
        "safe": [_safe(drive) for drive in plan.drives],
    }


def _sigma(plan: RobotPlan) -> Array:
    """(ny,) standard deviations of the outputs [output unit]."""
    return np.asarray(np.sqrt(np.diag(plan.system.noise.covariance)))


def _finite(value: float) -> float | None:
    """A finite number, or None."""
    return value if math.isfinite(value) else None


def _safe(drive: Drive) -> float | None:
    """Control at the end: the last one where it is a position, else the one nearest to zero."""
    return None if drive.holds_position else min(max(0.0, drive.lower), drive.upper)


def _rows(plan: RobotPlan) -> Sequence[str]:
    """Lines of design.csv without the note."""
    columns = design_columns(plan.playback, plan.system)
    names = [name for name in columns if not name.startswith("note:")]
    values: Array = np.column_stack([columns[name] for name in names])

    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    for row in values.tolist():
        writer.writerow(["" if math.isnan(value) else repr(value) for value in row])
    return text.getvalue().splitlines()
