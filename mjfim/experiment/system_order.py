"""A system as an order, from which a worker process makes the same system."""

from __future__ import annotations

from dataclasses import dataclass, replace

from mjfim.arrays import Array
from mjfim.experiment.packing import for_workers
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.model.variants import STATED


@dataclass(frozen=True, kw_only=True, eq=False)
class SystemOrder:
    """Everything that determines a system on the user's model. It can be pickled.

    Attributes:
        experiment: The experiment, with its files.
        initial_state: (ns,) nominal initial state.
        substeps: Engine steps of a sample.
        step_factors: (p,) factors of the difference steps; None where they are not calibrated.
        threads: Threads for the engine.
    """

    experiment: Experiment
    initial_state: Array
    substeps: int
    step_factors: Array | None
    threads: int

    @classmethod
    def of(cls, system: System, threads: int) -> SystemOrder:
        """Describe a system.

        Args:
            system: A system on the plant that the experiment states, or with other substeps.
            threads: Threads that each worker may use.
        """
        assert system.variant == STATED
        return cls(
            experiment=for_workers(system.experiment, system.source),
            initial_state=system.nominal_initial_state,
            substeps=system.grid.substeps,
            step_factors=system.plant.step_factors,
            threads=threads,
        )

    def system(self) -> System:
        """Make the system; the model is parsed once in a process."""
        system = System.resolve(self.experiment, threads=self.threads)
        if self.substeps != system.grid.substeps:
            system = system.with_substeps(self.substeps)

        plant = system.plant.with_initial_state(self.initial_state)
        return replace(
            system,
            nominal_initial_state=self.initial_state,
            plant=plant.with_step_factors(self.step_factors),
        )
