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
from dataclasses import dataclass, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError, listed
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.identification.fit_problem import have_same_initial_states
from mjfim.identification.fit_workers import FitWorkers
from mjfim.identification.held_out_losses import HeldOutLosses, Reduction, held_out_losses
from mjfim.identification.identify import Callback, fit_task, is_doubtful, refit_task
from mjfim.identification.report import FitResult, estimate_from
from mjfim.identification.search import FitSearch
from mjfim.identification.task import FitTask, with_length
from mjfim.identification.terms import TermTests, find_missing_terms
from mjfim.model.parameters import ParameterSet
from mjfim.optimize.levenberg_marquardt import InterruptedPassError
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
    pooled_values,
    poorly_known,
    selected_experiment,
    selected_term,
    stated_values,
    tried_step,
    unhelpful_step,
    with_selection,
)
from mjfim.studies.simplification import possible_pools

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

# Difference of the costs of two fits (half of the sum of squared residuals in standard deviations)
# below which both explain the data equally well: by one standard deviation at most.
EQUAL_COST = 0.5

# Why a selection ended, after a request to stop.
INTERRUPTED = "The selection was interrupted."

# Share of the estimated size of a new term at which it has hardly any effect.
SMALL_EFFECT = 0.01


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
            workers=None if executor is None else FitWorkers(executor),
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
class _Refit:
    """A model with a new fit, of which left-out data are not predicted yet.

    Attributes:
        model: The terms of the model, with an earlier fit.
        result: The new fit.
        cost: Its cost with the noise of the fit of the stated model.
    """

    model: FittedModel
    result: FitResult
    cost: float


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
        """Estimate of the extended model, and the extended model.

        Where the length of the segments is not stated, terms are chosen by whole recordings, which
        show them best. Where these do not explain the recordings, the length is chosen for the
        extended model, and terms are chosen by predictions over this length as well.
        """
        is_free = task.settings.segments is None
        whole = with_length(task, "whole") if is_free else task
        result = fit_task(self._search(whole), self.workers)
        losses = self._losses(result, result)
        if losses is None:
            return self._unselected(result, is_free)

        first = FittedModel(result=result, losses=losses, cost=result.solution.cost, terms=())
        steps = [SelectionStep(decision=Decision.BEGUN, error=losses.error)]
        model, ending = self._chosen(first, first, steps)
        result = self._final(model.result, is_free, is_changed=model.is_changed)

        # Over segments, the data may show other terms.
        stated = first
        if result.task.settings.segment_length is not None and is_free:
            model, ending = self._over_length(model, first, result, steps, ending)
            if model.result is not result:
                result = self._final(model.result, is_free=False, is_changed=model.is_changed)
            length = result.task.settings.segment_length
            of_length = with_length(first.result.task, length)
            stated = replace(first, result=replace(first.result, task=of_length))

        # The final fit may show terms that were not significant before.
        model, ending = self._completed(model, stated, result, steps, ending)
        if model.result is not result:
            is_whole = is_free and stated is first
            result = self._final(model.result, is_whole, is_changed=model.is_changed)
        result = _reported(result, is_free)
        selection = Selection(
            terms=model.terms,
            steps=tuple(steps),
            ending=ending,
            pooled=model.pooled,
            held=model.held,
        )
        tests = self._tests_of(model, result, first)
        estimate = estimate_from(result, self.budget, selection.refuted, tests)
        if selection.is_changed:
            settings = result.task.settings
            selection = replace(
                selection,
                refit=self._refit(result, estimate),
                hold=settings.hold,
                segments=settings.segment_length if is_free else None,
            )
        final_system = result.task.system
        return with_selection(estimate, selection, model.losses, final_system), final_system

    def _unselected(self, result: FitResult, is_free: bool) -> tuple[Estimate, System]:
        """Estimate of the stated model where no term could be tried, and this model.

        Args:
            result: The fit of the stated model.
            is_free: Whether the length of the segments is left to the fit.
        """
        ending = "The selection was interrupted before a term was tried."
        if not self._is_stopped():
            ending = (
                "No part of the recordings could be predicted from the others, so that no term "
                "was tried."
            )
            result = self._final(result, is_free, is_changed=False)
        result = _reported(result, is_free)
        steps = (SelectionStep(decision=Decision.BEGUN, error=np.nan),)
        selection = Selection(terms=(), steps=steps, ending=ending)
        estimate = estimate_from(result, self.budget)
        return replace(estimate, selection=selection), result.task.system

    def _refit(self, result: FitResult, estimate: Estimate) -> HeldOutRefit | None:
        """Fit the selected model to the held-out recordings; None without any, or after a stop."""
        if not self.held_out or self._is_stopped():
            return None

        begin_stage("fitting the selected model to the held-out recordings")
        task = FitTask.of(result.task.system, self.held_out, start=estimate.theta)
        try:
            found = fit_task(self._search(task), self.workers)
        except (InterruptedPassError, SimulationDivergedError):
            return None
        interval = found.accuracy.interval
        return HeldOutRefit(
            theta=found.theta,
            interval=interval,
            differs=different(estimate, found.theta, interval, result.task.system.parameters),
        )

    def _final(self, result: FitResult, is_free: bool, *, is_changed: bool) -> FitResult:
        """The fit of the chosen model, with all attempts against local minima.

        Args:
            result: The fit of the chosen model in the selection.
            is_free: Whether the length of the segments is left to the fit.
            is_changed: Whether the chosen model differs from the stated one.
        """
        is_settled = not is_changed and not (is_free and is_doubtful(result))
        if is_settled or self._is_stopped():
            return result
        final = replace(result.task, start=result.theta, held_out=self.held_out)
        if is_free:
            final = with_length(final, None)

        # Over segments of a stated length, a search from one start is all that there is, unless it
        # begins at the equation of motion.
        settings = final.settings
        begins_at_guess = settings.starts == 1 and settings.start != "inverse_dynamics"
        if settings.segment_length is None or not begins_at_guess or is_free:
            return fit_task(self._search(final), self.workers)
        try:
            return refit_task(self._search(final), result, self.workers, is_rough=False)
        except InterruptedPassError:
            return result

    # ---- steps

    def _completed(
        self,
        model: FittedModel,
        first: FittedModel,
        result: FitResult,
        steps: list[SelectionStep],
        ending: str,
    ) -> tuple[FittedModel, str]:
        """Try terms that only the final fit of a changed model shows to be significant.

        Args:
            model: The chosen model, with an earlier fit.
            first: The stated model.
            result: The final fit of the chosen model.
            steps: Receives the steps.
            ending: Why no more terms were added before.

        Returns:
            The model with the final fit or with further terms, and why no more terms were added.
        """
        final = replace(model, result=result, tests=self._tests_of(model, result, first))
        if self._is_stopped() or not model.is_changed or final.tests is not None:
            return final, ending

        # The final fit is another one. Left-out data are predicted from it anew: further terms are
        # compared with it, and its intervals are widened by the scatter between these fits.
        tests = self._term_tests(final)
        final = replace(final, tests=tests)
        if result is not model.result and not self._is_stopped():
            assessed = self._assessed(self._costed(model, first, result), first)
            if assessed is not None:
                final = replace(assessed, tests=tests)
        if self._is_stopped():
            return final, INTERRUPTED
        return self._grown(final, first, steps, _refuted(steps))

    def _chosen(
        self, model: FittedModel, first: FittedModel, steps: list[SelectionStep]
    ) -> tuple[FittedModel, str]:
        """Add terms, remove needless ones, and simplify the parameters.

        Args:
            model: Where to begin.
            first: The stated model.
            steps: Receives the steps.

        Returns:
            The chosen model, and why no more terms were added.
        """
        model, ending = self._grown(model, first, steps)
        model = self._pruned(model, first, steps)
        simpler = self._simplified(model, first, steps)

        # Terms may have stood in for parameters that are held or pooled now. Without them, others
        # may be significant that were not tried before.
        if simpler is not model:
            simpler = self._pruned(simpler, first, steps, tests_last=True)
            simpler, ending = self._grown(simpler, first, steps, _refuted(steps))
        return simpler, ending

    def _over_length(
        self,
        model: FittedModel,
        first: FittedModel,
        result: FitResult,
        steps: list[SelectionStep],
        ending: str,
    ) -> tuple[FittedModel, str]:
        """Choose terms by predictions over segments instead of whole recordings.

        Args:
            model: The model that was chosen by whole recordings.
            first: The stated model.
            result: Fit of the chosen model over segments.
            steps: Receives the steps.
            ending: Why no more terms were added by whole recordings.

        Returns:
            The chosen model, and why no more terms were added.
        """
        length = result.task.settings.segment_length
        cut = self._assessed(self._costed(model, first, result), first)
        if cut is None or length is None:
            return replace(model, result=result, tests=None), ending

        steps.append(
            SelectionStep(
                decision=Decision.SHORTENED,
                description=f"segments of {length:.2g} s",
                count=len(model.terms),
                error=cut.losses.error,
            )
        )
        stated = replace(first.result, task=with_length(first.result.task, length))
        return self._chosen(cut, replace(first, result=stated), steps)

    def _grown(
        self,
        model: FittedModel,
        first: FittedModel,
        steps: list[SelectionStep],
        refuted: Collection[str] = (),
    ) -> tuple[FittedModel, str]:
        """Add terms while they improve the prediction of left-out data.

        Args:
            model: Where to begin.
            first: The stated model.
            steps: Receives the steps.
            refuted: Terms that are not tried again (`Selection.refuted`).

        Returns:
            The extended model, and why no more terms were added.
        """
        while len(model.terms) < self.max_terms:
            begin_stage(f"looking for term {len(model.terms) + 1} that the model lacks")
            tests = self._term_tests(model) if model.tests is None else model.tests
            model = replace(model, tests=tests)
            candidates = tests.without(refuted).terms
            if self._is_stopped():
                return model, INTERRUPTED
            if not candidates:
                return model, f"No further term that was tested is significant.{tests.remark}"

            # The most promising terms are tried first, and the others if these do not help.
            most = candidates[0].share
            similar = [term for term in candidates if term.share >= SIMILAR_SHARE * most]
            others = [term for term in candidates if term.share < SIMILAR_SHARE * most]
            better = None
            for attempt in (similar, others):
                better = better or self._best_extension(model, first, attempt, steps)
            if self._is_stopped():
                return model, INTERRUPTED
            if better is None:
                text = "No further term predicts left-out data clearly better."
                return model, text + tests.remark
            model = better
        return model, f"{self.max_terms} terms were added, the largest number."

    def _best_extension(
        self,
        model: FittedModel,
        first: FittedModel,
        candidates: Sequence[Term],
        steps: list[SelectionStep],
    ) -> FittedModel | None:
        """The model with the one of some terms that predicts best; None where none is better."""
        tried: list[tuple[FittedModel, SelectionStep]] = []
        for candidate in candidates:
            attempt = self._tried(model, first, candidate, steps)
            if self._is_stopped():
                return None
            if attempt is not None:
                tried.append(attempt)

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
                description=other.description, path=other.path, values=stated_values(found, first)
            )
            for found, other in clear
            if found is not chosen and not found.losses.reduction(chosen.losses).is_clear
        )
        count = len(chosen.terms)
        steps.append(replace(step, decision=Decision.ADDED, count=count, alternatives=alternatives))
        return chosen

    def _pruned(
        self,
        model: FittedModel,
        first: FittedModel,
        steps: list[SelectionStep],
        *,
        tests_last: bool = False,
    ) -> FittedModel:
        """Remove terms without which left-out data are predicted as well.

        Args:
            model: Where to begin.
            first: The stated model.
            steps: Receives the steps.
            tests_last: False where the last term has just been tested against the model without it.
        """
        while not self._is_stopped():
            tested = model.terms if tests_last else model.terms[:-1]
            if not tested:
                break
            begin_stage("testing whether all added terms are needed")
            needless: list[tuple[Reduction, Term, FittedModel]] = []
            for term in tested:
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
                    joints=term.joints,
                    count=len(model.terms),
                    error=model.losses.error,
                    reduction=reduction.mean,
                    standard_error=reduction.standard_error,
                )
            )
        return model

    def _simplified(
        self, model: FittedModel, first: FittedModel, steps: list[SelectionStep]
    ) -> FittedModel:
        """Pool or hold poorly known parameters as long as the prediction stays as good."""
        if self._is_stopped():
            return model
        begin_stage("testing whether poorly known parameters are needed")
        for pool in possible_pools(first.result.task.system.parameters, poorly_known(model)):
            words = f"one value of {pool.name} for {listed(pool.members)}"
            changed = replace(model, pooled=(*model.pooled, pool))
            model = self._simpler(model, changed, first, (Decision.POOLED, words), steps)

        # All of those that are still poorly known are held at once, or else one by one.
        names = poorly_known(model)
        attempts = [names] if len(names) > 1 else []
        attempts += [(name,) for name in names[:MAX_HELD_ATTEMPTS]]
        for attempt in attempts:
            if self._is_stopped() or set(attempt) <= set(model.held):
                continue

            # One parameter at least is left to the fit.
            task = model.result.task
            if {*task.settings.hold, *attempt} >= set(task.system.parameters.names):
                continue
            changed = replace(model, held=(*model.held, *attempt))
            model = self._simpler(model, changed, first, (Decision.HELD, listed(attempt)), steps)
        return model

    def _simpler(
        self,
        model: FittedModel,
        changed: FittedModel,
        first: FittedModel,
        named: tuple[Decision, str],
        steps: list[SelectionStep],
    ) -> FittedModel:
        """A simpler model, if it predicts left-out data as well; otherwise the model itself.

        Args:
            model: The model.
            changed: It with the pooled and held parameters of the simpler one, not yet fitted.
            first: The stated model.
            named: The decision for the simpler model, and what it changes in words.
            steps: Receives the step.
        """
        names = model.result.task.system.parameters.names
        values = dict(zip(names, model.result.theta, strict=True))
        simpler = self._assessed(self._refitted(changed, first, changed.terms, values, {}), first)
        if simpler is None:
            return model

        decision, words = named
        reduction = simpler.losses.reduction(model.losses)
        is_worse = (
            reduction.is_clear or simpler.losses.error > WORSE_ERROR_RATIO * model.losses.error
        )
        steps.append(
            SelectionStep(
                decision=Decision.KEPT if is_worse else decision,
                description=words,
                count=len(model.terms),
                error=simpler.losses.error,
                reduction=-reduction.mean,
                standard_error=reduction.standard_error,
            )
        )
        return model if is_worse else simpler

    # ---- models

    def _tried(
        self,
        model: FittedModel,
        first: FittedModel,
        candidate: Term,
        steps: list[SelectionStep],
    ) -> tuple[FittedModel, SelectionStep] | None:
        """The model with one term more, and the step that tried it, before it is decided on.

        None where it cannot be simulated, after a stop, and where it fits the data no better.

        Args:
            model: The model.
            first: The stated model.
            candidate: The term.
            steps: Receives the step of a term with which the fit is no better.
        """
        names = model.result.task.system.parameters.names
        term = selected_term(candidate, names)
        values = dict(zip(names, model.result.theta, strict=True))
        changes = {number.name: number.value for number in term.numbers}
        terms = (*model.terms, term)
        fit = self._refitted(model, first, terms, values, changes, sizes=_sizes_of(term))
        if fit is None or self._is_stopped():
            return None

        # A term that does not even fit the data better need not predict left-out data.
        is_equal = 0.0 <= fit.cost - model.cost <= EQUAL_COST
        if is_equal and _is_comparable(fit, model):
            steps.append(unhelpful_step(candidate, len(model.terms)))
            return None
        extended = self._assessed(fit, first)
        if extended is None:
            return None
        reduction = model.losses.reduction(extended.losses)
        return extended, tried_step(candidate, extended, reduction)

    def _without(self, model: FittedModel, first: FittedModel, term: Term) -> FittedModel | None:
        """The model without a term; None where it cannot be simulated, or after a stop.

        There is none either where a pool replaces parameters of the term, and where all other
        parameters are held.
        """
        if any(not term.parameters.keys().isdisjoint(pool.members) for pool in model.pooled):
            return None
        task = model.result.task
        names = task.system.parameters.names
        if set(names) <= {*term.parameters, *task.settings.hold}:
            return None

        held = tuple(name for name in model.held if name not in term.parameters)
        model = replace(model, held=held)
        values = dict(zip(names, model.result.theta, strict=True))
        terms = tuple(each for each in model.terms if each is not term)
        return self._assessed(self._refitted(model, first, terms, values, {}), first)

    def _refitted(
        self,
        model: FittedModel,
        first: FittedModel,
        terms: tuple[Term, ...],
        values: dict[str, float],
        changes: dict[str, float],
        sizes: Collection[str] = (),
    ) -> _Refit | None:
        """Fit the stated model with some terms, beginning at the fit of a similar model.

        None where it cannot be simulated, or after a stop.

        Args:
            model: The similar model.
            first: The stated model.
            terms: The terms.
            values: Values of the parameters where the search begins [theta-unit].
            changes: Values of new parameters: what numbers of the model gain, and values of fields
                of the library of terms [theta-unit].
            sizes: Names of the parameters that are sizes of a new term, without which it has no
                effect; none without a new term.
        """
        stated = first.result.task.system
        selection = Selection(
            terms=terms, steps=(), ending="", pooled=model.pooled, held=model.held
        )
        system = System.resolve(
            selected_experiment(stated.experiment, selection),
            threads=stated.threads,
            source=stated.source,
        )
        values = {**values, **pooled_values(model.pooled, values)}
        start = _start_of(system.parameters, model.held, values, changes)

        # A new term may have its size only together with other values of the other parameters.
        # With hardly any of it, the first step of the search moves all of them.
        other_start = None
        if sizes:
            fewer = {
                name: SMALL_EFFECT * value if name in sizes else value
                for name, value in changes.items()
            }
            other_start = _start_of(system.parameters, model.held, values, fewer)

        task = FitTask.of(system, first.result.task.recordings, start=start)
        try:
            result = refit_task(
                self._search(task), model.result, self.workers, other_start=other_start
            )
        except (InterruptedPassError, SimulationDivergedError):
            return None
        return self._costed(replace(model, terms=terms), first, result)

    def _costed(self, model: FittedModel, first: FittedModel, result: FitResult) -> _Refit | None:
        """A model with a new fit and its cost; None after a request to stop.

        Args:
            model: The terms of the model, with an earlier fit.
            first: The stated model, whose noise weights the cost.
            result: The new fit.
        """
        weighted = result.problem.with_noise(first.result.problem.noise)
        try:
            cost = weighted.cost(result.solution.unknowns)
        except InterruptedPassError:
            return None
        return _Refit(model=model, result=result, cost=cost)

    def _assessed(self, fit: _Refit | None, first: FittedModel) -> FittedModel | None:
        """A fitted model with its losses; None without a fit, and after a request to stop.

        Args:
            fit: The fit, or None.
            first: The stated model, whose noise weights the losses.
        """
        if fit is None:
            return None
        losses = self._losses(fit.result, first.result)
        if losses is None:
            return None
        return replace(fit.model, result=fit.result, losses=losses, cost=fit.cost, tests=None)

    def _tests_of(
        self, model: FittedModel, result: FitResult, first: FittedModel
    ) -> TermTests | None:
        """Tests of terms that the chosen model lacks, if they hold at its final fit; or None.

        They do where the final fit explains the data as well as the fit at which they were made.

        Args:
            model: The chosen model.
            result: Its final fit.
            first: The stated model, whose noise weights the cost.
        """
        if model.tests is None or self._is_stopped() or result.quality.unexplained:
            return None
        if result.solution is model.result.solution:
            return model.tests
        if len(result.problem.segments) != len(model.result.problem.segments):
            return None
        try:
            weighted = result.problem.with_noise(first.result.problem.noise)
            change = weighted.cost(result.solution.unknowns) - model.cost
        except InterruptedPassError:
            return None
        return model.tests if abs(change) <= EQUAL_COST else None

    def _term_tests(self, model: FittedModel) -> TermTests:
        """Significant terms that the model lacks, the most promising one first."""
        result = model.result
        try:
            return find_missing_terms(
                result.problem, result.task.recordings, result.solution.unknowns
            )
        except InterruptedPassError:
            return TermTests()

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


