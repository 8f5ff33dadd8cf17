"""Where the time of a design's iteration goes: engine steps and seconds of each purpose.

The parts are measured by wrapping the functions that do them, in one run of a design. Seconds are
those of the processor, so that other programs matter little.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any
from unittest import mock

import mujoco
from mujoco.batch import Batch
from rich.table import Table

from mjfim.excitation.design import design_task
from mjfim.excitation.task import DesignTask
from mjfim.information.fisher import FisherInformation
from mjfim.optimize.directions import LBFGS
from mjfim.optimize.projection_operator import Regulator
from mjfim.plant.mixed_derivatives import MixedDerivatives
from mjfim.plant.plant import Plant
from mjfim.plant.rollout_derivatives import RolloutDerivatives
from mjfim.records.events import DesignEvent

# Functions of an iteration and what they are for. None of them calls another one.
PURPOSES: tuple[tuple[Any, str, str], ...] = (
    (Plant, "project", "trials of the line search"),
    (RolloutDerivatives, "sensitivity", "psi"),
    (MixedDerivatives, "bilinear", "A, B and mixed derivatives"),
    (FisherInformation, "matrix", "information and criterion"),
    (FisherInformation, "evaluate", "information and criterion"),
    (FisherInformation, "gradient", "adjoint"),
    (Regulator, "gain", "regulator"),
    (LBFGS, "__call__", "direction"),
    (LBFGS, "accept", "direction"),
)

# Purpose of all that no function above does.
REST = "all else"

# Steps of the bare engine over which its time is measured.
BARE_STEPS = 20_000


@dataclass(kw_only=True)
class Part:
    """Effort for one purpose.

    Attributes:
        calls: Number of calls.
        steps: Engine steps.
        seconds: Seconds of the processor.
        engine: Seconds of the processor inside the engine.
    """

    calls: int = 0
    steps: int = 0
    seconds: float = 0.0
    engine: float = 0.0


@dataclass(frozen=True, kw_only=True)
class IterationParts:
    """The parts of an iteration.

    Attributes:
        iterations: Number of iterations that were measured.
        parts: Sums over these iterations, by purpose.
        costs: Cost J of every iterate.
        bare_step: Time of a bare `mj_step` of the model, in the same run [s].
    """

    iterations: int
    parts: dict[str, Part]
    costs: tuple[float, ...]
    bare_step: float

    @property
    def seconds(self) -> float:
        """Seconds of the processor in an iteration."""
        return sum(part.seconds for part in self.parts.values()) / self.iterations

    @property
    def steps(self) -> float:
        """Engine steps of an iteration."""
        return sum(part.steps for part in self.parts.values()) / self.iterations

    @property
    def engine(self) -> float:
        """Time that the bare engine takes for the steps of an iteration [s]."""
        return self.steps * self.bare_step


class _Meter:
    """Adds up calls, engine steps and seconds of the purposes while a design runs."""

    def __init__(self, steps_so_far: Callable[[], int]) -> None:
        """Begin with nothing; the function returns the engine steps so far."""
        self.parts: dict[str, Part] = {REST: Part()}
        self.active: str | None = None
        self._steps_so_far = steps_so_far

    def wrapped(self, function: Callable[..., Any], purpose: str) -> Callable[..., Any]:
        """The function, which counts for a purpose unless it is called by a counted one."""

        def counted(*args: Any, **kwargs: Any) -> Any:
            if self.active is not None:
                return function(*args, **kwargs)

            self.active = purpose
            part = self.parts.setdefault(purpose, Part())
            steps, clock = self._steps_so_far(), time.process_time()
            try:
                return function(*args, **kwargs)
            finally:
                part.seconds += time.process_time() - clock
                part.steps += self._steps_so_far() - steps
                part.calls += 1
                self.active = None

        return counted

    def native(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function of the engine, whose time counts for the active purpose."""

        def timed(*args: Any, **kwargs: Any) -> Any:
            clock = time.process_time()
            try:
                return function(*args, **kwargs)
            finally:
                part = self.parts.setdefault(self.active or REST, Part())
                part.engine += time.process_time() - clock

        return timed

    @contextmanager
    def attached(self) -> Iterator[None]:
        """Wrap the functions of all purposes and those of the engine."""
        with ExitStack() as stack:
            for owner, name, purpose in PURPOSES:
                counted = self.wrapped(getattr(owner, name), purpose)
                stack.enter_context(mock.patch.object(owner, name, _method(counted)))
            for name in ("rollout", "step", "forward"):
                timed = self.native(getattr(Batch, name))
                stack.enter_context(mock.patch.object(Batch, name, _method(timed)))
            yield


def _method(function: Callable[..., Any]) -> Callable[..., Any]:
    """A plain function, which Python binds to the object."""

    def method(self: Any, *args: Any, **kwargs: Any) -> Any:
        return function(self, *args, **kwargs)

    return method


def measure(task: DesignTask, closed_form: bool = True) -> IterationParts:
    """Run a design and measure the parts of its iterations.

    Args:
        task: The task; the first iterate is not counted.
        closed_form: False to take all derivatives by differences, as for a model that has none in
            closed form.
    """
    plant = task.plant
    if not closed_form:
        plant.closed_form_memory.tree = None

    meter = _Meter(lambda: plant.engine_steps)
    costs: list[float] = []
    times: list[float] = []
    parts = meter.parts

    def note(event: DesignEvent) -> None:
        """Forget what was before the first iterate, and keep the parts up to the latest one."""
        nonlocal parts
        if not costs:
            meter.parts = {REST: Part()}
        parts = copy.deepcopy(meter.parts)
        costs.append(event.row.cost)
        times.append(time.process_time())

    with meter.attached():
        design_task(task, callback=note)

    counted = sum(part.seconds for part in parts.values())
    parts[REST].seconds = max(times[-1] - times[0] - counted, 0.0)
    return IterationParts(
        iterations=max(len(costs) - 1, 1),
        parts=parts,
        costs=tuple(costs),
        bare_step=bare_step_time(plant.source.model, task),
    )


def bare_step_time(model: Any, task: DesignTask) -> float:
    """Time of `mj_step` alone, with a control of the task [s]."""
    data = mujoco.MjData(model)
    data.qpos[:] = task.initial.qpos[0]
    data.ctrl[:] = task.initial.ctrl[0]
    mujoco.mj_step(model, data, BARE_STEPS // 10)
    clock = time.process_time()
    mujoco.mj_step(model, data, BARE_STEPS)
    return (time.process_time() - clock) / BARE_STEPS


def parts_table(found: IterationParts, title: str) -> Table:
    """Make a table with one row for each purpose.

    Args:
        found: The parts.
        title: Title of the table.
    """
    table = Table(title=title, title_justify="left")
    for heading in ("of an iteration", "calls", "engine steps", "seconds", "in the engine"):
        table.add_column(heading, justify="left" if heading == "of an iteration" else "right")

    n = found.iterations
    for purpose, part in sorted(found.parts.items(), key=lambda item: -item[1].seconds):
        share = part.engine / part.seconds if part.seconds > 0.0 else 0.0
        table.add_row(
            purpose,
            f"{part.calls / n:.1f}",
            f"{part.steps / n:,.0f}",
            f"{part.seconds / n:.4f} s",
            f"{min(share, 1.0):.0%}",
        )
    table.add_section()
    table.add_row("sum", "", f"{found.steps:,.0f}", f"{found.seconds:.4f} s", "")
    table.add_row("these steps by the bare engine", "", "", f"{found.engine:.4f} s", "")
    return table
