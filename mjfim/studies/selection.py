"""Selection of physical terms that a model lacks, by prediction of left-out data.

A term is added if a score test finds it significant, and if the model with the term predicts data
that were left out of the fit better by more than one standard error (the one-standard-error rule of
Breiman et al., Classification and Regression Trees, 1984). Terms that later ones make needless are
removed by the same rule. Held-out recordings take no part in it: their prediction is an independent
test of the result.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mjfim.errors import SimulationDivergedError, listed
from mjfim.experiment.arguments import checked
from mjfim.experiment.given import RecordingsLike, recordings_of
from mjfim.experiment.schema import ExperimentLike
from mjfim.experiment.system import System
from mjfim.identification.assessment.accuracy import FitResult
from mjfim.identification.assessment.report import estimate_from
from mjfim.identification.assessment.term_tests import find_missing_terms, with_names
from mjfim.identification.fit_problem import have_same_initial_states
from mjfim.identification.fit_workers import FitWorkers
from mjfim.identification.identify import Callback, fit_task, is_doubtful, refit_task
from mjfim.identification.left_out import HeldOutLosses, held_out_losses
from mjfim.identification.search import FitSearch, FitTask, with_length
from mjfim.identification.starts import MIN_ROWS
from mjfim.parallel import ExecutorLike, one_blas_thread
from mjfim.parallel.budget import Budget, StopToken, stop_on_interrupt
from mjfim.records.estimate import Estimate
from mjfim.records.events import begin_stage, shown_progress
from mjfim.records.terms import (
    AlternativeTerm,
    Decision,
    HeldOutRefit,
    Selection,
    SelectionStep,
    Term,
)
from mjfim.records.trajectory import Recording
from mjfim.studies.selected_models import (
    FittedModel,
    different,
    poorly_known,
    possible_pools,
    selected_experiment,
    start_of,
    values_of,
    with_selection,
)

# Largest number of terms that are added.
MAX_TERMS = 6

# Terms whose score test promises at least this share of what the best one promises are fitted
# together with it in the first attempt of a step, because the test is linear.
SIMILAR_SHARE = 0.5

# Largest number of poorly known parameters that are held one by one.
MAX_HELD_ATTEMPTS = 8

# Ratio of the errors of left-out data, above which a simpler model predicts worse, even where the
# data are too few for a clear difference.
WORSE_ERROR_RATIO = 1.02

# Engine steps of one linearisation, above which terms are chosen on segments spread over the
# recordings, and the least number of these segments. A selection makes a hundred linearisations.
# The selected model is fitted to more of them at last.
MAX_STEPS = 100_000
MIN_SEGMENTS = 20
MORE_SEGMENTS = 5.0

# Largest number of final fits, each of which may show further terms.
MAX_FINAL_FITS = 3

# Difference of the costs of two fits (half of the sum of squared residuals in standard deviations)
# below which both explain the data equally well: by one standard deviation at most.
EQUAL_COST = 0.5

# Why a selection ended, after a request to stop.
INTERRUPTED = "The selection was interrupted."

# Share of the estimated size of a new term at which it has hardly any effect.
SMALL_EFFECT = 0.01


@checked
def select_terms(
    experiment: ExperimentLike,
    recordings: RecordingsLike,
    *,
    held_out: RecordingsLike = (),
    max_terms: int = MAX_TERMS,
    callback: Callback | None = None,
    threads: int | None = None,
    stop: StopToken | None = None,
    progress: bool = True,
    executor: ExecutorLike | None = None,
) -> Estimate:
    """Estimate parameters, and extend the model by the terms that the recordings show it to lack.

    Of long recordings, segments are fitted that are spread over them, and a warning says so.
    `estimate.selection` says which terms were added and why. Parameters that the recordings hardly
    determine are pooled, or held at their guess, where left-out data are predicted as well without
    them. The experiment of the selected model is `mjfim.selected_experiment(experiment,
    estimate.selection)`. Ctrl-C ends the selection with the terms so far.

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
        begun = time.perf_counter()
        system = System.resolve(experiment, threads=threads)
        fitted, kept = recordings_of(system, recordings), recordings_of(system, held_out)
        with one_blas_thread(), stop_on_interrupt(stop) as token:
            selector = _Selector(
                held_out=kept,
                budget=Budget(stop=token),
                callback=show,
                workers=None if executor is None else FitWorkers(executor),
                max_terms=max_terms,
            )
            found = selector.selected(FitTask.of(system, fitted, held_out=kept))
    seconds = time.perf_counter() - begun
    return replace(found, seconds=seconds, steps=system.plant.engine_steps)


