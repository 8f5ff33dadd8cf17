"""The player as a file of its own: `player.py` of this package with a design filled in."""

from __future__ import annotations

import csv
import io
import math
from importlib.resources import files
from pathlib import Path
from pprint import pformat
from typing import Any

import numpy as np

from mjfim.files import replacing
from mjfim.model.coordinates import state_names
from mjfim.output.playback import GAIN_NOTE, design_columns
from mjfim.output.robots.plan import RobotPlan

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
    template = files("mjfim.output.robots").joinpath("player.py").read_text(encoding="utf-8")
    before, _, rest = template.partition(BEGIN)
    _, _, after = rest.partition(END)

    # Names of a model are arbitrary texts; they stand in the file as quoted literals only.
    settings = [
        f"{name} = {pformat(value, width=WIDTH)}" for name, value in _settings(plan).items()
    ]
    design = "\n".join([*settings, f'ROWS = """\n{_rows(plan)}"""'])
    with replacing(path) as temporary:
        temporary.write_text(f"{before}{BEGIN}\n\n{design}\n\n{END}{after}", encoding="utf-8")


def _settings(plan: RobotPlan) -> dict[str, Any]:
    """Names, sizes and limits, as the player describes them."""
    system, space, drives = plan.system, plan.system.space, plan.drives
    names = list(state_names(system.model))
    sigma = dict(zip(system.outputs.names, np.sqrt(np.diag(system.noise.covariance)), strict=True))

    # A servo keeps its last command, and a motor gets the control nearest to zero.
    safe = [
        math.nan if drive.holds_position else min(max(0.0, drive.lower), drive.upper)
        for drive in drives
    ]
    return {
        "NAME": plan.name,
        "GAINS": f"{GAIN_NOTE[0].upper()}{GAIN_NOTE[1:]}.",
        "STATE": names,
        "CONTROLS": list(system.controls),
        "SIZES": (space.nq, space.nv),
        "SCALARS": list(zip(space.scalar_q.tolist(), space.scalar_v.tolist(), strict=True)),
        "QUATERNIONS": list(space.quaternions),
        "SIGMA": [float(sigma.get(name, 0.0)) for name in names],
        "LOWER": [drive.lower for drive in drives],
        "UPPER": [drive.upper for drive in drives],
        "SAFE": safe,
    }


def _rows(plan: RobotPlan) -> str:
    """Lines of design.csv without the names and the note."""
    columns = design_columns(plan.playback, plan.system)
    values = np.column_stack([columns[name] for name in columns if not name.startswith("note:")])
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for row in values.tolist():
        writer.writerow(["" if math.isnan(value) else repr(value) for value in row])
    return text.getvalue()