def _is_comparable(fit: _Refit, model: FittedModel) -> bool:
    """Whether an equal cost of a fit with one term more shows that the term explains nothing.

    It does where both fits minimise the same sum of squares with the same initial states, and where
    the search ended near a minimum. A fit that costs clearly more has missed the one without the
    term, and shows nothing.

    Args:
        fit: The fit with the term.
        model: The model without it.
    """
    found = fit.result
    is_ended = found.solution.success and not found.solution.slow
    is_same_start = have_same_initial_states(found.problem, model.result.problem)
    return is_same_start and found.task.noise_is_stated and is_ended


def _refuted(steps: Sequence[SelectionStep]) -> Collection[str]:
    """Terms that some steps have refuted (`Selection.refuted`)."""
    return Selection(terms=(), steps=tuple(steps), ending="").refuted


def _sizes_of(term: Term) -> set[str]:
    """Names of the parameters of a term that its test has estimated, which are its sizes.

    The others, such as a Stribeck speed, have no effect without them.
    """
    return {number.name for number in term.numbers if number.is_size}


def _start_of(
    parameters: ParameterSet,
    held: Collection[str],
    values: dict[str, float],
    changes: dict[str, float],
) -> Array:
    """(p,) start of the fit of a model, beginning at the fit of a similar one [theta-unit].

    Args:
        parameters: The parameters of the model.
        held: Names of those that keep their guess.
        values: Values of those of the similar model.
        changes: What numbers of the model gain, and values of fields of the library of terms.
    """
    start = np.array(parameters.guess)
    for i, parameter in enumerate(parameters.parameters):
        if parameter.name in held:
            continue
        change = changes.get(parameter.name, 0.0)
        is_field = parameter.name in changes and parameter.targets[0].term is not None
        start[i] = change if is_field else values.get(parameter.name, start[i]) + change
    return np.clip(start, parameters.lower, parameters.upper)


def _reported(result: FitResult, is_free: bool) -> FitResult:
    """A fit as it is reported.

    It is compared with the guess, not with where the last search began. Its experiment has the
    length of the segments that the user stated, unless another one was chosen.

    Args:
        result: The fit.
        is_free: Whether the length of the segments is left to the fit.
    """
    task = replace(result.task, start=result.task.system.parameters.guess)
    if is_free and task.settings.segment_length is None:
        task = with_length(task, None)
    return replace(result, task=task)
