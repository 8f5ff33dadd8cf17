"""Task of a design as its orders send it to the workers, where it needs no file."""

from __future__ import annotations

import uuid
from dataclasses import dataclass

from mjfim.excitation.task import DesignTask
from mjfim.experiment.packing import for_workers
from mjfim.experiment.schema import Experiment
from mjfim.model.variants import ModelVariant


@dataclass(frozen=True, kw_only=True, eq=False)
class SentTask:
    """The experiment of a design for its orders.

    Attributes:
        experiment: The experiment, which needs no file of the caller. Each worker receives its
            contents once.
        key: Text that tells the orders of this design from those of others.
    """

    experiment: Experiment
    key: str

    @classmethod
    def of(cls, task: DesignTask) -> SentTask:
        """Pack the experiment of a task.

        Args:
            task: The stated task, on any variant of its plant.
        """
        packed = for_workers(task.experiment, task.system.source)
        return cls(experiment=packed, key=uuid.uuid4().hex)

    def key_of(self, *variants: ModelVariant) -> str:
        """Text that is equal for orders on the same plants, which a worker resolves once.

        Args:
            *variants: The plants.
        """
        return f"{self.key} {variants}"
