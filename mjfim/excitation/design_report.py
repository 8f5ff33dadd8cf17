"""The record of a design: its evaluation, its limits, its warnings and its status."""

from __future__ import annotations

from dataclasses import dataclass

from mjfim.excitation.evaluation import design_warnings, evaluate_point
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.objective import DesignPoint
from mjfim.excitation.task import DesignTask
from mjfim.excitation.verification import Verification, verify
from mjfim.excitation.violations import all_violations_of
from mjfim.experiment.labels import labels_of_system
from mjfim.information.identifiability import Identifiability
from mjfim.information.marginal import shared
from mjfim.information.smoothness import roughness
from mjfim.plant.active_constraints import saturated_actuators
from mjfim.records.design import (
    Design,
    Evaluation,
    HistoryRow,
    ScaledStart,
    StartResult,
    Status,
    improvement_per_iteration,
    without_motions,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Ending:
    """How the search for a design has ended.

    Attributes:
        name: Name of the initial control from which the design was found.
        status: Outcome of its descent.
        slope: Slope of the cost at the last iterate.
        history: Iterates.
        starts: Result of every initial control.
    """

    name: str
    status: Status
    slope: float
    history: tuple[HistoryRow, ...]
    starts: tuple[StartResult, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class DesignReport:
    """Evaluation of a design, from which its record is made.

    Attributes:
        stage: The stated level.
        identifiability: The combinations that can be identified.
        initial: The initial control, evaluated.
        final: The designed control, evaluated.
        played: The task with the initial state of the design; None where it is the stated one.
        remarks: Warnings that belong to the search.
        scaled_start: The largest share of an initial control outside limits that keeps them.
    """

    stage: DescentLevel
    identifiability: Identifiability
    initial: DesignPoint
    final: DesignPoint
    played: DesignTask | None = None
    remarks: tuple[str, ...] = ()
    scaled_start: ScaledStart | None = None

    def design(
        self,
        best: Ending,
        seconds: float,
        steps: int,
        interrupted: bool,
    ) -> Design:
        """The design of the best run, with its warnings."""
        task = self.stage.task
        initial = evaluate_point(self.stage, self.initial)
        final = evaluate_point(self.stage, self.final)

        # The limits, on the model as the user wrote it.
        found = verify(self.played or task, final.trajectory)
        model = task.system.model_at(task.theta)
        clamped = saturated_actuators(model, final.trajectory)

        # Check that derivatives exist along the design; after Ctrl-C this would take too long.
        rough = None
        if not interrupted:
            rough = roughness(
                task.plant,
                task.system.noise,
                model,
                task.theta,
                final.trajectory,
                self.final.sensitivity,
            )

        status = Status.INTERRUPTED if interrupted else best.status
        if status.ended_as_planned and (rough is not None or clamped):
            status = Status.ROUGH
        if task.is_limited and not found.is_feasible and not interrupted:
            status = Status.INFEASIBLE

        warnings = (*design_warnings(final, found, task, clamped, rough), *self.remarks)
        return self._record(
            best=best,
            seconds=seconds,
            steps=steps,
            status=status,
            initial=initial,
            final=final,
            found=found,
            warnings=warnings,
        )

    def _record(
        self,
        *,
        best: Ending,
        seconds: float,
        steps: int,
        status: Status,
        initial: Evaluation,
        final: Evaluation,
        found: Verification,
        warnings: tuple[str, ...],
    ) -> Design:
        """The record of the design."""
        task = self.stage.task
        information = self.stage.problem.information
        parameters = task.parameters
        combined = self.identifiability.combinations(
            information, task.theta[parameters.interest], initial.information, final.information
        )
        data = shared(
            information.without_round_off(final.information - task.prior),
            parameters.prior_information,
            parameters.recording_specific,
        )
        history, motions = without_motions(best.history)
        return Design(
            status=status,
            parameters=parameters.names,
            theta=task.theta,
            initial=initial,
            final=final,
            history=history,
            slope=best.slope,
            steps=steps,
            seconds=seconds,
            limits=found.margins,
            usage=found.usage,
            initial_violations=all_violations_of(task, initial.trajectory),
            scaled_start=self.scaled_start,
            warnings=warnings,
            found_by=best.name,
            starts=best.starts,
            nuisance=tuple(p.name for p in parameters.parameters if p.nuisance),
            combinations=tuple(str(group) for group in self.identifiability.groups_along_all),
            combined=combined,
            prior=task.prior,
            data=data,
            labels=labels_of_system(task.system),
            sizes=parameters.sizes(task.theta),
            motions=motions,
            improvement=improvement_per_iteration(history, self.stage.problem.size(self.final)),
        )
