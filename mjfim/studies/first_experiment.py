"""A first experiment for a model, without a question to the user, and the text of its file."""

from __future__ import annotations

import os
import warnings
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import tomlkit
from tomlkit.items import Table

from mjfim.arrays import Array, record, scaled_to_unit_diagonal
from mjfim.errors import (
    ExperimentError,
    MjfimError,
    ModelError,
    ModelWarning,
    SimulationDivergedError,
    first_ones,
    listed,
)
from mjfim.excitation.limits.limits import limits_of_model
from mjfim.excitation.limits.verification import verify, violations_of
from mjfim.excitation.task import DesignTask
from mjfim.experiment.arguments import checked
from mjfim.experiment.controls import MAX_SAMPLES
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.model.coordinates import joint_dofs
from mjfim.model.elements import position_sizes, unnamed_count
from mjfim.model.given import packed
from mjfim.model.limited_elements import QUATERNION_PLACE
from mjfim.model.loading import (
    ModelSource,
    packed_model,
    resolve_packages,
    silence_mujoco_log,
)
from mjfim.model.model_files import PackedFiles, is_urdf
from mjfim.model.paths import unit_of
from mjfim.plant.mixed_derivatives import CENTRAL_DIFFERENCES
from mjfim.studies.first_candidates import (
    Candidate,
    ProposedNoise,
    Wishes,
    candidates,
    proposed_noise,
    read_urdf,
    require_rate,
    rounded,
    servo_laws,
    stated_candidates,
)
from mjfim.studies.first_limits import playable_limits, played
from mjfim.studies.first_motion import (
    FIRST_SHARE,
    SHRINKING,
    TRIALS,
    ProposedRelease,
    Start,
    TimeScale,
    choose_start,
    driven_dofs,
    falling_bodies,
    first_amplitudes,
    influence_of_controls,
    propose_release,
    reach,
    require_support,
    time_scale,
    two_digits,
)

# First and last frequency of the chirp, in characteristic periods of the motion.
FIRST_FREQUENCY = 0.4
LAST_FREQUENCY = 2.0

# Limit of a control without a range, relative to the amplitude of the chirp.
CONTROL_LIMIT = 3.0

# Time budget of a design [s]. With the start of Python and the pictures, the verb takes less than a
# minute.
SECONDS = 30.0

# Share of half of a range that the first motion keeps away from the ends of forces and positions.
# Where a force is at its end, a small change of a parameter meets the clamp, and derivatives do not
# exist. A control may rest at the end of its range.
ROOM = 0.05
WITHOUT_ROOM = ("control",)

# Largest factor by which the first motion may amplify a small disturbance of its start, and the
# shortest horizon to which this leads [characteristic periods]. Robots that fall or that make and
# break contacts are predictable for a short time only.
LARGEST_AMPLIFICATION = 100.0
SHORTEST_MOTION = 0.5

# Number of disturbances of the start that are tried, and their size [sizes of the positions].
DISTURBANCES = 4
DISTURBANCE = 1e-4

# Shortest horizon of a robot that falls out of its limits [characteristic periods], and the share
# of the time until then that the horizon uses.
SHORTEST_FALL = 0.1
BEFORE_VIOLATION = 0.9

# Smallest share of the amplitudes with which an arm ends at rest, and the time over which its
# motion fades [characteristic periods].
SMALLEST_ENDED = 0.1
FADE = 1.0

# Factors by which each amplitude grows by itself, as long as the motion has room.
GROWTHS = (4.0, 4.0, 4.0, 2.0)

# Significant digits of the initial state: the loops of closed chains stay closed.
STATE_DIGITS = 9

# Boundary of an experiment that begins at rest.
AT_REST = {"start": "rest"}

# Begin of the remark about a start that cannot be used.
NO_MOTION = "no motion about this start keeps all limits"

# Begin of the remarks about what may make the experiment useless.
WARNING = "Warning: "

# Wishes of a user who has none.
NO_WISHES = Wishes()

# Largest number of candidates whose information is computed.
MOST_CANDIDATES = 24


