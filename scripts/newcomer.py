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
from collections.abc import Iterator, Mapping, Sequence
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

# Excess beyond a limit that rounding explains, as a fraction of half of the range.
ROUNDING = 1e-6

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
    with np.load(folder / "design" / "design.npz") as arrays:
        names = ("t", "qpos", "qvel", "act", "ctrl", "gain")
        trajectory = {name: arrays[name] for name in names}
    found.violations = violations(model, trajectory, stated.get("limits", {}))

    rehearsal = design["rehearsal"]
    if rehearsal is None:
        return
    found.safe = bool(rehearsal["safe"])
    found.kept = rehearsal["all_limits_kept"] / max(rehearsal["robots"], 1)
    broken = 0
    play = {"each_step": False, "feedback": rehearsal["feedback"]}
    rng = np.random.default_rng(37)
    for _ in range(ROBOTS):
        robot = system.model_at(_physical(system, WRONG, rng))
        left = violations(robot, trajectory, stated.get("limits", {}), **play)
        # A robot that reaches a clamp leaves no limit, and the rehearsal counts it apart.
        broken += any(not each.startswith("force") for each in left)
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


def violations(
    model: Any,
    trajectory: Mapping[str, np.ndarray],
    stated: Mapping[str, Any],
    *,
    each_step: bool = True,
    feedback: bool = False,
) -> list[str]:
    """Play a design in plain MuJoCo, and describe each range that it leaves.

    Forces are those that the actuators ask for: a copy of the model without the clamps of forces
    shows them in the states of the untouched model.

    Args:
        model: The untouched model (`mujoco.MjModel`).
        trajectory: t, qpos, qvel, act, ctrl and, for feedback, gain of design.npz.
        stated: Table `limits` of the experiment file: ranges of controls and velocities by name.
        each_step: Whether to look at every engine step, and not only whenever a control begins.
        feedback: Whether the gains pull the robot to the designed motion.

    Returns:
        One sentence for each range.
    """
    unclamped = copy.copy(model)
    unclamped.actuator_forcelimited[:] = 0
    unclamped.jnt_actfrclimited[:] = 0
    unclamped.tendon_actfrclimited[:] = 0
    data, shown = mujoco.MjData(model), mujoco.MjData(unclamped)
    data.qpos[:], data.qvel[:], data.act[:] = (
        trajectory[name][0] for name in ("qpos", "qvel", "act")
    )
    times, worst = trajectory["t"], dict[str, tuple[float, float]]()

    def look() -> None:
        """Compare the present state with all limits."""
        shown.qpos[:], shown.qvel[:], shown.act[:] = data.qpos, data.qvel, data.act
        shown.ctrl[:] = data.ctrl
        mujoco.mj_forward(unclamped, shown)
        for name, value, ends in _quantities(model, data, shown, stated):
            if ends is None:
                continue
            least, most = ends
            excess = float(max(least - value, value - most) / (0.5 * (most - least)))
            if excess > worst.get(name, (ROUNDING, 0.0))[0] or np.isnan(excess):
                worst[name] = (excess, float(data.time))

    low, high = np.where(
        model.actuator_ctrllimited, model.actuator_ctrlrange.T, [[-np.inf], [np.inf]]
    )
    ahead = np.zeros(model.nv)
    for k, ctrl in enumerate(trajectory["ctrl"]):
        data.ctrl[:] = ctrl
        if feedback:
            planned = {name: trajectory[name][k] for name in ("qpos", "qvel", "act")}
            mujoco.mj_differentiatePos(model, ahead, 1.0, data.qpos, planned["qpos"])
            behind = [ahead, planned["qvel"] - data.qvel, planned["act"] - data.act]
            data.ctrl[:] = np.clip(ctrl + trajectory["gain"][k] @ np.concatenate(behind), low, high)
        steps = round((times[k + 1] - times[k]) / model.opt.timestep)
        look()
        for _ in range(steps):
            mujoco.mj_step(model, data)
            if each_step:
                look()
    look()
    return [
        f"{name} by {100.0 * excess:.3g} % of half its range at {moment:.3g} s"
        for name, (excess, moment) in worst.items()
    ]


