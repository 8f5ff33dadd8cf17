"""Walk from model files to identified parameters by the command line, as a new user does.

    python -m scripts.newcomer MODEL.xml MODEL.urdf -o out/newcomer

For each model, in a folder of its own and without an edit: `mjfim init`, `check`, `design`,
`simulate` of a robot whose parameters differ from those of the model, and `identify` from that
recording, which begins with the values of the model. The claims of `design` are judged by plain
MuJoCo: that all limits hold on the model at every engine step, and what its rehearsal says of
robots whose parameters differ. Its standard deviations are judged by fits of simulated recordings.
The result is a table in Markdown (stdout) and newcomer.json.
"""

from __future__ import annotations

import copy
import json
import subprocess
import sys
import time
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import tomlkit

import mjfim
from mjfim.experiment.system import System
from mjfim.files import read_json
from mjfim.model.parameter_writer import ParameterWriter
from scripts.benchmarks.child import ROOT, options_of
from scripts.verbs import call_verb
from tests.fuzz.player import ROUNDING_WITH_FEEDBACK as ROUNDING
from tests.fuzz.player import Layout, Ranges, Row, play, read_rows, stated_ranges

# Largest difference between the parameters of the simulated robot and those of the model, over
# their sizes.
DIFFERENCE = 0.1

# Number of robots that play a design in plain MuJoCo, and largest relative error of a parameter.
ROBOTS, WRONG = 300, 0.2

# Number of draws of a robot after which its errors are halved.
TRIES = 100

# Share of the robots that may leave a limit in a motion that is safe.
MAX_BROKEN = 0.05

# Number of fits that judge the standard deviations, in parts of FITS_PART; no new part begins after
# FITS_TIME [s]. A standard deviation agrees where both differ by less than AGREEMENT.
FITS, FITS_PART, FITS_TIME = 200, 50, 120.0
AGREEMENT = 0.3

# Longest time of one verb; none should come near to it [s].
PATIENCE = 600.0

# Kinds of limits that MuJoCo keeps by clamps.
FORCES = ("force", "joint_force", "tendon_force")

# Files in the folder of a model.
EXPERIMENT, ROBOT, LOG = "first.toml", "robot.toml", "log.csv"

VERBS = ("init", "check", "design", "simulate", "identify")


@dataclass(kw_only=True)
class Walk:
    """Outcome of all verbs for one model.

    Attributes:
        model: Name of the model.
        edits: Edits of the experiment file that were needed; this script makes none.
        codes: Exit codes by verb; None where a verb did not end in time.
        seconds: Duration by verb, with the start of Python and the pictures [s].
        messages: Last line on stderr of the verbs with another exit code than 0.
        gain: Smallest eigenvalue of the information, designed over initial; None without a design.
        feasible_start: Whether the initial control keeps all limits.
        claimed: Whether `design` says that all limits hold.
        violations: What plain MuJoCo finds beyond its limit in the design.
        safe: Whether the rehearsal of `design` calls the motion safe.
        kept: Share of the robots of the rehearsal that keep all limits.
        kept_in_mujoco: The same share of robots in plain MuJoCo.
        fits: Number of fits of simulated recordings that succeeded.
        agree: Parameters whose scatter over these fits agrees with the stated standard deviation.
        stated: Parameters with a finite stated standard deviation.
        inside: Number of true parameters inside their 95 % intervals.
        parameters: Number of parameters.
    """

    model: str
    edits: int = 0
    codes: dict[str, int | None] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    messages: dict[str, str] = field(default_factory=dict)
    gain: float | None = None
    feasible_start: bool | None = None
    claimed: bool | None = None
    violations: list[str] = field(default_factory=list)
    safe: bool | None = None
    kept: float | None = None
    kept_in_mujoco: float | None = None
    fits: int = 0
    agree: int | None = None
    stated: int | None = None
    inside: int | None = None
    parameters: int | None = None

    def row(self) -> list[str]:
        """Cells of the table."""
        verbs = []
        for verb in ("init", "check", "design", "identify"):
            code = self.codes.get(verb, "—")
            time_of = f" ({self.seconds[verb]:.0f} s)" if verb in self.codes else ""
            verbs.append(f"{'no end' if code is None else code}{time_of}")
        limits = ["—", "—"]
        if self.claimed is not None:
            limits = ["yes", "yes, not claimed"]
            if self.violations:
                limits = [f"no: {self.violations[0]}", "not claimed"]
        rehearsal = "—"
        if self.kept is not None and self.kept_in_mujoco is not None:
            shares = f"{100 * self.kept:.0f} % / {100 * self.kept_in_mujoco:.0f} %"
            rehearsal = f"{'safe' if self.safe else 'not safe'} ({shares})"
        # A start that breaks limits is no fair comparison.
        remark = "" if self.feasible_start else " (start breaks limits)"
        return [
            self.model,
            str(self.edits),
            *verbs,
            "—" if self.gain is None else f"{self.gain:.3g}{remark}",
            "—" if self.inside is None else f"{self.inside} of {self.parameters}",
            limits[0 if self.claimed else 1],
            rehearsal,
            "—" if self.agree is None else f"{self.agree} of {self.stated} ({self.fits} fits)",
        ]