@record
class Proposal:
    """Everything that a first experiment file states.

    Attributes:
        model: Path of the model file, relative to the experiment file.
        companion: MJCF to be written beside the experiment file with the name `model`, or None.
        source: The model.
        times: Rate and horizon.
        start: Initial state and resting control.
        amplitudes: Amplitudes of the chirp by actuator.
        chirp: First and last frequency of the chirp [Hz].
        noise: Noise of the outputs.
        chosen: Proposed parameters.
        others: Further parameters, for comments.
        limits: The table `[limits]`.
        boundary: The table `[boundary]`.
        remarks: Sentences for the head of the file.
        release: Release of a model without actuators; None for a model with actuators.
        flies: Whether a free body is held in the air.
        laws: Tables about laws of position servos that logs are to show; none for an experiment
            that is to be designed.
    """

    model: str
    companion: str | None
    source: ModelSource
    times: TimeScale
    start: Start
    amplitudes: dict[str, float]
    chirp: tuple[float, float]
    noise: Sequence[ProposedNoise]
    chosen: Sequence[Candidate]
    others: Sequence[Candidate]
    limits: dict[str, Any]
    boundary: Mapping[str, str] = field(default_factory=dict)
    remarks: Sequence[str] = ()
    release: ProposedRelease | None = None
    flies: bool = False
    laws: Mapping[str, Any] = field(default_factory=dict)

    @property
    def compiled(self) -> Any:
        """The compiled model."""
        return self.source.model

    def _initial_state(self) -> dict[str, Any]:
        """Keys of the table `[initial]` that state the initial state."""
        if self.release is not None:
            qpos, free = self.release
            ranges = {name: list(ends) for name, ends in free.items()}
            return {"qpos": qpos.tolist(), "free": ranges}
        if self.start.keyframe is not None:
            return {"keyframe": self.start.keyframe}
        state = {"qpos": [rounded(q, STATE_DIGITS) for q in self.start.qpos]}
        if self.start.act.any():
            state["act"] = [rounded(act, STATE_DIGITS) for act in self.start.act]
        return state

    def values(self) -> dict[str, Any]:
        """Keys and tables of the experiment file."""
        initial = self._initial_state()
        values: dict[str, Any] = {"model": self.model, "rate": self.times.rate}
        if not self.laws:
            values |= {"horizon": self.times.horizon, "initial": initial}
        values |= {
            **self.laws,
            "parameters": {each.name: each.table() for each in self.chosen},
            "noise": {key: sigma for key, sigma, _ in self.noise},
        }
        if self.laws:
            return values
        if self.release is None:
            initial["control"] = self.control()
        else:
            values["nuisance"] = {"initial": dict.fromkeys(self.release[1], True)}
        values["limits"] = {**self.limits, "reserve": "auto"}
        if self.boundary:
            values["boundary"] = self.boundary
        if self.release is None:
            values["cost"] = {"control": 0.0}
        if self.flies:
            values["rehearsal"] = {"feedback": True}
        values["descent"] = {"seconds": SECONDS}
        return values

    def control(self) -> dict[str, Any]:
        """The key `initial.control`."""
        control = {
            "kind": "chirp",
            "amplitude": self.amplitudes,
            "frequency": self.chirp[0],
            "frequency_end": self.chirp[1],
        }
        if "end" in self.boundary:
            control["fade"] = rounded(FADE * self.times.period)
        offset = dict(zip(self.amplitudes, self.start.control.tolist(), strict=True))
        if any(offset.values()):
            control["offset"] = offset
        return control


@checked
def propose(
    model: Any,
    unknown: Sequence[str] | Mapping[str, str] | None = None,
    *,
    payload: str | None = None,
    horizon: float | None = None,
) -> Experiment:
    """Propose a first experiment for a model, with the choices of `mjfim init`.

    Args:
        model: Path or text of an MJCF or URDF, an MjSpec, an MjModel, or a name of
            robot_descriptions.
        unknown: Paths of the unknown parameters, in which `*` stands for any text, or one path for
            each name. Default: what the first motion identifies together.
        payload: Body that carries a load of unknown mass and centre of mass.
        horizon: Duration of the experiment [s]; default: it suits the size of the robot.

    Returns:
        An experiment for `check`, `design` and `identify`; `replace` changes its choices.

    Raises:
        ModelError: The model cannot be read.
        ExperimentError: An argument is wrong, or nothing in the model can move or be identified.
    """
    name, files = packed(model, Path())
    path = Path(name)
    if horizon is not None and not 0.0 < horizon < np.inf:
        raise ExperimentError(f"propose: horizon: {horizon} s; it must be positive and finite")
    wishes = Wishes(unknown=unknown, payload=payload, horizon=horizon)
    proposal = propose_experiment(path, path.parent, wishes, files=files)
    for remark in proposal.remarks:
        if remark.startswith(WARNING):
            warnings.warn(f"{path}: {remark.removeprefix(WARNING)}", ModelWarning, stacklevel=3)
    values = {**proposal.values(), "directory": path.parent, "files": files}
    if proposal.companion is not None:
        values["model"] = proposal.source.spec
    return Experiment(**values)


