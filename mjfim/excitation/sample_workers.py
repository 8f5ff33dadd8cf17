"""Parameter samples of a robust design on the workers of an executor, which evaluate them.

A worker keeps the motions of the latest samples that it has evaluated: their derivatives are wanted
next, if the step is accepted.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

from mjfim.arrays import Array
from mjfim.budget import Budget
from mjfim.excitation.objective import DIVERGED, DesignPoint, DesignProblem
from mjfim.excitation.task import DesignTask
from mjfim.experiment.packing import for_workers
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.information.criteria import Criterion
from mjfim.information.fisher import FisherInformation
from mjfim.model.variants import ModelVariant
from mjfim.parallel import Dispatch, ExecutorLike, Workers, one_blas_thread
from mjfim.parallel.kept import KeptPerThread
from mjfim.parallel.shared_value import SharedValue
from mjfim.plant.mixed_derivatives import (
    CENTRAL_DIFFERENCES,
    FORWARD_DIFFERENCES,
    DifferenceAccuracy,
)

T = TypeVar("T")

# Number of plants, of costs, and of evaluated samples that a worker keeps.
KEPT_PLANTS = 3
KEPT_PROBLEMS = 4
KEPT_POINTS = 16


@dataclass(frozen=True, kw_only=True, eq=False)
class _PlantOrder:
    """Everything that determines the plant of a level. It can be pickled.

    Attributes:
        experiment: The experiment, with its files.
        variant: How the plant differs from the user's model.
        threads: Threads for simulations.
    """

    experiment: Experiment
    variant: ModelVariant
    threads: int

    def task(self) -> DesignTask:
        """Make the task of the plant."""
        stated = DesignTask.resolve(self.experiment, threads=self.threads)
        is_stated = self.variant == stated.system.variant
        return stated if is_stated else stated.with_variant(self.variant)


@dataclass(frozen=True, kw_only=True, eq=False)
class _ProblemOrder:
    """Everything that determines the cost at a parameter sample. It can be pickled.

    Attributes:
        plant: The plant.
        step_factors: (p,) factors of its difference steps, or None.
        information: Fisher information of the measured samples, and the criterion.
    """

    plant: SharedValue[_PlantOrder]
    step_factors: Array | None
    information: FisherInformation

    def problem(self) -> DesignProblem:
        """Make the cost, without samples of its own."""
        plant = self.plant
        task = _worker_plants.get(plant.digest, lambda: plant.value.task())
        made = replace(task.problem, parameter_samples=None, lumped=None)
        return replace(
            made,
            plant=task.plant.with_step_factors(self.step_factors),
            information=self.information,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class _SampleOrder:
    """Order to evaluate a control at one parameter sample.

    Attributes:
        problem: The cost.
        theta: (p,) the sample [theta-unit].
        ctrl: (N, nu) the control [u-unit].
        central: True for central differences.
        found: Information and criterion of the sample where its derivative is wanted; None where
            they are.
    """

    problem: SharedValue[_ProblemOrder]
    theta: Array
    ctrl: Array
    central: bool
    found: tuple[Array, Criterion] | None = None

    @property
    def accuracy(self) -> DifferenceAccuracy:
        """Differences with which sensitivities are computed."""
        return CENTRAL_DIFFERENCES if self.central else FORWARD_DIFFERENCES

    @property
    def key(self) -> tuple[str, bytes, bytes, bool]:
        """Key of the evaluated sample in a cache."""
        return self.problem.digest, self.theta.tobytes(), self.ctrl.tobytes(), self.central


@dataclass(frozen=True, kw_only=True, eq=False)
class _Found(Generic[T]):
    """Result of a worker, and how much it has simulated.

    Attributes:
        result: The result; None where the simulation diverges.
        steps: Engine steps that this took.
    """

    result: T | None
    steps: int


@dataclass(frozen=True, kw_only=True, eq=False)
class _EvaluatedSample:
    """An evaluated sample that a worker keeps.

    Attributes:
        point: Its motion, information and criterion.
        steps: Engine steps that its evaluation took.
    """

    point: DesignPoint
    steps: int


# The latest plants, costs and evaluated samples of a worker.
_worker_plants: KeptPerThread[DesignTask] = KeptPerThread(KEPT_PLANTS)
_worker_problems: KeptPerThread[DesignProblem] = KeptPerThread(KEPT_PROBLEMS)
_worker_points: KeptPerThread[_EvaluatedSample] = KeptPerThread(KEPT_POINTS)


@one_blas_thread()
def _point_in_worker(order: _SampleOrder) -> _Found[tuple[Array, Criterion]]:
    """Evaluate a control at a sample in a worker process."""
    _, evaluated = _evaluated(order)

    # The count of a design must not depend on what a worker happens to keep.
    return _Found(result=_numbers(evaluated.point), steps=evaluated.steps)


@one_blas_thread()
def _slope_in_worker(order: _SampleOrder) -> _Found[Array]:
    """Differentiate the criterion at a sample by the control, in a worker process."""
    problem, evaluated = _evaluated(order)

    # The evaluation of the sample was counted when its cost was wanted.
    before = problem.plant.engine_steps
    slope = _slope(problem, order, evaluated.point)
    return _Found(result=slope, steps=problem.plant.engine_steps - before)


def _evaluated(order: _SampleOrder) -> tuple[DesignProblem, _EvaluatedSample]:
    """The cost of an order and its evaluated sample, which a worker may have kept."""
    problem = _worker_problems.get(order.problem.digest, lambda: order.problem.value.problem())

    def made() -> _EvaluatedSample:
        """Evaluate the sample."""
        before = problem.plant.engine_steps
        point = problem.sample_point(order.theta, order.ctrl, order.accuracy)
        return _EvaluatedSample(point=point, steps=problem.plant.engine_steps - before)

    return problem, _worker_points.get(order.key, made)


def _numbers(point: DesignPoint) -> tuple[Array, Criterion] | None:
    """Information and criterion of a sample; None where it diverges."""
    if point.information is None or point.criterion is None:
        return None
    return point.information, point.criterion


def _slope(problem: DesignProblem, order: _SampleOrder, point: DesignPoint) -> Array | None:
    """(N, nu) derivative of the criterion at a sample by the control."""
    if order.found is None or point.trajectory is None:
        return None
    information, criterion = order.found
    stated = replace(point, information=information, criterion=criterion)
    return problem.sample_slope(order.theta, stated)


class SampleWorkers:
    """Workers that evaluate the samples of a robust design; see `objective.SampleEvaluation`.

    Args:
        executor: The workers, or an executor that they can wrap.
        budget: Time of the design, after which workers that do not answer are given up. After a
            request of its token, this process evaluates the samples that are still needed: Ctrl-C
            in a terminal may have ended the workers.
    """

    def __init__(self, executor: ExecutorLike, budget: Budget) -> None:
        self._workers = Workers.of(executor)
        self._budget = budget
        self._plants: dict[tuple[str, ModelVariant, int], SharedValue[_PlantOrder]] = {}
        self._problems: dict[tuple[int, int], tuple[DesignProblem, SharedValue[_ProblemOrder]]]
        self._problems = {}

    def points(
        self,
        system: System,
        problem: DesignProblem,
        thetas: Array,
        ctrl: Array,
        accuracy: DifferenceAccuracy,
    ) -> tuple[DesignPoint, ...] | None:
        """Evaluate a control at all samples; None where one of them diverges."""
        central = accuracy is CENTRAL_DIFFERENCES
        shared = self._shared(system, problem, len(thetas))
        orders = [
            _SampleOrder(problem=shared, theta=theta, ctrl=ctrl, central=central)
            for theta in thetas
        ]

        def here(order: _SampleOrder) -> _Found[tuple[Array, Criterion]]:
            """Evaluate a sample whose worker was lost; its steps are counted by the plant."""
            point = problem.sample_point(order.theta, order.ctrl, accuracy)
            return _Found(result=_numbers(point), steps=0)

        points = []
        for found in self._all(_point_in_worker, orders, here):
            problem.plant.simulator.add_steps(found.steps)
            if found.result is None:
                return None
            information, criterion = found.result
            points.append(
                replace(DIVERGED, information=information, criterion=criterion, accuracy=accuracy)
            )
        return tuple(points)

    def slopes(
        self,
        system: System,
        problem: DesignProblem,
        thetas: Array,
        ctrl: Array,
        points: Sequence[DesignPoint],
    ) -> list[Array]:
        """Differentiate the criterion at all samples by the control."""
        shared = self._shared(system, problem, len(thetas))
        orders = [
            _SampleOrder(
                problem=shared,
                theta=theta,
                ctrl=ctrl,
                central=point.accuracy is CENTRAL_DIFFERENCES,
                found=_numbers(point),
            )
            for theta, point in zip(thetas, points, strict=True)
        ]

        def here(order: _SampleOrder) -> _Found[Array]:
            """Differentiate a sample whose worker was lost."""
            before = problem.plant.engine_steps
            point = problem.sample_point(order.theta, order.ctrl, order.accuracy)
            repeated = problem.plant.engine_steps - before

            # The plant counts the evaluation, which was counted before.
            return _Found(result=_slope(problem, order, point), steps=-repeated)

        slopes = []
        for found in self._all(_slope_in_worker, orders, here):
            problem.plant.simulator.add_steps(found.steps)
            if found.result is None:
                raise ValueError("a diverged sample has no slope")
            slopes.append(found.result)
        return slopes

    def _all(
        self,
        function: Callable[[_SampleOrder], _Found[T]],
        orders: Sequence[_SampleOrder],
        here: Callable[[_SampleOrder], _Found[T]],
    ) -> Iterator[_Found[T]]:
        """Results of all orders, in their order, those of lost workers from this process."""
        found: dict[int, _Found[T]] = {}
        if not self._budget.stop.requested:
            # All samples are needed, also when the time is over, so that none is left out then.
            dispatch = Dispatch[_SampleOrder, _Found[T]](self._workers, function, self._budget)
            for index, order in enumerate(orders):
                dispatch.add(index, order)
            for outcome in dispatch.arrivals():
                if not outcome.is_lost:
                    found[outcome.index] = outcome.result

        for index, order in enumerate(orders):
            yield found[index] if index in found else here(order)

    def _shared(
        self, system: System, problem: DesignProblem, tasks: int
    ) -> SharedValue[_ProblemOrder]:
        """The order for a cost, made once."""
        threads = self._workers.threads_for(tasks)
        key = id(problem), threads
        if key not in self._problems:
            order = _ProblemOrder(
                plant=self._plant_of(system, threads),
                step_factors=problem.plant.step_factors,
                information=problem.information,
            )

            # The cost is kept as well, so that no other one has its identity.
            self._problems[key] = (problem, SharedValue(uuid.uuid4().hex, order))
        return self._problems[key][1]

    def _plant_of(self, system: System, threads: int) -> SharedValue[_PlantOrder]:
        """The order for a plant, made once for each variant."""
        key = system.experiment.source, system.variant, threads
        if key not in self._plants:
            order = _PlantOrder(
                experiment=for_workers(system.experiment, system.source),
                variant=system.variant,
                threads=threads,
            )
            self._plants[key] = SharedValue(uuid.uuid4().hex, order)
        return self._plants[key]
