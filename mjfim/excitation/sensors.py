"""What each sensor tells about the parameters along one motion, from its sensitivities.

The noise of sensors is independent, so that their information adds. Without a sensor its matrix is
missing from the sum; with half of its noise it counts four times.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array, record
from mjfim.excitation.objective import DesignPoint
from mjfim.excitation.task import DesignTask
from mjfim.information.criteria import shared
from mjfim.information.identifiability import Identifiability, null_space
from mjfim.information.null_space import COARSER_STEP_FACTOR
from mjfim.model.coordinates import ScalarJoint, output_label, split_unit
from mjfim.model.units import per_second
from mjfim.plant.plant import SENSITIVITY_STEP
from mjfim.records.trajectory import Sensitivity
from mjfim.records.worth import DEFAULT_RELATIVE_STD, SensorWorth, Worth

# Words for kinds of sensors, where they differ from MuJoCo's.
KINDS = {
    "qpos": "positions",
    "qvel": "velocities",
    "jointpos": "positions",
    "jointvel": "velocities",
    "jointactfrc": "joint torques",
}

# Largest number of sensors of which every set is tried; of more, sets of kinds are tried.
MOST_SENSORS = 10


@record
class Sensor:
    """The measurements of a sensor along a motion.

    Attributes:
        name: Its name; correlated sensors count as one, which has all their names.
        kind: Kind of the sensor, in words.
        noise: Standard deviation of its noise with its unit, in words.
        rows: (n, p) whitened derivatives of its measurements [1 / theta-unit].
        error: (n, p) their change with a longer difference step.
        is_added: Whether the model lacks it.
    """

    name: str
    kind: str
    noise: str
    rows: Array
    error: Array
    is_added: bool = False

    @classmethod
    def of_rows(cls, rows: Array, coarse: Array, **words: Any) -> Sensor:
        """A sensor with at most 2 p rows, whose products are those of all of its rows.

        Args:
            rows: (m, p) whitened derivatives of all measurements [1 / theta-unit].
            coarse: (m, p) the same with a longer difference step.
            **words: The other attributes.
        """
        both = np.concatenate([rows, coarse - rows], axis=1)
        rows, error = np.split(np.asarray(np.linalg.qr(both, mode="r")), 2, axis=1)
        return cls(rows=rows, error=error, **words)


def sensors_along(
    task: DesignTask, fine: Sensitivity, coarse: Sensitivity, added: Collection[str]
) -> Iterator[Sensor]:
    """Collect the measurements of each sensor of a task.

    Args:
        task: The task.
        fine: Sensitivities along the motion.
        coarse: Sensitivities with a longer difference step.
        added: Names of the sensors that the user's model lacks.
    """
    outputs, noise, model = task.system.outputs, task.system.noise, task.system.model
    coordinates = task.system.source.coordinates
    measurable = (*coordinates.state, *coordinates.sensors)
    sensor_of = {each.name: (each.name, *each.groups)[-1] for each in measurable}
    names = np.array([sensor_of[name] for name in outputs.names])
    rows, coarse_rows = noise.whiten(fine.G), noise.whiten(coarse.G)
    is_measured = noise.measured(len(rows) - 1) > 0.0

    # Components of a sensor, and correlated sensors, belong together.
    belong = (names[:, None] == names) | (noise.covariance != 0.0)
    for _ in range(len(names).bit_length()):
        belong = belong @ belong
    for place in np.flatnonzero(belong.argmax(axis=1) == np.arange(len(names))).tolist():
        columns = np.flatnonzero(belong[place])
        first = str(names[place])
        unit = split_unit(output_label(model, outputs.names[place]))[1]
        mask = is_measured[:, columns]
        yield Sensor.of_rows(
            rows[:, columns][mask],
            coarse_rows[:, columns][mask],
            name=" + ".join(dict.fromkeys(names[columns].tolist())),
            kind=_kind(model, first),
            noise=f"{noise.sigma[place]:.3g} {unit}".rstrip(),
            is_added=first in added,
        )


def _kind(model: mujoco.MjModel, name: str) -> str:
    """Kind of a sensor or of a component of the state, in words."""
    stated = name.partition(":")[0]
    if stated not in KINDS:
        stated = mujoco.mjtSensor(model.sensor(name).type[0]).name
        stated = stated.removeprefix("mjSENS_").lower()
    return KINDS.get(stated, stated)


@record
class Sensing:
    """All sensors along a motion, any of which may be left out or be made more accurate.

    Attributes:
        task: The task.
        sensors: The sensors.
        hidden: (t, k) directions of the wanted parameters that no sensor shows.
    """

    task: DesignTask
    sensors: tuple[Sensor, ...]
    hidden: Array

    @property
    def present(self) -> Array:
        """(s,) 1 for sensors of the experiment, 0 for added ones."""
        return np.array([0.0 if sensor.is_added else 1.0 for sensor in self.sensors])

    @cached_property
    def _matrices(self) -> Array:
        """(s, p, p) information of each sensor."""
        return np.array([sensor.rows.T @ sensor.rows for sensor in self.sensors])

    def std(self, weights: Array, repetitions: int = 1) -> Array:
        """Standard deviations of the parameters.

        Args:
            weights: (s,) how many times the information of each sensor counts.
            repetitions: Number of repetitions of the experiment.

        Returns:
            (p,) standard deviations [theta-unit]; infinite for nuisance parameters, and for those
            that are not identifiable alone.
        """
        used = [
            (np.sqrt(weight) * sensor.rows, np.sqrt(weight) * sensor.error)
            for weight, sensor in zip(weights, self.sensors, strict=True)
            if weight
        ]
        std = np.full(len(self.task.parameters), np.inf)
        if not used:
            return std
        rows, errors = zip(*used, strict=True)
        null = null_space(self.task.identifiability_test, rows, errors, self.hidden)
        basis = null.basis if null.count else None
        std[self.task.parameters.interest] = self._wanted_std(weights, basis, repetitions)
        return std

    def _wanted_std(self, weights: Array, basis: Array | None, repetitions: int = 1) -> Array:
        """(t,) standard deviations of the wanted parameters in identifiable combinations."""
        task = self.task
        data = np.tensordot(weights, self._matrices, axes=1)
        p = task.parameters
        data = repetitions * shared(data, p.prior_information, p.recording_specific)
        information = replace(task.information, prior=task.prior, basis=basis)
        covariance = information.covariance(data + task.prior)
        return np.nan_to_num(np.sqrt(np.diag(covariance)), nan=np.inf)

    @property
    def target(self) -> Array:
        """(p,) wanted standard deviations, see `Worth`; NaN for what no sensor determines."""
        p = self.task.parameters
        stated = np.array([each.wanted or np.nan for each in p.parameters])[p.interest]
        usual = DEFAULT_RELATIVE_STD * p.sizes(self.task.theta)[p.interest]
        target = np.full(len(p), np.nan)
        target[p.interest] = stated if np.isfinite(stated).any() else usual
        found = np.where(np.isfinite(self.std(np.ones(len(self.sensors)))), target, np.nan)
        return found if np.isfinite(found).any() else target

    def fewest(self, target: Array) -> tuple[str, ...]:
        """Find the smallest set of sensors, or of their kinds, that reaches a target.

        Args:
            target: (p,) wanted standard deviations [theta-unit]; NaN where none is wanted.

        Returns:
            Names; none where all sensors together do not reach the target.
        """
        wanted = target[self.task.parameters.interest]

        def reaches(chosen: Iterable[Array]) -> bool:
            """Whether the sensors of some masks suffice together."""
            weights = np.maximum.reduce(list(chosen))
            return not (self._wanted_std(weights, None) > wanted).any()

        single, kinds = self._singles, self._kinds
        choices = kinds if len(single) > MOST_SENSORS and kinds else single
        if len(choices) > MOST_SENSORS or not reaches(choices.values()):
            return ()
        for count in range(1, len(choices) + 1):
            for names in itertools.combinations(choices, count):
                if reaches(choices[name] for name in names):
                    return names
        return ()

    @property
    def _singles(self) -> dict[str, Array]:
        """(s,) masks of single sensors, by their names."""
        names = [each.name for each in self.sensors]
        return dict(zip(names, np.eye(len(names)), strict=True))

    @property
    def _kinds(self) -> dict[str, Array]:
        """(s,) masks of all sensors of a kind; empty where there is one kind only."""
        kinds = np.array([each.kind for each in self.sensors])
        each = dict.fromkeys(kinds.tolist())
        masks = {f"all {kind}": 1.0 * (kinds == kind) for kind in each}
        return masks if len(masks) > 1 else {}

    def _worth_of(self, name: str, mask: Array) -> SensorWorth:
        """What sensors with a mask, (s,), are worth."""
        present, noises = self.present, {each.name: each.noise for each in self.sensors}
        return SensorWorth(
            name=name,
            noise=noises.get(name, ""),
            is_added=not (mask * present).any(),
            without=self.std(present * (1.0 - mask)),
            present=self.std(np.maximum(present, mask)),
            alone=self.std(mask),
            halved=self.std(np.maximum(present, 4.0 * mask)),
        )

    def worth(self, source: str, horizon: float) -> Worth:
        """Judge what would help to determine the parameters along the motion.

        Args:
            source: The motion, in words.
            horizon: Its duration [s].
        """
        p, present, target = self.task.parameters, self.present, self.target
        several = {name: mask for name, mask in self._kinds.items() if mask.sum() > 1.0}
        return Worth(
            source=source,
            horizon=horizon,
            parameters=p.names,
            units=self.task.system.units,
            target=target,
            is_stated=any(each.wanted for each in p.parameters),
            std=self.std(present),
            repeated=self.std(present, 2),
            faster=self.std(2.0 * present),
            sensors=tuple(
                self._worth_of(name, mask) for name, mask in {**self._singles, **several}.items()
            ),
            fewest=self.fewest(target),
        )


def _accelerations(
    task: DesignTask, fine: Sensitivity, coarse: Sensitivity, joints: Mapping[ScalarJoint, float]
) -> Iterator[Sensor]:
    """Sensors of joint accelerations: changes of velocities from sample to sample."""
    first, stride = task.space.nv, task.system.grid.stride
    by_step = [np.diff(each.psi, axis=0)[stride - 1 :: stride] / task.dt for each in (fine, coarse)]
    for joint, sigma in joints.items():
        yield Sensor.of_rows(
            *(slopes[:, first + joint.v] / sigma for slopes in by_step),
            name=f"acceleration of {joint.name}",
            kind="joint accelerations",
            noise=f"{sigma:.3g} {per_second(per_second(joint.unit))}",
            is_added=True,
        )


def sensing_along(
    task: DesignTask,
    point: DesignPoint,
    identifiability: Identifiability,
    added: Collection[str] = (),
    accelerations: Mapping[ScalarJoint, float] = MappingProxyType({}),
) -> Sensing:
    """Collect what each sensor shows along a motion that can be simulated.

    Args:
        task: The task.
        point: The motion with its sensitivities.
        identifiability: What the sensors of the task can identify.
        added: Names of sensors of the task that the user's model lacks.
        accelerations: Standard deviations of sensors of joint accelerations, by their joints.
    """
    fine = point.sensitivity
    assert fine is not None and point.trajectory is not None
    step = COARSER_STEP_FACTOR * SENSITIVITY_STEP
    coarse = task.plant.derivatives.sensitivity(task.theta, point.trajectory, step) or fine
    sensors = (
        *sensors_along(task, fine, coarse, added),
        *_accelerations(task, fine, coarse, accelerations),
    )
    # What no sensor of the task shows, an acceleration may show.
    hidden = identifiability.along_all.directions
    return Sensing(task=task, sensors=sensors, hidden=hidden[:, : 0 if accelerations else None])
