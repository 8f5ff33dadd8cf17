"""Random motions of a check on the workers of an executor, which differentiate them."""

from __future__ import annotations

import uuid
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from mjfim.arrays import Array
from mjfim.budget import Budget, StopToken
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system_order import SystemOrder
from mjfim.information.identifiability import IdentifiabilityTest, RowsAndError
from mjfim.parallel import ExecutorLike, Workers, one_blas_thread, results_or_here
from mjfim.parallel.kept import KeptPerThread
from mjfim.records.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True, eq=False)
class _ProbeOrder:
    """Order to differentiate one motion. It can be pickled.

    Attributes:
        key: Unique text by which a worker recognises the check.
        system: The system.
        theta: (p,) parameter values [theta-unit].
        earlier: (p, p) information of earlier experiments [1 / theta-unit^2].
        probe: The motion.
    """

    key: str
    system: SystemOrder
    theta: Array
    earlier: Array
    probe: Trajectory

    def test(self) -> IdentifiabilityTest:
        """Make the test, which has no random motions of its own."""
        system = self.system.system()
        return IdentifiabilityTest(
            plant=system.plant,
            parameters=system.parameters,
            noise=system.noise,
            theta=self.theta,
            earlier=self.earlier,
            probes=lambda count: iter(()),
        )


# The latest test of a worker, by the key of its check.
_worker_tests: KeptPerThread[IdentifiabilityTest] = KeptPerThread(1)


@one_blas_thread()
def _rows_in_worker(order: _ProbeOrder) -> RowsAndError | None:
    """Differentiate a motion in a worker process."""
    return _worker_tests.get(order.key, order.test).rows_along(order.probe)


@dataclass(frozen=True, kw_only=True, eq=False)
class ProbeWorkers:
    """Workers that differentiate the random motions of a check.

    Attributes:
        executor: Executor of the workers.
        task: The task that is checked.
        stop: Leaves out motions that have not begun.
    """

    executor: ExecutorLike
    task: DesignTask
    stop: StopToken

    def differentiated(self, probes: Iterable[Trajectory]) -> Iterator[RowsAndError | None]:
        """Differentiate motions; see `IdentifiabilityTest.rows_along`.

        Args:
            probes: The motions.

        Yields:
            What is found along every motion, in their order.
        """
        motions = list(probes)
        key = uuid.uuid4().hex
        threads = Workers.of(self.executor).threads_for(len(motions))
        system = SystemOrder.of(self.task.system, threads)
        test = self.task.identifiability_test
        orders = [
            _ProbeOrder(
                key=key, system=system, theta=test.theta, earlier=test.earlier, probe=motion
            )
            for motion in motions
        ]

        def here(order: _ProbeOrder) -> RowsAndError | None:
            """Differentiate a motion whose worker was lost."""
            return test.rows_along(order.probe)

        budget = Budget(stop=self.stop)
        yield from results_or_here(self.executor, _rows_in_worker, orders, budget, here)
