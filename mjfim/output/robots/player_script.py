"""The player as a file of its own: `player.py` of this package with a design filled in."""

from __future__ import annotations

import json
import math
from importlib.resources import files
from pathlib import Path

import numpy as np

from mjfim.files import replacing
from mjfim.model.coordinates import state_names
from mjfim.output.playback import GAIN_NOTE, design_columns
from mjfim.output.robots.plan import RobotPlan

# The text in the player that stands for the design.
PLACE = 'r"""{}"""'


def write_player(path: Path, plan: RobotPlan) -> None:
    """Write a stand-alone program that plays a design.

    Args:
        path: File to write.
        plan: The design.
    """
    system, space, drives = plan.system, plan.system.space, plan.drives
    names = list(state_names(system.model))
    sigma = dict(zip(system.outputs.names, np.sqrt(np.diag(system.noise.covariance)), strict=True))
    columns = design_columns(plan.playback, system)
    rows = np.column_stack([columns[name] for name in columns if not name.startswith("note:")])
    design = {
        "name": plan.name,
        "gains": f"{GAIN_NOTE[0].upper()}{GAIN_NOTE[1:]}.",
        "state": names,
        "controls": list(system.controls),
        "sizes": [space.nq, space.nv],
        "scalars": list(zip(space.scalar_q.tolist(), space.scalar_v.tolist(), strict=True)),
        "quaternions": list(space.quaternions),
        "sigma": [float(sigma.get(name, 0.0)) for name in names],
        "lower": [drive.lower for drive in drives],
        "upper": [drive.upper for drive in drives],
        # A servo keeps its last command, and a motor gets the control nearest to zero.
        "safe": [
            math.nan if drive.holds_position else min(max(0.0, drive.lower), drive.upper)
            for drive in drives
        ],
    }

    # Names of a model are arbitrary texts, in which JSON escapes every quotation mark.
    head = ",\n".join(f'  "{key}": {json.dumps(value)}' for key, value in design.items())
    text = ",\n".join(json.dumps(row) for row in rows.tolist())
    template = files("mjfim.output.robots").joinpath("player.py").read_text(encoding="utf-8")
    program = template.replace(PLACE, f'r"""{{\n{head},\n  "rows": [\n{text}\n]}}"""', 1)
    with replacing(path) as temporary:
        temporary.write_text(program, encoding="utf-8")