@silence_mujoco_log()
def propose_experiment(
    path: Path,
    folder: Path,
    wishes: Wishes = NO_WISHES,
    *,
    companion_name: str = "",
    files: PackedFiles | None = None,
) -> Proposal:
    """Propose a first experiment for a model.

    Args:
        path: MJCF or URDF file.
        folder: Folder of the experiment file, to which the path of the model is relative.
        wishes: What the user wants; the rest is proposed.
        companion_name: Name of the MJCF that is written beside the experiment file for a URDF.
        files: Files with the model; None for the disk.

    Raises:
        ModelError: The model cannot be read.
        ExperimentError: The model has neither an actuator nor a joint that can be released, or no
            parameter of the wanted groups, or a wish cannot be fulfilled.
    """
    source, companion, velocities = _model(path, folder, wishes.packages, files)
    model = source.model
    if not model.njnt:
        raise ExperimentError(f"{path}: the model has no joint, so that nothing in it can move")
    data = mujoco.MjData(model)
    start = choose_start(model, wishes.keyframe)
    if model.nu and not start.held:
        require_support(model, path)
    data.qpos[:] = start.qpos
    data.ctrl[:] = start.control
    mujoco.mj_forward(model, data)
    # Nobody flies a robot without feedback.
    flies = start.held and not data.ncon and not model.neq and bool(falling_bodies(model))
    length = reach(model, data)
    times = wanted_times(time_scale(model, data), model, wishes)

    sizes = {"length": length, "period": times.period, "rate": times.rate}
    has_laws = "servos" in wishes.groups
    found, absent = ([], []) if has_laws else _candidates(source, wishes, sizes)
    controls = source.coordinates.controls
    release = None
    wanted = np.zeros(0)
    if controls:
        wanted = first_amplitudes(
            model, start, influence_of_controls(model, start), length, times.period
        )
    else:
        release = propose_release(model, start.qpos, length)
        if not release[1]:
            raise ExperimentError(
                f"{path}: the model has neither an actuator nor a slide, hinge or ball joint with "
                "a name that could be released; add <actuator> elements to the MJCF, or name its "
                "joints"
            )
    # Ranges about the resting control for controls that have none in the MJCF.
    ranges = {
        name: [rounded(centre - width, 3), rounded(centre + width, 3)]
        for name, centre, width, is_limited in zip(
            controls, start.control, CONTROL_LIMIT * wanted, model.actuator_ctrllimited, strict=True
        )
        if not is_limited
    }
    limits: dict[str, Any] = {"control": ranges} if ranges else {}
    if controls:
        limits |= playable_limits(source, start, times, length, velocities)
    elif velocities:
        limits["velocity"] = velocities
    draft = Proposal(
        model=os.path.relpath(path, folder) if companion is None else companion_name,
        companion=companion,
        source=source,
        times=times,
        start=start,
        amplitudes=dict(zip(controls, wanted.tolist(), strict=True)),
        chirp=(
            rounded(FIRST_FREQUENCY / times.period),
            rounded(LAST_FREQUENCY / times.period),
        ),
        noise=proposed_noise(model, length, times.period, wishes.sigmas, flies=flies),
        chosen=found,
        others=absent,
        limits=limits,
        release=release,
        flies=flies,
    )
    if has_laws:
        return _with_laws(draft, wishes)
    refinement = _Refinement(source=source, folder=folder, wishes=wishes)
    try:
        if release is not None:
            return refinement.released(draft, length)
        return refinement.refined(draft)
    except SimulationDivergedError as error:
        raise ModelError(f"{path}: {error}") from None


def _with_laws(draft: Proposal, wishes: Wishes) -> Proposal:
    """The draft with the laws of position servos, which a log is to show."""
    others = sorted({*wishes.groups} - {"servos", "friction", "motors"})
    if others or wishes.payload is not None:
        raise ExperimentError(
            "parameters: servos proposes the laws of servos alone; leave out "
            f"{listed(others or ['payload'])}"
        )
    timestep, row = draft.compiled.opt.timestep, wishes.row or 0.0
    laws, numbers = servo_laws(draft.compiled, draft.times.period, row)
    if not row or not laws:
        raise ExperimentError(
            "parameters: servos needs a log with times (--log LOG), and a model with <position> "
            "servos that have names, as their joints do"
        )
    noise = [each for each in draft.noise if not each[0].startswith("qvel:")]
    tables = {
        "fit": {"segments": "whole", "start": "measured"},
        "controllers": laws,
        "nuisance": {"bias": {key: True for key, _, _ in noise if key.startswith("qpos:")}},
    }
    times = replace(draft.times, rate=1.0 / (max(round(row / timestep), 1) * timestep))
    return replace(draft, laws=tables, chosen=numbers, times=times, noise=noise)


def _candidates(
    source: ModelSource, wishes: Wishes, sizes: Mapping[str, float]
) -> tuple[list[Candidate], list[Candidate]]:
    """Parameters that may be chosen, and those of which the model has nothing."""
    every = candidates(source.model, wishes.groups, wishes.payload, **sizes)
    if wishes.unknown is not None:
        return stated_candidates(source, wishes.unknown, every), []
    found = [each for each in every if not each.is_absent][:MOST_CANDIDATES]
    if not found:
        raise ExperimentError(
            f"{source.path}: no parameter of {', '.join(wishes.groups)} can be proposed: bodies "
            "and joints need names, and friction and armature a value > 0"
        )
    return found, [each for each in every if each.is_absent]


