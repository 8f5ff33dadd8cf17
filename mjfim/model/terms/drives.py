"""Effects of a drive that its ideal actuator lacks: back-EMF, and a lag of its force."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from mjfim.errors import ExperimentError
from mjfim.model.elements import is_rk4
from mjfim.model.sizes import LEAST_MOVE_PER_SAMPLE, control_sizes, model_length
from mjfim.model.terms.term import (
    FieldDescription,
    Term,
    TermQuantity,
    TermTable,
    named_element,
    stated_quantities,
)
from mjfim.model.units import FORCE_UNITS, LENGTH, actuator_gear, force_unit

# Types of gain for which an activation may take the place of the control.
PLAIN_GAINS = (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtGain.mjGAIN_AFFINE)

# Types of bias that such an actuator may have.
PLAIN_BIASES = (mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE)

# Time constant over the timestep where none is stated. It delays by less than a timestep, and yet
# the motion depends on it: a shorter lag has no effect at all, so that no fit could begin there.
SHORT_LAG = 0.5

# Smallest time constant over the timestep. The stages of RK4 need a longer one.
LEAST_LAG = 0.25
LEAST_LAG_RK4 = 0.5

KRAUSE_2013 = (
    "P. Krause, O. Wasynczuk, S. Sudhoff and S. Pekarek, Analysis of Electric Machinery and Drive "
    "Systems, 3rd edition, IEEE Press, 2013"
)
MUJOCO_DCMOTOR = "MuJoCo DC Motor Model, technical note of MuJoCo 4.0"


@dataclass(frozen=True, kw_only=True)
class ActuatorLag(Term):
    """First-order lag between the control of an actuator and its effect.

    Attributes:
        actuator: Name of the actuator.
        explicit: Whether the integrator is RK4, which takes the lag through its stages.
    """

    kind = "actuator_lag"
    description = (
        "First-order lag of an actuator, such as that of a current controller: an activation "
        "follows the control and acts in its place."
    )
    equation = "force = gain · a + bias, ȧ = (control - a)/time_constant"
    elements = "dyntype filterexact and actearly of the actuator; with RK4 dyntype filter"
    acts_on = "actuator"
    fields = (
        FieldDescription(name="time_constant", description="time constant of the lag", unit="s"),
    )
    sources = (KRAUSE_2013,)
    words = "a lag of {}"
    size = "time_constant"
    words = "a lag of {}"
    size = "time_constant"

    actuator: str
    explicit: bool

    @classmethod
    def of(cls, table: TermTable, model: Any, period: float) -> ActuatorLag:
        """Resolve the term for an actuator without dynamics."""
        name, number = named_element(table, "actuator", model, cls.kind)
        _require_plain(model, name, number, cls.kind)

        # With `actearly` the actuator acts within the same step, so that a vanishing lag would be
        # the actuator without it. RK4 takes the activation through its stages.
        timestep = float(model.opt.timestep)
        explicit = is_rk4(model)
        least = (LEAST_LAG_RK4 if explicit else LEAST_LAG) * timestep
        lag = TermQuantity(
            value=SHORT_LAG * timestep,
            unit="s",
            size=period,
            bounds=(least, np.inf),
            numbers=((f"actuator/{name}:dynprm[0]", 1.0),),
        )
        quantities = stated_quantities(cls.kind, table, {"time_constant": lag})
        (_, stated), *_ = quantities
        if stated.value < least:
            raise ExperimentError(
                f"values.time_constant: {stated.value:g} s is too short to have an effect; state "
                f"at least {least:g} s"
            )
        return cls(
            name=table.name,
            actuator=name,
            explicit=explicit,
            quantities=quantities,
        )

    def edit(self, spec: Any) -> None:
        """Give the actuator an activation."""
        actuator = spec.actuator(self.actuator)
        filters = (mujoco.mjtDyn.mjDYN_FILTEREXACT, mujoco.mjtDyn.mjDYN_FILTER)
        actuator.dyntype = filters[self.explicit]
        actuator.actearly = not self.explicit

        dynamics = np.array(actuator.dynprm)
        dynamics[0] = self.value("time_constant")
        actuator.dynprm = dynamics


@dataclass(frozen=True, kw_only=True)
class BackEmf(Term):
    """Back-EMF of a motor whose control is a voltage.

    Attributes:
        actuator: Name of the actuator.
    """

    kind = "back_emf"
    description = (
        "Back-EMF of a motor that is driven by a voltage: its force falls with the speed. The "
        "gain of the actuator is K/R; K is the motor constant, R the resistance."
    )
    equation = "force = gain · (control - constant · actuator velocity)"
    elements = "biastype affine of the actuator, biasprm[2] = -gain · constant"
    acts_on = "actuator"
    fields = (
        FieldDescription(
            name="constant", description="back-EMF constant K [control · s/rad]", unit="V s/rad"
        ),
    )
    sources = (KRAUSE_2013, MUJOCO_DCMOTOR)
    # The damping depends on the gain, which may be a parameter as well.
    is_written_as_a_whole = True

    actuator: str

    @classmethod
    def of(cls, table: TermTable, model: Any, period: float) -> BackEmf:
        """Resolve the term for a direct drive."""
        name, number = named_element(table, "actuator", model, cls.kind)
        _require_plain(model, name, number, cls.kind)
        fixed, none = int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtBias.mjBIAS_NONE)
        is_direct = int(model.actuator_gaintype[number]) == fixed
        if not is_direct or int(model.actuator_biastype[number]) != none:
            raise ExperimentError(
                f"actuator: {name!r} is no direct drive (constant gain, no bias); a servo has its "
                "own damping, `actuator/<name>:kv`"
            )

        time = period / LEAST_MOVE_PER_SAMPLE
        control = float(control_sizes(model, time)[int(model.actuator_ctrladr[number])])
        slides = force_unit(model, number) == FORCE_UNITS[LENGTH]
        length = model_length(model) if slides else 1.0
        size = control * time / (length * (abs(actuator_gear(model, number)) or 1.0))
        quantity = TermQuantity(
            value=0.0,
            unit="",
            size=size,
            bounds=(0.0, np.inf),
            numbers=((f"actuator/{name}:biasprm[2]", 1.0),),
        )
        quantities = stated_quantities(cls.kind, table, {"constant": quantity})
        return cls(name=table.name, actuator=name, quantities=quantities)

    def write(self, model: Any, values: Mapping[str, float]) -> None:
        """Write the damping that belongs to the gain in the model."""
        row = model.actuator(self.actuator).id
        gain = model.actuator_gainprm[row, 0]
        model.actuator_biasprm[row, 2] = -gain * values["constant"]

    def edit(self, spec: Any) -> None:
        """Give the actuator a bias that is proportional to the velocity."""
        actuator = spec.actuator(self.actuator)
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        bias = np.zeros(len(actuator.biasprm))
        bias[2] = -float(actuator.gainprm[0]) * self.value("constant")
        actuator.biasprm = bias


def _require_plain(model: Any, name: str, number: int, kind: str) -> None:
    """Raise ExperimentError for an actuator with dynamics, or with a gain of another type."""
    has_dynamics = int(model.actuator_dyntype[number]) != int(mujoco.mjtDyn.mjDYN_NONE)
    is_plain = int(model.actuator_gaintype[number]) in [int(gain) for gain in PLAIN_GAINS]
    has_bias = int(model.actuator_biastype[number]) in [int(bias) for bias in PLAIN_BIASES]
    if has_dynamics or not (is_plain and has_bias) or int(model.actuator_ctrlnum[number]) != 1:
        raise ExperimentError(
            f"actuator: {name!r} has dynamics or a gain of its own; a term of kind {kind!r} needs "
            "an actuator without dynamics, such as <motor>, <position> or <velocity>"
        )
