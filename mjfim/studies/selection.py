"""Selection of physical terms that a model lacks, by prediction of left-out data.

A term is added if a score test finds it significant, and if the model with the term predicts data
that were left out of the fit better by more than one standard error (the one-standard-error rule of
Breiman et al., Classification and Regression Trees, 1984). Terms that later ones make needless are
removed by the same rule. Held-out recordings take no part in it: their prediction is an independent
test of the result.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from mjfim.budget import Budget, StopToken, stop_on_interrupt
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.identification.fit_workers import FitWorkers
from mjfim.identification.held_out_losses import HeldOutLosses, Reduction, held_out_losses
from mjfim.identification.horizons import with_length
from mjfim.identification.identify import Callback, fit_task, refit_task
from mjfim.identification.missing_terms import find_missing_terms
from mjfim.identification.report import FitResult, estimate_from
from mjfim.identification.searches import FitSearch
from mjfim.identification.task import FitTask
from mjfim.optimize.levenberg_marquardt import InterruptedPassError
from mjfim.parallel import ExecutorLike, one_blas_thread
from mjfim.records.estimate import Estimate
from mjfim.records.missing_term import MissingTerm, TermParameter
from mjfim.records.progress import begin_stage, shown_progress
from mjfim.records.recording import Recording
from mjfim.records.selection import (
    AlternativeTerm,
    Decision,
    SelectedTerm,
    Selection,
    SelectionStep,
)

# Largest number of terms that are added.
MAX_TERMS = 6

# Terms whose score test promises at least this share of what the best one promises are fitted
# together with it in the first attempt of a step, because the test is linear.
SIMILAR_SHARE = 0.5

# Difference of the costs of two fits (half of the sum of squared residuals in standard deviations)
# below which both explain the data equally well: by one standard deviation at most.
EQUAL_COST = 0.5

# Probability that an interval holds the true value.
CONFIDENCE = 0.95


def select_terms(
    experiment: Experiment,
    recordings: Sequence[Recording],
    *,
    held_out: Sequence[Recording] = (),
    max_terms: int = MAX_TERMS,
    callback: Callback | None = None,
    threads: int | None = None,
    stop: StopToken | None = None,
    progress: bool = True,
    executor: ExecutorLike | None = None,
) -> Estimate:
    """Estimate parameters, and extend the model by the terms that the recordings show it to lack.

    `estimate.selection` says which terms were added and why. The experiment of the extended model
    is `experiment.replace(**estimate.selection.tables)`. Ctrl-C ends the selection with the terms
    so far.

    Args:
        experiment: Model, parameters and noise.
        recordings: Recordings to which the parameters are fitted, and parts of which are predicted
            from the others to choose the terms.
        held_out: Recordings that are neither fitted nor used to choose terms, only predicted.
        max_terms: Largest number of terms that are added.
        callback: Called with every iterate.
        threads: Threads for the engine; default: one per core.
        stop: Token that ends the selection with the terms so far.
        progress: False for no bar of progress in a notebook; a callback replaces the bar as well.
        executor: Where the work is done (`mjfim.ExecutorLike`); None for this process.

    Returns:
        The estimate of the extended model, whose intervals also cover the scatter between the
        estimates without each part of the data.

    Raises:
        ExperimentError: Something is wrong in the experiment or in the arguments.
        RecordingError: A recording cannot be used.
        SimulationDivergedError: The model diverges at the start.
    """
    with shown_progress("selecting terms", callback, progress) as show:
        system = System.resolve(experiment, threads=threads)
        found = select_terms_system(
            system,
            recordings,
            held_out=held_out,
            max_terms=max_terms,
            callback=show,
            stop=stop,
            executor=executor,
        )
    return found.estimate


@dataclass(frozen=True, kw_only=True, eq=False)
class SelectedModel:
    """Result of a selection.

    Attributes:
        estimate: The estimate of the extended model.
        system: The extended model.
    """

    estimate: Estimate
    system: System


def select_terms_system(
    system: System,
    recordings: Sequence[Recording],
    *,
    held_out: Sequence[Recording] = (),
    max_terms: int = MAX_TERMS,
    callback: Callback | None = None,
    stop: StopToken | None = None,
    executor: ExecutorLike | None = None,
) -> SelectedModel:
    """Extend a resolved system by the terms that it lacks. See `select_terms`."""
    begun = time.perf_counter()
    steps_before = system.plant.engine_steps

    with one_blas_thread(), stop_on_interrupt(stop) as token:
        selector = _Selector(
            held_out=tuple(held_out),
            budget=Budget(stop=token),
            callback=callback,
            workers=None if executor is None else FitWorkers(executor, token),
            max_terms=max_terms,
        )
        task = FitTask.of(system, recordings, held_out=held_out)
        estimate, selected = selector.selected(task)

    estimate = replace(
        estimate,
        seconds=time.perf_counter() - begun,
        steps=system.plant.engine_steps - steps_before,
    )
    return SelectedModel(estimate=estimate, system=selected)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Model:
    """A fitted model, with the losses of its predictions of left-out data.

    Attributes:
        result: The fit.
        losses: The losses.
        cost: Cost of the fit with the noise of the fit of the stated model.
        terms: The terms that were added to the stated model.
    """

    result: FitResult
    losses: HeldOutLosses
    cost: float
    terms: tuple[SelectedTerm, ...]

    @property
    def penalised_cost(self) -> float:
        """Cost and the number of parameters of the terms, by which chance reduces it (AIC)."""
        return self.cost + sum(len(term.parameters) for term in self.terms)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Selector:
    """Searches of one selection, which share a budget.

    Attributes:
        held_out: Recordings that are only predicted at the end.
        budget: Budget whose token ends the selection.
        callback: Called with every iterate, or None.
        workers: Workers that do parts of the work; None for this process.
        max_terms: Largest number of added terms.
    """

    held_out: tuple[Recording, ...]
    budget: Budget
    callback: Callback | None
    workers: FitWorkers | None
    max_terms: int

    def selected(self, task: FitTask) -> tuple[Estimate, System]:
        """Estimate of the extended model, and the extended model."""
        result = fit_task(self._search(task), self.workers)
        losses = self._losses(result, result)
        if losses is None:
            ending = "The selection was interrupted, or no part of the data can be left out."
            return estimate_from(result, self.budget), task.system

        first = _Model(result=result, losses=losses, cost=result.solution.cost, terms=())
        steps = [SelectionStep(decision=Decision.BEGUN, error=losses.error)]
        model, ending = self._grown(first, first, steps)
        model = self._pruned(model, first, steps)

        # The chosen model is fitted like any other, with all attempts against local minima, and
        # over the length of segments that suits it.
        result = model.result
        if model.terms and not self._is_stopped():
            final = replace(result.task, start=result.theta, held_out=self.held_out)
            if task.settings.segments is None:
                final = with_length(final, None)
            result = fit_task(self._search(final), self.workers)

        # The report compares the estimate with the guess, not with where the last search began.
        guess = result.task.system.parameters.guess
        result = replace(result, task=replace(result.task, start=guess))
        selection = Selection(terms=model.terms, steps=tuple(steps), ending=ending)
        estimate = estimate_from(result, self.budget)
        final_system = result.task.system
        return _with_selection(estimate, selection, model.losses, final_system), final_system

    # ---- steps

    def _grown(
        self, model: _Model, first: _Model, steps: list[SelectionStep]
    ) -> tuple[_Model, str]:
        """Add terms while they improve the prediction of left-out data.

        Args:
            model: Where to begin.
            first: The stated model.
            steps: Receives the steps.

        Returns:
            The extended model, and why no more terms were added.
        """
        while len(model.terms) < self.max_terms:
            begin_stage(f"looking for term {len(model.terms) + 1} that the model lacks")
            candidates = self._candidates(model)
            if self._is_stopped():
                return model, "The selection was interrupted."
            if not candidates:
                return model, "No further term that was tested is significant."

            # The most promising terms are tried first, and the others if these do not help.
            most = candidates[0].share
            similar = [term for term in candidates if term.share >= SIMILAR_SHARE * most]
            others = [term for term in candidates if term.share < SIMILAR_SHARE * most]
            better = None
            for attempt in (similar, others):
                better = better or self._best_extension(model, first, attempt, steps)
            if self._is_stopped():
                return model, "The selection was interrupted."
            if better is None:
                return model, "No further term predicts left-out data clearly better."
            model = better
        return model, f"{self.max_terms} terms were added, the largest number."

    def _best_extension(
        self,
        model: _Model,
        first: _Model,
        candidates: Sequence[MissingTerm],
        steps: list[SelectionStep],
    ) -> _Model | None:
        """The model with the one of some terms that predicts best; None where none is better."""
        tried: list[tuple[_Model, SelectionStep]] = []
        for candidate in candidates:
            extended = self._extended(model, first, candidate)
            if self._is_stopped():
                return None
            if extended is not None:
                reduction = model.losses.reduction(extended.losses)
                tried.append((extended, _tried(candidate, extended, reduction)))

        # Of the models that do not clearly predict worse than the best one, the one that fits the
        # data best is chosen: the fit uses all data, so that it tells similar terms apart better.
        # Where no data tell terms apart, the first one of the candidates is chosen, so that the
        # choice does not depend on rounding errors.
        clear = [pair for pair in tried if model.losses.reduction(pair[0].losses).is_clear]
        least = min(clear, key=lambda pair: pair[1].error, default=None)
        best = None
        if least is not None:
            similar = [
                pair for pair in clear if not pair[0].losses.reduction(least[0].losses).is_clear
            ]
            highest = min(pair[0].penalised_cost for pair in similar) + EQUAL_COST
            best = next(pair for pair in similar if pair[0].penalised_cost <= highest)
        steps.extend(step for found, step in tried if best is None or found is not best[0])
        if best is None:
            return None

        # What the data do not tell apart is said.
        chosen, step = best
        alternatives = tuple(
            AlternativeTerm(
                description=other.description, path=other.path, values=_stated_values(found, first)
            )
            for found, other in clear
            if found is not chosen and not found.losses.reduction(chosen.losses).is_clear
        )
        count = len(chosen.terms)
        steps.append(replace(step, decision=Decision.ADDED, count=count, alternatives=alternatives))
        return chosen

    def _pruned(self, model: _Model, first: _Model, steps: list[SelectionStep]) -> _Model:
        """Remove terms without which left-out data are predicted as well."""
        while len(model.terms) > 1 and not self._is_stopped():
            begin_stage("testing whether all added terms are needed")
            needless: list[tuple[Reduction, SelectedTerm, _Model]] = []

            # The last term has just been tested against the model without it.
            for term in model.terms[:-1]:
                fewer = self._without(model, first, term)
                if fewer is None:
                    continue
                reduction = fewer.losses.reduction(model.losses)
                if not reduction.is_clear:
                    needless.append((reduction, term, fewer))
            if not needless:
                break

            reduction, term, model = min(needless, key=lambda found: found[0].mean)
            steps.append(
                SelectionStep(
                    decision=Decision.REMOVED,
                    description=term.description,
                    path=term.path,
                    count=len(model.terms),
                    error=model.losses.error,
                    reduction=reduction.mean,
                    standard_error=reduction.standard_error,
                )
            )
        return model

    # ---- models

    def _extended(self, model: _Model, first: _Model, candidate: MissingTerm) -> _Model | None:
        """The model with one term more; None where it cannot be simulated, or after a stop."""
        names = model.result.task.system.parameters.names
        term = selected_term(candidate, names)
        values = dict(zip(names, model.result.theta, strict=True))
        starts = {name: parameter.value for name, parameter in term.further.items()}
        return self._fitted(
            model,
            first,
            (*model.terms, term),
            values,
            {term.name: candidate.value, **starts},
        )

    def _without(self, model: _Model, first: _Model, term: SelectedTerm) -> _Model | None:
        """The model without a term; None where it cannot be simulated, or after a stop."""
        names = model.result.task.system.parameters.names
        values = dict(zip(names, model.result.theta, strict=True))
        terms = tuple(each for each in model.terms if each is not term)
        return self._fitted(model, first, terms, values, {})

    def _fitted(
        self,
        model: _Model,
        first: _Model,
        terms: tuple[SelectedTerm, ...],
        values: dict[str, float],
        changes: dict[str, float],
    ) -> _Model | None:
        """Fit the stated model with some terms, beginning at the fit of a similar model.

        Args:
            model: The similar model.
            first: The stated model.
            terms: The terms.
            values: Values of the parameters where the search begins [theta-unit].
            changes: Values of new parameters: what numbers of the model gain, and values of fields
                of the library of terms [theta-unit].
        """
        stated = first.result.task.system
        tables = Selection(terms=terms, steps=(), ending="").tables
        system = System.resolve(
            stated.experiment.replace(**tables),
            threads=stated.threads,
            source=stated.source,
        )
        parameters = system.parameters
        start = np.array(parameters.guess)
        for i, parameter in enumerate(parameters.parameters):
            change = changes.get(parameter.name, 0.0)
            is_field = parameter.name in changes and parameter.targets[0].term is not None
            start[i] = change if is_field else values.get(parameter.name, start[i]) + change
        start = np.clip(start, parameters.lower, parameters.upper)

        task = FitTask.of(system, first.result.task.recordings, start=start)
        try:
            result = refit_task(self._search(task), model.result, self.workers)
            losses = self._losses(result, first.result)
            weighted = result.problem.with_noise(first.result.problem.noise)
            cost = weighted.cost(result.solution.unknowns)
        except InterruptedPassError:
            return None
        if losses is None:
            return None
        return _Model(result=result, losses=losses, cost=cost, terms=terms)

    def _candidates(self, model: _Model) -> tuple[MissingTerm, ...]:
        """Significant terms that the model lacks, the most promising one first."""
        result = model.result
        unknowns = result.solution.unknowns
        at = replace(unknowns, private=unknowns.private[result.subset])
        problem = result.problem.of_segments(result.subset)
        try:
            return find_missing_terms(problem, result.task.recordings, at)
        except InterruptedPassError:
            return ()

    def _losses(self, result: FitResult, first: FitResult) -> HeldOutLosses | None:
        """Losses of the predictions of left-out data; None after a request to stop."""
        sigma = first.problem.noise.sigma
        try:
            return held_out_losses(result.problem, result.solution, sigma, self.budget)
        except InterruptedPassError:
            return None

    def _search(self, task: FitTask) -> FitSearch:
        """Searches of a task."""
        return FitSearch(task=task, budget=self.budget, callback=self.callback)

    def _is_stopped(self) -> bool:
        """True after a request to stop."""
        return self.budget.stop.requested


def selected_term(candidate: MissingTerm, taken: Iterable[str]) -> SelectedTerm:
    """The term that a candidate stands for, with names of its parameters.

    Args:
        candidate: The candidate.
        taken: Names of the present parameters.
    """
    name = _name_of(candidate.path, taken)
    further: dict[str, TermParameter] = {}
    for parameter in candidate.further:
        used = {*taken, name, *further}
        further[_name_of(parameter.path, used)] = parameter
    return SelectedTerm(
        name=name,
        description=candidate.description,
        path=candidate.path,
        unit=candidate.unit,
        scale=abs(candidate.value),
        further=further,
        added=candidate.added,
        source=candidate.source,
    )


def _stated_values(model: _Model, first: _Model) -> dict[str, float]:
    """Values of the parameters of the stated model in an extended one [theta-unit]."""
    names = model.result.task.system.parameters.names
    values = dict(zip(names, model.result.theta.tolist(), strict=True))
    return {name: values[name] for name in first.result.task.system.parameters.names}


def _tried(candidate: MissingTerm, model: _Model, reduction: Reduction) -> SelectionStep:
    """Step of a term that was tried, before it is decided on."""
    return SelectionStep(
        decision=Decision.REJECTED,
        description=candidate.description,
        path=candidate.path,
        count=len(model.terms) - 1,
        error=model.losses.error,
        reduction=reduction.mean,
        standard_error=reduction.standard_error,
        sigmas=candidate.sigmas,
        share=candidate.share,
    )


def _name_of(path: str, taken: Iterable[str]) -> str:
    """Name of a new parameter, such as `pivot_damping` for `joint/pivot:damping`."""
    place, _, field = path.partition(":")
    words = re.findall(r"\w+", place.partition("/")[2] or place) + re.findall(r"\w+", field)
    name = "_".join(words)
    used = set(taken)
    number = 2
    while name in used:
        name = f"{'_'.join(words)}_{number}"
        number += 1
    return name


def _with_selection(
    estimate: Estimate, selection: Selection, losses: HeldOutLosses, system: System
) -> Estimate:
    """The estimate with its selection.

    The terms were chosen with the same data. Where the scatter between the estimates without each
    part of the data is larger than the interval of the fit, the interval is widened to it.
    """
    jackknife = losses.jackknife
    parts = len(losses.estimates)
    if not selection.terms or parts < 2:
        return replace(estimate, selection=selection)

    quantile = float(scipy.stats.t.ppf(0.5 + 0.5 * CONFIDENCE, parts - 1))
    low = np.minimum(estimate.interval[:, 0], estimate.theta - quantile * jackknife)
    high = np.maximum(estimate.interval[:, 1], estimate.theta + quantile * jackknife)
    interval = np.column_stack([low, high])
    lower, upper = system.parameters.lower, system.parameters.upper
    return replace(
        estimate,
        selection=selection,
        interval=np.clip(interval, lower[:, None], upper[:, None]),
    )