def wanted_times(times: TimeScale, model: Any, wishes: Wishes) -> TimeScale:
    """The proposed times with the rate and the horizon that the user wants.

    Args:
        times: The proposed times.
        model: The compiled model.
        wishes: What the user wants.

    Raises:
        ExperimentError: The rate does not fit to the timestep, or the horizon is too short.
    """
    rate = times.rate if wishes.rate is None else require_rate(model, wishes.rate)
    horizon = times.horizon if wishes.horizon is None else wishes.horizon
    samples = round(horizon * rate)
    if samples > MAX_SAMPLES:
        raise ExperimentError(
            f"a horizon of {horizon:g} s has {samples:g} samples; that is too long"
        )
    if samples < 2:
        raise ExperimentError(
            f"a horizon of {horizon:g} s has less than two samples at {rate:g} Hz; it must be at "
            f"least {2.0 / rate:g} s"
        )

    unstable = times.unstable and wishes.horizon is None
    return replace(times, rate=rate, samples=samples, unstable=unstable)


def _model(
    path: Path, folder: Path, packages: Mapping[str, str], files: PackedFiles | None
) -> tuple[ModelSource, str | None, dict[str, float]]:
    """The model with actuators, the MJCF that adds them to a URDF, and its velocity limits."""
    if files is not None:
        return packed_model(files, path), None, {}
    if not is_urdf(path):
        return ModelSource(path), None, {}

    # The MJCF around the URDF exists only in memory so far; its path of the URDF is absolute.
    mjcf, velocities = read_urdf(path, packages)
    try:
        with silence_mujoco_log():
            spec = mujoco.MjSpec.from_string(mjcf(str(path.resolve())))
        resolve_packages(spec, path)
    except ValueError as error:
        raise ModelError(f"{path}: MuJoCo cannot add motors: {str(error).strip()}") from None
    return ModelSource(path, spec), mjcf(os.path.relpath(path, folder)), velocities


def _with_amplitudes(draft: Proposal, amplitudes: Array) -> Proposal:
    """The draft with other amplitudes, (nu,), of the chirp."""
    return replace(draft, amplitudes=dict(zip(draft.amplitudes, amplitudes.tolist(), strict=True)))


def _lean(draft: Proposal) -> Proposal:
    """The draft with one parameter, which is enough where only the motion matters, and quicker."""
    return replace(draft, chosen=draft.chosen[:1])