HEADER = (
    "model | edits | init | check | design | identify | λ_min gain | within 95 % | limits held | "
    "rehearsal (robots that keep limits: said / MuJoCo) | σ agrees with fits"
)


def markdown(walks: Sequence[Walk]) -> str:
    """The table of all models."""
    rule = " | ".join(["---"] * len(HEADER.split(" | ")))
    rows = [HEADER, rule, *(" | ".join(walk.row()) for walk in walks)]
    return "".join(f"| {row} |\n" for row in rows)


def walk(model: Path, folder: Path) -> Walk:
    """Make all steps for one model.

    Args:
        model: The model file.
        folder: Fresh folder for the files.
    """
    folder.mkdir(parents=True)
    found = Walk(model=folder.name)
    if _run(found, folder, "init", str(model.resolve()), "-o", EXPERIMENT) != 0:
        return found
    _run(found, folder, "check", EXPERIMENT)
    if _run(found, folder, "design", EXPERIMENT, "-o", "design") not in (0, 1):
        return found
    experiment = mjfim.Experiment.from_file(folder / EXPERIMENT)
    system = System.resolve(experiment, threads=1)
    _judge_design(found, folder, system)
    _judge_deviations(found, experiment, mjfim.Design.load(folder / "design"))

    # The simulated robot has the same experiment with other true values. The unknown initial state
    # has no table; the robot begins as the model does.
    document = tomlkit.parse((folder / EXPERIMENT).read_text(encoding="utf-8"))
    moved = _physical(system, DIFFERENCE, np.random.default_rng(37)).tolist()
    tables: Any = document["parameters"]
    values = zip(system.parameters.names, moved, strict=True)
    robot = {name: value for name, value in values if name in tables}
    for name, value in robot.items():
        tables[name]["true"] = value
    (folder / ROBOT).write_text(tomlkit.dumps(document), encoding="utf-8")

    simulated = ("simulate", ROBOT, "design/design.npz", "-o", LOG)
    if _run(found, folder, *simulated) == 0:
        _run(found, folder, "identify", EXPERIMENT, LOG, "-o", "fit")
        file = folder / "fit" / "estimate.json"
        if file.is_file():
            # An interval without a finite end is null in JSON; it counts as missed.
            estimate = read_json(file)
            rows = zip(estimate["parameters"], estimate["interval"], strict=True)
            ends = [(robot[name], *interval) for name, interval in rows if name in robot]
            true, low, high = np.array(ends, dtype=float).T
            found.inside = int(((low <= true) & (true <= high)).sum())
            found.parameters = len(true)
    return found


def _run(found: Walk, folder: Path, verb: str, *words: str) -> int | None:
    """Call a verb as a user does; keep its output, exit code and duration."""
    variables = {"PYTHONPATH": str(ROOT)}
    begun = time.perf_counter()
    try:
        ended = call_verb([verb, *words], variables=variables, patience=PATIENCE, folder=folder)
    except subprocess.TimeoutExpired:
        code, said, result = None, f"no end after {PATIENCE:g} s", ""
    else:
        code, said, result = ended.returncode, ended.stderr, ended.stdout

    found.codes[verb] = code
    found.seconds[verb] = time.perf_counter() - begun
    (folder / f"{verb}.txt").write_text(f"{result}\n{said}", encoding="utf-8")
    if code != 0:
        told = [line for line in said.splitlines() if line.startswith("mjfim: ")]
        found.messages[verb] = (told or said.splitlines() or [""])[-1]
    return code


def _physical(system: System, wrong: float, rng: np.random.Generator) -> np.ndarray:
    """(p,) parameters of a robot whose bodies are physical, up to a share of the sizes off."""
    p = system.parameters
    reach = np.where(p.changes_model, wrong * p.sizes(system.theta), 0.0)
    while True:
        for _ in range(TRIES):
            error = reach * rng.uniform(-1.0, 1.0, len(p))
            theta = np.clip(system.theta + error, p.lower, p.upper)
            if not ParameterWriter(p).unphysical_bodies(system.plant.source, theta):
                return np.asarray(theta)
        reach = 0.5 * reach


