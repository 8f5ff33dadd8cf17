"""Answer of a design to its initial control: whether it refuses it, and the limits it violates."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mjfim.errors import MjfimError, first_ones
from mjfim.excitation.designable import require_designable
from mjfim.excitation.evaluation import growth_along, growth_warning
from mjfim.excitation.initial_controls import initial_controls_of
from mjfim.excitation.levels import require_coarse_factor
from mjfim.excitation.task import DesignTask
from mjfim.excitation.verification import require_feasible_start
from mjfim.excitation.violations import all_violations_of
from mjfim.information.identifiability import Identifiability
from mjfim.records.design import LimitViolation


@dataclass(frozen=True, kw_only=True)
class DesignOutlook:
    """Judgement of a design about the initial control, before it begins.

    Attributes:
        refused: Reasons why a design refuses the experiment, in its own words; empty where it does
            not.
        violations: Limits that the motion of the initial control violates.
        warning: Warning about strong growth of disturbances; empty without.
    """

    refused: tuple[str, ...] = ()
    violations: tuple[LimitViolation, ...] = ()
    warning: str = ""

    @classmethod
    def of(cls, task: DesignTask, identifiability: Identifiability) -> DesignOutlook:
        """Look at the initial control as a design does, before it begins.

        Args:
            task: The task.
            identifiability: The combinations that can be identified.
        """
        # Without actuators there is no control that a design could begin with.
        if not task.controls or task.release is not None:
            return cls()

        reasons = (
            _refusal(lambda: require_feasible_start(task)),
            _refusal(lambda: require_coarse_factor(task)),
            _refusal(lambda: initial_controls_of(task, None)),
            _refusal(lambda: require_designable(task, identifiability)),
        )
        refused = tuple(reason for reason in reasons if reason)

        # A start that cannot be kept says all about the limits.
        violations: tuple[LimitViolation, ...] = ()
        if not reasons[0]:
            violations = all_violations_of(task, task.initial)
        return cls(
            refused=refused,
            violations=violations,
            warning=growth_warning(growth_along(task, task.initial)) or "",
        )

    def sentences(self) -> tuple[str, ...]:
        """Sentences for the verdict of a check."""
        said = [f"`mjfim design` refuses this experiment: {reason}" for reason in self.refused]
        if self.violations:
            broken = first_ones([str(violation) for violation in self.violations], "; ")
            said.append(
                f"the initial control violates limits: {broken}; σ is that of a motion outside the "
                "limits. A design looks for a motion inside"
            )
        return (*said, *([self.warning] if self.warning else []))


def _refusal(require: Callable[[], object]) -> str:
    """The message of the error that a requirement raises; empty where it holds."""
    try:
        require()
    except MjfimError as error:
        return str(error)
    return ""