@record
class _Refinement:
    """Test of a draft by the package itself: feasible amplitudes and identifiable parameters.

    Attributes:
        source: The model.
        folder: Folder of the experiment file.
        wishes: What the user wants.
    """

    source: ModelSource
    folder: Path
    wishes: Wishes

    def refined(self, draft: Proposal) -> Proposal:
        """The draft with amplitudes that keep all limits, and with identified parameters."""
        system = System.resolve(self._experiment(_lean(draft)), source=self.source)
        at_rest = replace(draft, boundary=AT_REST)
        if draft.start.held and self._can_begin(system, at_rest):
            draft = at_rest
        # Each joint of an arm is driven, so that the controls can stop it; who flies, hovers.
        can_stop = len(driven_dofs(self.source.model)) == self.source.model.nv or draft.flies

        remarks = []
        amplitudes = np.array(list(draft.amplitudes.values()))
        kept = self._kept_amplitudes(system, draft, amplitudes)
        if draft.boundary and kept is not None and can_stop:
            # Servos stop a motion that fades; under torques, the design has to find the end.
            draft = replace(draft, boundary=AT_REST | {"end": "rest"})
            ended = self._kept_amplitudes(system, draft, kept)
            if ended is not None and (ended >= SMALLEST_ENDED * kept).all():
                kept = ended
        if kept is None:
            smallest = two_digits(amplitudes * SHRINKING**TRIALS)
            shorter, remark = self._within_limits(system, draft, smallest)
            remarks.append(remark)

            # During a shorter horizon, the motion may be larger.
            if shorter is not draft:
                kept = self._kept_amplitudes(system, shorter, amplitudes)
            draft, kept = shorter, smallest if kept is None else kept
        moved = _with_amplitudes(draft, kept)
        if not draft.start.held:
            remarks.append(
                "Note: no control holds the start; the robot moves from the first moment."
            )

        if draft.times.unstable:
            remarks.append("Note: the start is unstable, so the horizon is short.")
        samples = self._predictable_samples(system, moved)
        if samples < draft.times.samples and self.wishes.horizon is not None:
            remarks.append(
                "Note: the motion amplifies small disturbances; a horizon of "
                f"{samples / draft.times.rate:.3g} s would be safer."
            )
        elif samples < draft.times.samples:
            moved = replace(moved, times=replace(draft.times, samples=samples))
            remarks.append(
                "Note: the motion amplifies small disturbances, so the horizon is short."
            )
        return self._with_parameters(moved, remarks)

    def _kept_amplitudes(self, system: System, draft: Proposal, amplitudes: Array) -> Array | None:
        """(nu,) largest amplitudes that keep all limits, if possible with some room; or None.

        One joint that is near a limit does not keep the others from moving: after a common share,
        each amplitude grows by itself.
        """
        task = self._task(system, _with_amplitudes(draft, amplitudes))
        room = cache(lambda trial: self._room(task, SHRINKING**trial))
        for least in (ROOM, 0.0):
            if room(TRIALS) < least:
                continue
            # A smaller motion has more room.
            trial = bisect_left(range(TRIALS), least, key=room)
            shares = np.full(len(amplitudes), SHRINKING**trial)
            growing = [*range(len(shares))]
            for factor in GROWTHS:
                # What could not grow by the same factor before is tried with a smaller one only.
                tried = range(len(shares)) if factor < GROWTHS[0] else growing
                growing = []
                for actuator in tried:
                    larger = shares.copy()
                    larger[actuator] = min(factor * shares[actuator], 1.0)
                    if larger[actuator] > shares[actuator] and self._room(task, larger) >= least:
                        shares = larger
                        growing.append(actuator)
            return two_digits(amplitudes * shares)
        return None

    def _within_limits(
        self, system: System, draft: Proposal, smallest: Array
    ) -> tuple[Proposal, str]:
        """Let the experiment end before a robot that nothing holds leaves a limit.

        Args:
            system: The system.
            draft: The draft, none of whose amplitudes keep all limits.
            smallest: (nu,) the smallest amplitudes.

        Returns:
            The draft, with a shorter horizon where that helps, and a remark that names the limit.
        """
        still = _with_amplitudes(draft, smallest)
        try:
            task = self._task(system, still)
            first = next(iter(violations_of(task, verify(task, task.initial))))
        except (SimulationDivergedError, StopIteration):
            return draft, f"Warning: {NO_MOTION}; choose another start."

        # A horizon that the user wants stays.
        times = draft.times
        samples = int(BEFORE_VIOLATION * first.since * times.rate)
        is_long_enough = samples >= max(SHORTEST_FALL * times.period * times.rate, 2.0)
        if is_long_enough and self.wishes.horizon is None:
            shorter = replace(times, samples=samples)
            if self._room(self._task(system, replace(still, times=shorter)), 1.0) >= 0.0:
                remark = (
                    f"Note: the horizon ends before the robot leaves a limit by itself: {first}."
                )
                return replace(draft, times=shorter), remark

        cure = _touching(draft) or "choose another start"
        return draft, f"Warning: {NO_MOTION}: {first}; {cure}."

    def released(self, draft: Proposal, length: float) -> Proposal:
        """The draft of a model without actuators, with a release that keeps all limits.

        Args:
            draft: The draft.
            length: Length of the robot [m].
        """
        remarks = ["The model has no actuators: a design chooses the release, `initial.free`."]
        for trial in range(TRIALS):
            share = rounded(FIRST_SHARE * SHRINKING**trial)
            release = propose_release(self.source.model, draft.start.qpos, length, share)
            released = replace(draft, release=release)
            if self._room(self._own_task(_lean(released)), 1.0) >= 0.0:
                return self._with_parameters(released, remarks)
        remarks.append("Warning: no release near this start keeps all limits.")
        return self._with_parameters(draft, remarks)

    def _with_parameters(self, draft: Proposal, remarks: Sequence[str]) -> Proposal:
        """The draft with the parameters that its motion identifies, and with all remarks."""
        chosen = self._identified(draft)
        proposed = [draft.chosen[i] for i in chosen]
        others = [each for i, each in enumerate(draft.chosen) if i not in chosen]
        others += draft.others

        idle = [name for name, amplitude in draft.amplitudes.items() if amplitude == 0.0]
        remarks = list(remarks)
        if idle:
            remarks.append(
                f"Warning: the start holds {first_ones(idle)} at the end of the range, where the "
                "first motion does not use it; choose another start."
            )

        # Parameters of bodies and joints without a name cannot be proposed; a free joint has none.
        model = self.source.model
        joints = [model.joint(j).name for j in range(model.njnt) if joint_dofs(model, j) < 6]
        unnamed = [
            f"{count} {one if count == 1 else many}"
            for count, one, many in (
                (unnamed_count(model, "body"), "body", "bodies"),
                (joints.count(""), "joint", "joints"),
            )
            if count
        ]
        if unnamed:
            remarks.append(
                f"Note: nothing is proposed for {' and '.join(unnamed)} without a name in the MJCF."
            )
        return replace(draft, remarks=remarks, chosen=proposed, others=others)

    def _experiment(self, draft: Proposal) -> Experiment:
        return Experiment(**draft.values(), directory=self.folder, source="the proposed experiment")

    def _own_task(self, draft: Proposal) -> DesignTask:
        """The task of a draft on a plant of its own."""
        return DesignTask.of(System.resolve(self._experiment(draft), source=self.source))

    def _task(self, system: System, draft: Proposal) -> DesignTask:
        """The task of the motion of a draft on the plant of a system."""
        return DesignTask.of(replace(system, experiment=self._experiment(_lean(draft))))

    def _can_begin(self, system: System, draft: Proposal) -> bool:
        """Whether a design can begin at rest, as a draft states."""
        try:
            task = self._task(system, draft)
            # A design searches without the stops of joints, too.
            return bool(np.isfinite((task.initial_hold, task.relaxed().initial_hold)).all())
        except MjfimError:
            return False

    def _room(self, task: DesignTask, shares: Array | float) -> float:
        """Smallest distance of the motion of a task from the limits in any engine step.

        It is relative to half of the range, and negative where a limit is broken. The control
        differs from rest by shares, (nu,), of what the task states.
        """
        # A chirp begins at rest.
        rest = task.control[:1]
        try:
            motion = task.plant.simulate(task.theta, rest + shares * (task.control - rest))
            found = verify(task, motion, briefly=True)
        except SimulationDivergedError:
            return -np.inf
        if not found.is_feasible:
            return -np.inf

        kinds = found.relative_margins.keys() - found.unenforced - set(WITHOUT_ROOM)
        return min((found.relative_margins[kind] for kind in kinds), default=np.inf)

    def _predictable_samples(self, system: System, draft: Proposal) -> int:
        """Samples of the first motion until a small disturbance of the start has grown too much."""
        task = self._task(system, draft)
        model = self.source.model
        substeps = task.system.grid.substeps
        controls = np.repeat(task.control, substeps, axis=0)
        sizes = position_sizes(model)
        rng = np.random.default_rng(0)
        undisturbed = played(model, draft.start, controls)[0][substeps::substeps]

        # A random direction has a share of the one that grows most. Only positions count:
        # velocities grow at first where a servo is stiff.
        samples = len(undisturbed)
        largest = DISTURBANCE * LARGEST_AMPLIFICATION / np.sqrt(model.nv)
        for _ in range(DISTURBANCES):
            direction = rng.standard_normal(model.nv)
            moved = DISTURBANCE * sizes * direction / np.linalg.norm(direction)
            disturbed = played(model, draft.start, controls, moved)[0][substeps::substeps]
            samples = _samples_near(model, undisturbed[:samples], disturbed, sizes, largest)
        times = draft.times
        return min(max(samples, round(SHORTEST_MOTION * times.period * times.rate)), times.samples)

    def _identified(self, draft: Proposal) -> Sequence[int]:
        """Indices of the candidates that the chirp or the release identifies together.

        Parameters that the user states are all chosen. Dry friction and contacts make derivatives
        inaccurate, so that parameters seem to differ that never do. The test of a check knows the
        error of the derivatives; a parameter that it cannot tell apart makes room for later ones.
        """
        if self.wishes.unknown is not None:
            return range(len(draft.chosen))
        task = self._own_task(draft)
        point = task.problem.point(task.initial, CENTRAL_DIFFERENCES)
        if point.information is None or point.sensitivity is None:
            raise SimulationDivergedError(
                "the simulation diverges when the parameters change a little"
            )
        F = point.information - task.information.prior
        # The error of a release is a further unknown.
        n = len(draft.chosen)
        hidden = F[:n, n:] @ np.linalg.pinv(F[n:, n:], hermitian=True) @ F[n:, :n]
        F, sizes, left = F[:n, :n] - hidden, task.parameters.scale[:n], list(range(n))
        payload = self.wishes.payload
        # A payload that is asked for is chosen, however little the first motion shows of it.
        asked = [i for i, each in enumerate(draft.chosen) if payload and each.name == "payload"]
        if (F[asked, asked] * sizes[asked] ** 2 < LEAST_SHARE).any():
            # A mass whose first moments are known may have an effect where it has none beside them.
            fewer = [i for i in left if not draft.chosen[i].name.startswith("payload_")]
            if len(fewer) < n:
                bare = replace(draft, chosen=[draft.chosen[i] for i in fewer])
                return [fewer[i] for i in self._identified(bare)]
            raise ExperimentError(
                f"payload: the first motion does not show a load at {payload!r}; name a body "
                "that the motion accelerates or lifts"
            )
        while True:
            chosen = [left[i] for i in identifiable(F[np.ix_(left, left)], sizes[left], asked)]
            tried = self._own_task(replace(draft, chosen=[draft.chosen[i] for i in chosen]))
            columns = point.sensitivity.of_parameters([*chosen, *range(n, len(task.parameters))])
            # Other controls need not be tried, because this one has to show every parameter.
            found = tried.identifiability_test.along(tried.initial, columns, lambda: True)
            shares = np.abs(found.along_trajectory.directions) / sizes[chosen, None]
            if len(chosen) == 1 or not shares.size:
                return chosen
            members = shares[:, 0] > LEAST_SHARE * shares[:, 0].max()
            removed = [i for i, is_in in zip(chosen, members, strict=True) if is_in]
            left.remove(([i for i in removed if i not in asked] or chosen)[-1])