def _judge_design(found: Walk, folder: Path, system: System) -> None:
    """Compare the design with its start, and its claim with plain MuJoCo."""
    design = read_json(folder / "design" / "design.json")
    smallest = [design[name]["eigenvalues"][0] for name in ("initial", "final")]
    found.gain = smallest[1] / smallest[0] if smallest[0] > 0.0 else None
    found.feasible_start = not design["limits"]["initial"]
    found.claimed = bool(design["limits"]["satisfied"])

    stated = tomllib.loads((folder / EXPERIMENT).read_text(encoding="utf-8"))
    model = mujoco.MjModel.from_xml_path(str(folder / stated["model"]))
    rows, ranges = read_rows(folder / "design" / "design.csv"), ranges_of(model, stated["limits"])
    found.violations = violations(model, rows, ranges)

    rehearsal = design["rehearsal"]
    if rehearsal is None:
        return
    found.safe = bool(rehearsal["safe"])
    found.kept = rehearsal["all_limits_kept"] / max(rehearsal["robots"], 1)
    # A robot that reaches a clamp leaves no limit, and the rehearsal counts it apart.
    ranges = {limit: ends for limit, ends in ranges.items() if limit[0] not in (*FORCES, "control")}
    broken = 0
    rng = np.random.default_rng(37)
    for _ in range(ROBOTS):
        robot = system.model_at(_physical(system, WRONG, rng))
        period = rows[1]["t"] - rows[0]["t"]
        left = play(robot, rows, ranges, period, rehearsal["feedback"])
        broken += bool(left.sentences(ROUNDING))
    found.kept_in_mujoco = 1.0 - broken / ROBOTS


def _judge_deviations(found: Walk, experiment: mjfim.Experiment, design: mjfim.Design) -> None:
    """Compare the stated standard deviations with the scatter of fits of simulated recordings."""
    estimates: list[np.ndarray] = []
    begun = time.perf_counter()
    for seed in range(FITS // FITS_PART):
        if time.perf_counter() - begun > FITS_TIME:
            break
        try:
            study = mjfim.monte_carlo(
                experiment,
                design.trajectory,
                trials=FITS_PART,
                seed=seed,
                threads=1,
                progress=False,
            )
        except mjfim.MjfimError as error:
            found.messages["fits"] = str(error)
            return
        estimates += [study.sets["final"].estimates]
    good = np.concatenate(estimates)
    good = good[np.isfinite(good).all(axis=1)]
    found.fits = len(good)
    scatter = dict(zip(study.parameters, good.std(axis=0, ddof=1).tolist(), strict=True))
    stated = dict(zip(design.parameters, design.stated_std.tolist(), strict=True))
    ratios = [scatter[name] / stated[name] for name in scatter if np.isfinite(stated[name])]
    found.stated = len(ratios)
    found.agree = sum(abs(ratio - 1.0) < AGREEMENT for ratio in ratios)


def violations(model: Any, rows: list[Row], ranges: Ranges) -> list[str]:
    """Play a design in plain MuJoCo, and describe each range that it leaves.

    Forces are those that the actuators ask for. A model without the clamps of forces shows them,
    and moves as the untouched one until a clamp acts.

    Args:
        model: The untouched model (`mujoco.MjModel`).
        rows: Rows of design.csv.
        ranges: Range by kind and name of every limit.
    """
    unclamped = copy.copy(model)
    unclamped.actuator_forcelimited[:] = 0
    unclamped.jnt_actfrclimited[:] = 0
    unclamped.tendon_actfrclimited[:] = 0
    forces = {limit: ends for limit, ends in ranges.items() if limit[0] in FORCES}
    period = rows[1]["t"] - rows[0]["t"]
    played = play(model, rows, ranges, period), play(unclamped, rows, forces, period)
    return [text for each in played for text in each.sentences(ROUNDING)]


def ranges_of(model: Any, stated: Mapping[str, Any]) -> Ranges:
    """Range of every limit by kind and name: that of the table `limits`, else that of the MJCF."""
    layout = Layout(model)
    ranges = stated_ranges(stated, layout.joints)
    for kind, names, field_name in (
        ("position", layout.joints, "jnt_"),
        ("joint_force", layout.joints, "jnt_actfrc"),
        ("tendon_length", layout.tendons, "tendon_"),
        ("tendon_force", layout.tendons, "tendon_actfrc"),
        ("control", layout.drives, "actuator_ctrl"),
        ("force", layout.actuators, "actuator_force"),
    ):
        for i in np.flatnonzero(getattr(model, f"{field_name}limited")):
            low, high = getattr(model, f"{field_name}range")[i].tolist()
            ranges.setdefault((kind, names[i]), (low, high))
    return ranges


def main() -> int:
    """Walk through all models, and print the table."""
    parser = options_of(__doc__)
    parser.add_argument("models", type=Path, nargs="+", metavar="MODEL", help="MJCF or URDF")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/newcomer"))
    options = parser.parse_args()

    walks = []
    for number, model in enumerate(options.models, start=1):
        name = f"{number}_{model.stem}"
        folder = options.output / name
        if folder.exists():
            parser.error(f"{folder} exists; every model needs a fresh folder")
        walks.append(walk(model, folder))
        print(f"{name}: {walks[-1].codes}", file=sys.stderr)
        record = json.dumps([asdict(each) for each in walks], indent=2, ensure_ascii=False)
        (options.output / "newcomer.json").write_text(record + "\n", encoding="utf-8")

    print(markdown(walks))

    # Every walk went to its end, and no claim was wrong.
    for each in walks:
        is_broken = each.kept_in_mujoco is not None and each.kept_in_mujoco <= 1 - 2 * MAX_BROKEN
        is_wrong = (each.claimed and each.violations) or (each.safe and is_broken)
        if is_wrong or any(each.codes.get(verb) not in (0, 1) for verb in VERBS):
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