def _quantities(
    model: Any, data: Any, shown: Any, stated: Mapping[str, Any]
) -> Iterator[tuple[str, float, Any]]:
    """Name, value and range of what may be limited, in the present state of a simulation.

    Args:
        model: The model.
        data: The simulation, with positions, velocities and controls.
        shown: The same without the clamps of forces, with forces and lengths.
        stated: Table `limits` of the experiment file.

    Yields:
        The range is None where there is no limit.
    """

    def bound(kind: str, name: str, default: Any = None) -> Any:
        """The stated range of a kind, which may be that of all names or that of the magnitude."""
        found = stated.get(kind, {})
        value = found.get(name) if isinstance(found, dict) else found
        if value is None:
            return default
        return value if isinstance(value, list) else (-value, value)

    for i in range(model.njnt):
        name, kind = model.joint(i).name or f"joint{i}", mujoco.mjtJoint(model.jnt_type[i])
        q, v = int(model.jnt_qposadr[i]), int(model.jnt_dofadr[i])
        range_ = model.jnt_range[i] if model.jnt_limited[i] else None
        if kind == mujoco.mjtJoint.mjJNT_BALL:
            w, *xyz = data.qpos[q : q + 4]
            angle = 2.0 * np.arctan2(np.linalg.norm(xyz), abs(w))
            yield f"angle of {name}", angle, None if range_ is None else (-range_[1], range_[1])
        elif kind == mujoco.mjtJoint.mjJNT_FREE:
            boxes = bound("position", name, ())
            for axis, position, ends in zip("xyz", data.qpos[q : q + 3], boxes, strict=False):
                yield f"{axis} of {name}", position, ends

            # The angle between the upward axes of the body, now and in the reference position.
            turned, upright = np.zeros((2, 3))
            mujoco.mju_rotVecQuat(turned, (0.0, 0.0, 1.0), data.qpos[q + 3 : q + 7])
            mujoco.mju_rotVecQuat(upright, (0.0, 0.0, 1.0), model.qpos0[q + 3 : q + 7])
            for each, value in (
                ("velocity", np.linalg.norm(data.qvel[v : v + 3])),
                ("angular_velocity", np.linalg.norm(data.qvel[v + 3 : v + 6])),
                ("tilt", np.arccos(np.clip(turned @ upright, -1.0, 1.0))),
            ):
                yield f"{each} of {name}", float(value), bound(each, name)
        else:
            yield f"position of {name}", data.qpos[q], bound("position", name, range_)
            clamp = model.jnt_actfrcrange[i] if model.jnt_actfrclimited[i] else None
            yield f"force at {name}", shown.qfrc_actuator[v], clamp
            yield f"velocity of {name}", data.qvel[v], bound("velocity", name)

    on_tendon = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_TENDON)
    for i in range(model.ntendon):
        name = model.tendon(i).name or str(i)
        if model.tendon_limited[i]:
            ends = bound("tendon_length", name, model.tendon_range[i])
            yield f"length of {name}", shown.ten_length[i], ends
        if model.tendon_actfrclimited[i]:
            outputs = model.actuator_outadr[on_tendon & (model.actuator_trnid[:, 0] == i)]
            force = shown.actuator_force[outputs] @ model.actuator_gear[outputs, 0]
            yield f"force on {name}", force, model.tendon_actfrcrange[i]

    for i in range(model.nactuator):
        name = model.actuator(i).name or str(i)
        control, output = int(model.actuator_ctrladr[i]), int(model.actuator_outadr[i])
        if model.actuator_forcelimited[i] and int(model.actuator_outnum[i]) == 1:
            yield f"force of {name}", shown.actuator_force[output], model.actuator_forcerange[i]
        if model.actuator_ctrllimited[control]:
            yield f"control of {name}", data.ctrl[control], model.actuator_ctrlrange[control]
        yield f"control of {name}", data.ctrl[control], bound("control", name)


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