# Largest relative standard deviation of a proposed parameter along the initial control. A designed
# motion gives several times more information than the initial one.
LARGEST_STD = 0.5

# A parameter belongs to a combination without effect if its share in it is larger than this. A
# motion with less information about a payload of the stated size than this does not show it.
LEAST_SHARE = 1e-4

# Largest number of proposed parameters, so that a design takes a minute.
MOST_PARAMETERS = 10


def _touching(draft: Proposal) -> str:
    """How to prevent that bodies push each other apart at the start; empty where none touch."""
    model = draft.compiled
    data = mujoco.MjData(model)
    data.qpos[:] = draft.start.qpos
    mujoco.mj_forward(model, data)
    geoms = data.contact.geom[data.contact.dist < 0.0]
    pairs = {tuple(sorted(model.body(b).name for b in model.geom_bodyid[pair])) for pair in geoms}
    lines = [f'<exclude body1="{a}" body2="{b}"/>' for a, b in sorted(pairs)]
    if not lines:
        return ""
    added = first_ones(lines)
    return f"bodies touch at the start: move it, or add to <contact> of the MJCF {added}"


def identifiable(F: Array, sizes: Array, asked: Sequence[int] = ()) -> Sequence[int]:
    """Choose parameters that a motion identifies together, one after the other.

    Args:
        F: (p, p) information of the motion [1 / (theta_i theta_j unit)].
        sizes: (p,) sizes of the parameters [theta-unit].
        asked: Indices of parameters that are chosen however little is known about them.

    Returns:
        Indices of the candidates, in their order, that are known accurately together; the one about
        which most is known where there are none.
    """
    # Information about relative changes, in which units do not matter.
    relative = F * np.outer(sizes, sizes)
    chosen = list(asked)
    for i in range(len(sizes)):
        worst = _largest_std(relative, [*chosen, i])
        if i not in chosen and len(chosen) < MOST_PARAMETERS and worst <= LARGEST_STD:
            chosen.append(i)
    return chosen or [int(np.argmax(np.diag(relative)))]


