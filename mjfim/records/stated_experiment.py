"""Record of what a correct experiment file states."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from mjfim.records.control_law import ControlLawInLoop


@dataclass(frozen=True, kw_only=True)
class StatedParameter:
    """One unknown parameter.

    Attributes:
        name: Name of the parameter.
        unit: Its unit; may be empty.
        guess: Value for which designs are made [unit].
        lower: Lower bound of the estimate, -inf without one [unit].
        upper: Upper bound of the estimate, inf without one [unit].
        nuisance: True where its accuracy is not optimised.
    """

    name: str
    unit: str
    guess: float
    lower: float
    upper: float
    nuisance: bool


@dataclass(frozen=True, kw_only=True)
class StatedOutput:
    """One measured output.

    Attributes:
        name: Column of recordings.
        unit: Its unit; may be empty.
        sigma: Standard deviation of its noise [unit].
    """

    name: str
    unit: str
    sigma: float


@dataclass(frozen=True, kw_only=True)
class StatedLimit:
    """One limit that a design keeps.

    Attributes:
        quantity: What is limited, as the key of the table `limits`.
        name: Name of the joint, the actuator or the tendon.
        lower: Lower bound [unit of the quantity].
        upper: Upper bound [unit of the quantity].
        unit: Unit of the quantity; empty where the model does not determine it.
    """

    quantity: str
    name: str
    lower: float
    upper: float
    unit: str = ""


@dataclass(frozen=True, kw_only=True)
class StatedExperiment:
    """Contents of a correct experiment file.

    Attributes:
        source: Path of the experiment file.
        model: Path of the model file.
        rate: Rate of the samples [Hz].
        horizon: Duration of a designed experiment [s]; None where it is not stated.
        parameters: The unknown parameters.
        outputs: The measured outputs.
        controls: Names of the controls.
        limits: The limits of a design, the ranges of the MJCF among them.
        controllers: The control laws, at the guess.
        missing: Keys that `check` and `design` need and that the file does not state.
        warnings: Numbers that are possible but probably not meant, in words.
    """

    source: str
    model: str
    rate: float
    horizon: float | None
    parameters: tuple[StatedParameter, ...]
    outputs: tuple[StatedOutput, ...]
    controls: tuple[str, ...]
    limits: tuple[StatedLimit, ...]
    controllers: tuple[ControlLawInLoop, ...]
    missing: tuple[str, ...]
    warnings: tuple[str, ...]

    def summary(self) -> dict[str, Any]:
        """Return the contents of `mjfim validate --json`."""
        return asdict(self)
