"""Requirements of a design: parameters that have an effect, and a start that shows it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from mjfim.errors import SimulationDivergedError, UnidentifiableError, first_ones, listed
from mjfim.excitation.objective import DesignPoint
from mjfim.excitation.task import DesignTask
from mjfim.information.identifiability import PROBES, Identifiability
from mjfim.plant.mixed_derivatives import CENTRAL_DIFFERENCES
from mjfim.records.check import GROUPS_TEXT, ParameterGroup, groups_in_words


def identifiability_along(task: DesignTask, begin: DesignPoint) -> Identifiability:
    """Find the combinations of parameters that can be identified.

    They are looked for along the control with which the search begins and along random controls.
    """
    require_evaluated(task, begin)
    if begin.trajectory is None or begin.sensitivity is None:
        raise SimulationDivergedError("the trajectory diverges")
    return task.identifiability_test.along(begin.trajectory, begin.sensitivity)


def require_evaluated(task: DesignTask, begin: DesignPoint) -> None:
    """Raise SimulationDivergedError where the control with which a search begins diverges."""
    values = (begin.information, begin.trajectory, begin.sensitivity)
    if all(value is not None for value in values):
        return

    reason = "when the parameters change slightly along the initial control"
    if task.samples_of_parameters is not None:
        reason += (
            ", or at a parameter sample of [robust]; state bounds within which the model is valid"
        )
    raise SimulationDivergedError(f"the simulation diverges {reason}")


def designable(task: DesignTask) -> Identifiability:
    """Find what can be identified, and require that a design can begin at the initial control.

    Args:
        task: The task.

    Returns:
        The combinations that are identifiable along the initial control and along random ones.

    Raises:
        UnidentifiableError: A parameter has no effect, or the initial control does not excite it.
        SimulationDivergedError: The simulation diverges along the initial control.
    """
    first = task.problem.point(task.initial, CENTRAL_DIFFERENCES)
    identifiability = identifiability_along(task, first)
    require_designable(task, identifiability)
    return identifiability


def require_designable(task: DesignTask, identifiability: Identifiability) -> None:
    """Require that every parameter has an effect, and that the initial control excites it.

    The initial control has to excite every combination of parameters that a random control
    excites. Members of a declared inertia may have no effect; the design then works on the
    combinations that have one.

    Args:
        task: The task.
        identifiability: The combinations that can be identified.

    Raises:
        UnidentifiableError: A parameter has no effect on the outputs, or the initial control does
            not excite it.
    """
    along_all = identifiability.along_all
    parameters = task.parameters
    estimated = [parameters.parameters[j] for j in parameters.interest]

    # Parameters without any effect.
    tried = "control" if task.release is None else "release"
    silent = [estimated[i].name for i in along_all.silent if not estimated[i].group]
    if silent:
        raise UnidentifiableError(
            f"{_subject(silent)} nothing in the measured outputs, neither along the initial "
            f"{tried} nor along {PROBES} random {tried}s; remove "
            f"{'it' if len(silent) == 1 else 'them'}, or measure a quantity that shows the effect"
        )

    # A criterion for combinations that cannot be identified.
    if task.contrast is not None:
        information = replace(task.information, basis=identifiability.basis)
        if not information.is_estimable(task.contrast).all():
            raise UnidentifiableError(
                "cost.combination or cost.subset states a combination that cannot be identified; "
                "identifiable are: " + groups_in_words(identifiability.groups_along_all)
            )

    if not along_all.basis.shape[1]:
        raise UnidentifiableError("no parameter has an effect on the measured outputs")

    # Combinations that random controls excite, but not the initial one. A search over all releases
    # does not need it.
    if task.release is not None:
        return
    if identifiability.along_trajectory.count > along_all.count:
        groups = identifiability.groups_along_trajectory
        unexcited = first_ones([_unexcited_group(group) for group in groups], "; ", GROUPS_TEXT)
        raise UnidentifiableError(
            f"the initial control does not excite: {unexcited}. Other controls do: begin with one "
            "that moves the joints of these parameters, for example a multisine"
        )


def _unexcited_group(group: ParameterGroup) -> str:
    """Name of a group that has an effect, but not along the initial control."""
    return group.short if group.combinations else group.short_names


def _subject(names: Sequence[str]) -> str:
    """Beginning of a sentence about some parameters."""
    quoted = listed([f"parameters.{name}" for name in names])
    return f"{quoted} {'changes' if len(names) == 1 else 'change'}"