def _largest_std(F: Array, members: list[int]) -> float:
    """Largest standard deviation of some parameters that are estimated together."""
    part = F[np.ix_(members, members)]
    if not np.isfinite(part).all() or not (np.diag(part) > 0.0).all():
        return np.inf

    # Scaling by the diagonal keeps the eigenvalues comparable.
    correlation, diagonal = scaled_to_unit_diagonal(part)
    values, vectors = np.linalg.eigh(correlation)
    if values[0] <= len(members) * np.finfo(float).eps * 1e3:
        return np.inf
    variances = (vectors**2 / values).sum(axis=1) / diagonal**2
    return float(np.sqrt(variances.max()))


# Comments that differ in an experiment that shows laws of servos.
ABOVE_WITH_LAWS = {
    "controllers": [
        "The law of each servo, with the numbers of its <position> as guesses.",
        "Where the servo has a motion profile, state its `acceleration` as well.",
    ],
    "parameters": [
        "In the order in which logs show them: gain and dry friction by the sag under gravity,",
        "latencies by the begin of motions, kd and damping by the lag, drag by quick motions, the",
        "largest force by jumps, and armature. Equal servos share numbers.",
    ],
    "nuisance": ["Zeros of the readings."],
}

# Comments above tables and keys.
ABOVE = {
    "initial.control": ["The control from which a design starts."],
    "initial.free": [
        "Releases that a design may choose [m or rad]. A push is a velocity,",
        'for example "qvel:<joint>" = [-1.0, 1.0].',
    ],
    "nuisance": ["The error of the release is unknown; the fit reads it from each log."],
    "parameters": [
        f"Unknown parameters: at most {MOST_PARAMETERS} that the first motion identifies together,",
        "one for equal joints of a large robot. `mjfim list MODEL` lists every path.",
        "For friction and a delay that the model lacks, add a table [nuisance] with",
        "friction = true and delay = true, and with the armature of driven joints. From logs of",
        "position servos, `mjfim init MODEL --log LOG --parameters servos` proposes their laws.",
    ],
    "boundary": [
        'end = "rest" lets the motion end at a standstill; "free" gives more information.'
    ],
}