@dataclass(kw_only=True)
class _Selector:
    """One selection: its searches share a budget, and every attempt is kept as a step."""

    held_out: tuple[Recording, ...]
    budget: Budget
    callback: Callback | None
    workers: FitWorkers | None
    max_terms: int
    steps: list[SelectionStep] = field(default_factory=list)
    ending: str = ""
    first: FittedModel = field(init=False)

    def selected(self, task: FitTask) -> Estimate:
        """Estimate of the extended model.

        Where the length of the segments is left to the fit, terms are chosen by whole recordings
        first, and once more over the length that the final fit needs.

        Args:
            task: The fit of the stated model.
        """
        stated, task = task, self._affordable(task)
        is_free = task.settings.segments is None
        result = fit_task(
            self._search(with_length(task, "whole") if is_free else task), self.workers
        )
        self.first = FittedModel(result=result, cost=result.solution.cost)
        model = self._assessed(self.first)
        if model is None:
            return self._unselected(result, is_free)
        self.first = model
        self._add(Decision.BEGUN, model)

        model, is_whole = self._chosen(model), is_free
        for _ in range(MAX_FINAL_FITS):
            final = self._final(model.result, is_whole, is_changed=model.is_changed)
            if final is model.result:
                break
            model = self._at_final_fit(model, final, is_whole)
            is_whole &= final.task.settings.segment_length is None
            if model.result is final:
                break
        if task is not stated and not self._is_stopped():
            model = self._on_more_data(model, stated.settings.seconds or np.inf)
        return self._selected(model, is_free)

    def _affordable(self, task: FitTask) -> FitTask:
        """The task on as many segments, spread over the recordings, as a selection can fit."""
        problem = task.problem()
        simulations = 1 + problem.column_count + problem.private_count
        dt, whole = problem.system.dt, problem.sample_count
        length = task.settings.segment_length
        least = MIN_ROWS if length is None else round(length / dt)
        samples = MAX_STEPS // (simulations * problem.system.grid.substeps)
        samples = max(samples, MIN_SEGMENTS * least)
        # Segments have free initial states, which parameters cannot move.
        is_moved = problem.system.plant.initial_state_derivative.any()
        if whole <= samples or is_moved:
            return task
        seconds = samples * dt
        task = with_length(task, length or seconds / MIN_SEGMENTS, seconds)
        return replace(task, predicts_whole=length is None)

    def _on_more_data(self, model: FittedModel, most: float) -> FittedModel:
        """The model fitted to more segments of long recordings, `most` seconds at most.

        It stays the same where that diverges, and after a request to stop.
        """
        begin_stage("fitting the selected model to more data")
        result, task = model.result, self._predicting(model.result)
        more = min(MORE_SEGMENTS * (task.settings.seconds or 0.0), most)
        task = with_length(task, task.settings.segments, more)
        try:
            result = refit_task(self._search(task), result, self.workers, is_only_compared=False)
        except SimulationDivergedError:
            return model
        return model if self._is_stopped() else replace(model, result=result, tests=None)

    def _selected(self, model: FittedModel, is_free: bool) -> Estimate:
        """Estimate of the chosen model."""
        # The fit is reported as one that began at the guess.
        result, task = model.result, model.result.task
        task = replace(task, start=task.system.parameters.guess)
        if is_free and task.settings.segment_length is None:
            task = with_length(task, None)
        result = replace(result, task=task)
        selection = self._selection(model)
        tests = None if result.quality.unexplained or self._is_stopped() else model.tests
        estimate = estimate_from(result, self.budget, selection.refuted, tests)
        if selection.is_changed:
            settings = result.task.settings
            selection = replace(
                selection,
                refit=self._refit_to_held_out(result, estimate),
                hold=settings.hold,
                segments=settings.segment_length if is_free else None,
            )
        return with_selection(estimate, selection, model.losses, result.task.system)

    def _unselected(self, result: FitResult, is_free: bool) -> Estimate:
        """Estimate of the stated model where no term could be tried."""
        self.ending = "The selection was interrupted before a term was tried."
        if not self._is_stopped():
            self.ending = (
                "No part of the recordings could be predicted from the others, so that no term "
                "was tried."
            )
        final = self._final(result, is_free, is_changed=False)
        self.steps.append(SelectionStep(decision=Decision.BEGUN, error=np.nan))
        return self._selected(replace(self.first, result=final), is_free)

    def _refit_to_held_out(self, result: FitResult, estimate: Estimate) -> HeldOutRefit | None:
        """Fit the selected model to the held-out recordings; None without any, or after a stop."""
        if not self.held_out or self._is_stopped():
            return None
        begin_stage("fitting the selected model to the held-out recordings")
        task = FitTask.of(result.task.system, self.held_out, start=estimate.theta)
        try:
            found = fit_task(self._search(task), self.workers, checks_log=False)
        except SimulationDivergedError:
            return None
        interval = found.accuracy.interval
        differs = different(estimate, found.theta, interval, result.task.system.parameters)
        return found.theta, interval, differs

    def _final(self, result: FitResult, is_free: bool, *, is_changed: bool) -> FitResult:
        """The fit of the chosen model, with all attempts against local minima."""
        is_settled = not is_changed and not (is_free and is_doubtful(result))
        if is_settled or self._is_stopped():
            return result
        final = self._predicting(result)
        if is_free:
            final = with_length(final, None)

        # Over segments of a stated length, a search from one start is all that there is, unless it
        # begins at the equation of motion.
        settings = final.settings
        begins_at_guess = settings.starts == 1 and settings.start != "inverse_dynamics"
        if settings.segment_length is None or not begins_at_guess or is_free:
            return fit_task(self._search(final), self.workers, checks_log=False)
        return refit_task(self._search(final), result, self.workers, is_only_compared=False)

    def _predicting(self, result: FitResult) -> FitTask:
        """The task of a fit that begins at another one and predicts the held-out recordings."""
        whole = self.first.result.task.predicts_whole
        return replace(
            result.task, start=result.theta, held_out=self.held_out, predicts_whole=whole
        )

    def _at_final_fit(self, model: FittedModel, result: FitResult, is_free: bool) -> FittedModel:
        """The model at its final fit, with the terms that only this fit shows.

        Left-out data are predicted from this fit anew: further terms are compared with it, and its
        intervals are widened by the scatter between these fits.
        """
        final = replace(model, result=result, cost=self._cost(result))
        length = result.task.settings.segment_length
        if is_free and length is not None:
            of_length = with_length(self.first.result.task, length)
            self.first = replace(self.first, result=replace(self.first.result, task=of_length))
            cut = self._assessed(final)
            if cut is None:
                return replace(final, tests=None)
            self._add(Decision.SHORTENED, cut, f"segments of {length:.2g} s")
            return self._chosen(cut)

        counts = [len(each.problem.segments) for each in (result, model.result)]
        if counts[0] == counts[1] and abs(final.cost - model.cost) <= EQUAL_COST:
            return final
        cut = self._assessed(final) if model.is_changed else None
        return replace(final, tests=None) if cut is None else self._grown_again(cut)

    # ---- steps

    def _add(
        self, decision: Decision, model: FittedModel, description: str = "", **changes: object
    ) -> None:
        """Add a step whose model was decided on."""
        step = SelectionStep(
            decision=decision,
            description=description,
            count=len(model.terms),
            error=model.losses.error,
        )
        self.steps.append(replace(step, **changes))  # type: ignore[arg-type]

    def _selection(self, model: FittedModel) -> Selection:
        """The changes of a model, and the steps so far."""
        return Selection(
            terms=model.terms,
            steps=tuple(self.steps),
            ending=self.ending,
            pooled=model.pooled,
            held=model.held,
        )

    def _chosen(self, model: FittedModel) -> FittedModel:
        """Add terms, remove needless ones, and simplify the parameters."""
        model = self._pruned(self._grown(model))
        if self.first.result.task.settings.seconds is not None:
            # What segments of long logs hardly determine may be clear in all of them.
            return model
        simpler = self._simplified(model)
        # Terms may have stood in for parameters that are held or pooled now. Without them, others
        # may be significant that were not tried before.
        if simpler is not model:
            simpler = self._grown_again(self._pruned(simpler, tests_last=True))
        return simpler

    def _grown_again(self, model: FittedModel) -> FittedModel:
        """Add terms that no step has refuted."""
        return self._grown(model, self._selection(model).refuted)

    def _grown(self, model: FittedModel, refuted: Collection[str] = ()) -> FittedModel:
        """Add terms while they improve the prediction of left-out data, and say why it ended.

        Args:
            model: The model.
            refuted: Terms that are not tried.
        """
        while len(model.terms) < self.max_terms:
            if self._is_stopped():
                self.ending = INTERRUPTED
                return model
            begin_stage(f"looking for term {len(model.terms) + 1} that the model lacks")
            result = model.result
            tests = model.tests or find_missing_terms(result.problem, result.solution.unknowns)
            model = replace(model, tests=tests)
            candidates = tests.without(refuted).terms
            if not candidates:
                self.ending = f"No further term that was tested is significant.{tests.remark}"
                return model

            # The most promising terms are tried first, and the others if these do not help.
            better = None
            for is_similar in (True, False):
                attempt = [
                    term
                    for term in candidates
                    if (term.share >= SIMILAR_SHARE * candidates[0].share) == is_similar
                ]
                better = better or self._best_extension(model, attempt)
            if better is None or self._is_stopped():
                self.ending = (
                    INTERRUPTED
                    if self._is_stopped()
                    else f"No further term predicts left-out data clearly better.{tests.remark}"
                )
                return model
            model = better
        self.ending = f"{self.max_terms} terms were added, the largest number."
        return model

    def _best_extension(self, model: FittedModel, candidates: Sequence[Term]) -> FittedModel | None:
        """The model with the one of some terms that predicts best; None where none is better."""
        tried = [self._tried(model, candidate) for candidate in candidates]
        if self._is_stopped():
            return None
        extended = [pair for pair in tried if pair is not None]

        # Of the models that do not clearly predict worse than the best one, the one that fits the
        # data best is chosen: the fit uses all data, so that it tells similar terms apart better.
        # Where no data tell terms apart, the first one of the candidates is chosen, so that the
        # choice does not depend on rounding errors.
        clear = [pair for pair in extended if model.losses.is_clearly_above(pair[0].losses)]
        if not clear:
            self.steps.extend(step for _, step in extended)
            return None
        least = min(clear, key=lambda pair: pair[1].error)[0]
        similar = [pair for pair in clear if not pair[0].losses.is_clearly_above(least.losses)]
        highest = min(pair[0].penalised_cost for pair in similar) + EQUAL_COST
        chosen, step = next(pair for pair in similar if pair[0].penalised_cost <= highest)
        self.steps.extend(other for found, other in extended if found is not chosen)

        # What the data do not tell apart is said.
        stated = self.first.result.task.system.parameters.names
        alternatives = tuple(
            AlternativeTerm(
                description=other.description,
                path=other.path,
                values={n: v for n, v in values_of(found).items() if n in stated},
            )
            for found, other in clear
            if found is not chosen and not found.losses.is_clearly_above(chosen.losses)
        )
        count = len(chosen.terms)
        self.steps.append(
            replace(step, decision=Decision.ADDED, count=count, alternatives=alternatives)
        )
        return chosen

    def _pruned(self, model: FittedModel, *, tests_last: bool = False) -> FittedModel:
        """Remove terms without which left-out data are predicted as well.

        Args:
            model: The model.
            tests_last: Whether the last term is tested too, which need not have been compared with
                the same other parameters.
        """
        while tested := model.terms if tests_last else model.terms[:-1]:
            begin_stage("testing whether all added terms are needed")
            tried = [(term, self._without(model, term)) for term in tested]
            needless = [
                (fewer.losses.reduction(model.losses), term, fewer)
                for term, fewer in tried
                if fewer is not None and not fewer.losses.is_clearly_above(model.losses)
            ]
            if not needless:
                break
            (reduction, error), term, model = min(needless, key=lambda found: found[0])
            self._add(
                Decision.REMOVED,
                model,
                term.description,
                path=term.path,
                joints=term.joints,
                reduction=reduction,
                standard_error=error,
            )
        return model

    def _simplified(self, model: FittedModel) -> FittedModel:
        """Pool or hold poorly known parameters as long as the prediction stays as good."""
        begin_stage("testing whether poorly known parameters are needed")
        for pool in possible_pools(self.first.result.task.system.parameters, poorly_known(model)):
            words = f"one value of {pool.name} for {listed(pool.members)}"
            changed = replace(model, pooled=(*model.pooled, pool))
            model = self._simpler(model, changed, Decision.POOLED, words)

        # All of those that are still poorly known are held at once, or else one by one.
        names = poorly_known(model)
        attempts = [names] if len(names) > 1 else []
        attempts += [(name,) for name in names[:MAX_HELD_ATTEMPTS]]
        for attempt in attempts:
            # One parameter at least is left to the fit.
            task = model.result.task
            is_all = {*task.settings.hold, *attempt} >= set(task.system.parameters.names)
            if not is_all and not set(attempt) <= set(model.held):
                changed = replace(model, held=(*model.held, *attempt))
                model = self._simpler(model, changed, Decision.HELD, listed(attempt))
        return model

    def _simpler(
        self, model: FittedModel, changed: FittedModel, decision: Decision, words: str
    ) -> FittedModel:
        """A simpler model, if it predicts left-out data as well; otherwise the model itself."""
        simpler = self._assessed(self._fitted(changed))
        if simpler is None:
            return model
        reduction, standard_error = simpler.losses.reduction(model.losses)
        is_worse = (
            simpler.losses.is_clearly_above(model.losses)
            or simpler.losses.error > WORSE_ERROR_RATIO * model.losses.error
        )
        self._add(
            Decision.KEPT if is_worse else decision,
            simpler,
            words,
            reduction=-reduction,
            standard_error=standard_error,
        )
        return model if is_worse else simpler

    # ---- models

    def _tried(
        self, model: FittedModel, candidate: Term
    ) -> tuple[FittedModel, SelectionStep] | None:
        """The model with one term more, and the step that tried it, before it is decided on.

        None where the fit is no better, so that left-out data need not be predicted, where the
        model cannot be simulated, and after a request to stop. A fit is better by Akaike's
        criterion, which leaving out data approximates (Stone, 1977).
        """
        term = with_names(candidate, model.result.task.system.parameters.names)
        fit = self._fitted(replace(model, terms=(*model.terms, term)), term)
        if fit is None:
            return None
        step = SelectionStep(
            decision=Decision.UNHELPFUL,
            description=candidate.description,
            path=candidate.path,
            count=len(model.terms),
            error=np.nan,
            sigmas=candidate.sigmas,
            share=candidate.share,
            joints=candidate.joints,
        )
        is_no_better = fit.penalised_cost >= model.penalised_cost
        if _are_comparable(model, fit) and is_no_better and fit.cost <= model.cost + EQUAL_COST:
            self.steps.append(step)
            return None
        extended = self._assessed(fit, model.losses)
        if extended is None:
            return None
        reduction, standard_error = model.losses.reduction(extended.losses)
        return extended, replace(
            step,
            decision=Decision.REJECTED,
            error=extended.losses.error,
            reduction=reduction,
            standard_error=standard_error,
        )

    def _without(self, model: FittedModel, term: Term) -> FittedModel | None:
        """The model without a term; None where it cannot be fitted, or after a stop."""
        if any(not term.parameters.keys().isdisjoint(pool.members) for pool in model.pooled):
            return None
        task = model.result.task
        if set(task.system.parameters.names) <= {*term.parameters, *task.settings.hold}:
            return None
        held = tuple(name for name in model.held if name not in term.parameters)
        terms = tuple(each for each in model.terms if each is not term)
        return self._assessed(self._fitted(replace(model, terms=terms, held=held)))

    def _fitted(self, model: FittedModel, added: Term | None = None) -> FittedModel | None:
        """Fit a model that was changed since its fit, beginning there.

        Args:
            model: The changed model.
            added: A new term.

        Returns:
            The model, whose losses are still those before the change; None where it cannot be
            simulated, and after a request to stop.
        """
        stated = self.first.result.task.system
        system = System.resolve(
            selected_experiment(stated.experiment, self._selection(model)),
            threads=stated.threads,
            source=stated.source,
        )
        start = start_of(system.parameters, model, added)
        # A new term may have its size only together with other values of the other parameters.
        # With hardly any of it, the first step of the search moves all of them.
        other_start = None
        if added is not None:
            other_start = start_of(system.parameters, model, added, SMALL_EFFECT)
        task = FitTask.of(system, self.first.result.task.recordings, start=start)
        try:
            result = refit_task(
                self._search(task), model.result, self.workers, other_start=other_start
            )
        except SimulationDivergedError:
            return None
        if self._is_stopped():
            return None
        return replace(model, result=result, cost=self._cost(result))

    def _cost(self, result: FitResult) -> float:
        """Cost of a fit with the noise of the stated model's fit, so that costs are comparable."""
        weighted = result.problem.with_noise(self.first.result.problem.noise)
        return weighted.cost(result.solution.unknowns)

    def _assessed(
        self, model: FittedModel | None, to_beat: HeldOutLosses | None = None
    ) -> FittedModel | None:
        """A fitted model with its losses; None without a fit, and after a request to stop."""
        if model is None:
            return None
        sigma, result = self.first.result.problem.noise.sigma, model.result
        losses = held_out_losses(result.problem, result.solution, sigma, self.budget, to_beat)
        return None if losses is None else replace(model, losses=losses, tests=None)

    def _search(self, task: FitTask) -> FitSearch:
        return FitSearch(task=task, budget=self.budget, callback=self.callback)

    def _is_stopped(self) -> bool:
        return self.budget.stop.requested


def _are_comparable(model: FittedModel, fit: FittedModel) -> bool:
    """Whether the cost of a fit with more terms can be compared with that of a model."""
    found = fit.result
    is_ended = (found.solution.success or found.solution.stuck) and not found.solution.slow
    same_states = have_same_initial_states(found.problem, model.result.problem)
    return same_states and found.task.noise_is_stated and is_ended