# Comments behind keys.
BEHIND = {
    "rate": "samples and controls [Hz]",
    "horizon": "duration of the experiment [s]",
    "cost.control": "the ranges bound the control; no weight is needed",
    "limits.velocity": "[m/s or rad/s]",
    "limits.angular_velocity": "[rad/s]",
    "limits.tilt": "angle from upright [rad]",
    "limits.position": "about the start; for a soft range of the MJCF, so wide that it holds there",
    "limits.tendon_length": "wider than in the MJCF, whose soft range the state at rest exceeds",
    "limits.clearance": "between bodies [m]; ignored pairs are nearer at the start",
    "limits.ignored": "bodies that touch brake each other, unless the MJCF has an <exclude>",
    "limits.floor": "height of the floor, which not all bodies touch in the MJCF [m]",
    "limits.reserve": "as much as robots that differ from the model need",
    "limits.bandwidth": "of the controls [Hz]; a larger one gives more information",
    "rehearsal.feedback": "open loop, a small error of the thrust lets the robot fall",
    "descent.seconds": "time budget of a design [s]; more gives better designs",
}


def experiment_text(proposal: Proposal) -> str:
    """The experiment file of a proposal."""
    model = proposal.compiled
    above = {**ABOVE, **_about(proposal), **(ABOVE_WITH_LAWS if proposal.laws else {})}
    behind = {
        **BEHIND,
        **{f"parameters.{each.name}": _meaning(model, each) for each in proposal.chosen},
    }
    document = tomlkit.document()
    for line in (
        f"A first experiment for {proposal.model}, proposed by `mjfim init`.",
        "Next: mjfim check FILE LOG says what a log shows, check FILE what can be identified.",
        "mjfim design FILE -o DIR designs the best motion. The last two need no [controllers].",
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
    if proposal.others:
        _add_others(document["parameters"], proposal)
    return tomlkit.dumps(document).rstrip() + "\n"


def _about(proposal: Proposal) -> dict[str, list[str]]:
    """Comments about what is stated for this model."""
    model, start = proposal.compiled, proposal.start
    noise = [
        "Standard deviations of the measurements. To measure them, hold the robot still for 10 s,",
        "record, and take the standard deviation of each column.",
    ]
    of_joints = [kind for _, _, kind in proposal.noise]
    if not of_joints[0]:
        noise = ["Standard deviations of the sensors, as the MJCF states them."]
    if not of_joints[0] and of_joints[-1]:
        noise += [
            "Those of `qpos` and `qvel` are those of what measures the flight, such as motion",
            "capture, by which the feedback keeps the robot in the air.",
        ]

    initial = [f"The release, at rest, away from {start.reason}."]
    if proposal.release is None:
        initial = [f"The start: {start.reason}."]
        names = [model.key(i).name for i in range(model.nkey)]
        others = [name for name in names if name and name != start.near]
        initial += [f"Other keyframes: {', '.join(others)}."] if others else []

    return {"noise": noise, "initial": initial, "limits": _about_limits(model)}


def _about_limits(model: Any) -> list[str]:
    """Comments about the limits of a model (`mujoco.MjModel`)."""
    limits = []
    kinds = dict.fromkeys(limit.kind.replace("_", " ") for limit in limits_of_model(model))
    if kinds:
        limits = [
            f"The ranges of the MJCF always hold ({', '.join(kinds)}):",
            "`mjfim list MODEL --kind limits` shows them.",
        ]
    limits += [
        "Those below are derived from the robot's length and its state at rest. Write those that",
        "your robot has; further ones are acceleration, control_rate and force.",
    ]
    if any(kind in QUATERNION_PLACE for kind in model.jnt_type.tolist()):
        limits.append("Of free and ball joints also: tilt, angular_velocity, in radians.")
    return limits


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
        table = tomlkit.inline_table()
        table.update(value)
        return table
    if isinstance(value, list):
        array = tomlkit.array()
        array.extend(value)
        return array
    return value


def _add_others(table: Any, proposal: Proposal) -> None:
    """Add the parameters that are not proposed as comments."""
    table.add(tomlkit.nl())
    table.add(tomlkit.comment("Further parameters. Uncomment those that you do not trust;"))
    table.add(tomlkit.comment("`mjfim check` says which ones can be identified together."))
    for each in proposal.others:
        name, written = tomlkit.key(each.name).as_string(), _inline(each.table()).as_string()
        table.add(tomlkit.comment(f"{name} = {written}  # {_meaning(proposal.compiled, each)}"))


def _meaning(model: Any, each: Candidate) -> str:
    unit = unit_of(model, each.paths[0])
    return f"{each.meaning} [{unit}]" if unit else each.meaning


def _samples_near(model: Any, one: Array, other: Array, sizes: Array, most: float) -> int:
    """Samples of two motions, (n, nq) and (m, nq), until they are apart by more than a distance.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        one: Positions of the one motion.
        other: Positions of the other one.
        sizes: (nv,) sizes of the coordinates.
        most: The distance, in these sizes.
    """
    change, count = np.zeros(model.nv), min(len(one), len(other))
    for k in range(count):
        mujoco.mj_differentiatePos(model, change, 1.0, one[k], other[k])
        if np.linalg.norm(change / sizes) > most:
            return k
    return count
