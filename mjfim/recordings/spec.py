"""The `[recording]` table of the experiment file: how the columns of a log become a recording."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False, strict=True)]
Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]
Range = tuple[Annotated[float, Field(strict=True)], Annotated[float, Field(strict=True)]]


class Section(BaseModel):
    """A table of the experiment file: immutable, no unknown keys.

    Attributes:
        renamed_keys: Keys of earlier versions, each with the name that it has now.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    renamed_keys: ClassVar[dict[str, str]] = {}


class ColumnSpec(Section):
    """How one column of a recording is computed from the columns of a log.

    The value is `(scale * unit * raw + offset)` times the product of the columns in `multiply_by`.

    Attributes:
        column: Name of the log's column.
        unit: Unit of the log's numbers, where it differs from the model's unit.
        scale: Factor of the raw number.
        offset: Added after the scaling [unit of the model].
        signed: Number of bits of a signed integer that the log holds as an unsigned one.
        period: Raw numbers after which a counter wraps around to its first value.
        unwrap: Whether jumps of an angle by whole turns are removed, after the conversion to rad.
        multiply_by: Further columns or constants of the log, by whose raw numbers the value is multiplied.
    """

    renamed_keys = {"times": "multiply_by"}

    column: str
    unit: (
        Literal[
            "rad", "deg", "rev", "rad/s", "deg/s", "rev/s", "rpm", "m", "cm", "mm", "m/s", "mm/s"
        ]
        | None
    ) = None
    scale: Finite = 1.0
    offset: Finite = 0.0
    signed: Literal[8, 16, 32] | None = None
    period: Positive | None = None
    unwrap: bool = False
    multiply_by: tuple[str, ...] = ()


class RecordingSpec(Section):
    """How a robot's log becomes a recording. Without it a log has the columns of mjfim's own CSV.

    time: column of the stamps, in time_unit;  records: where the list of records is in a JSON file (`a.b`)
    topics: of the bag, where it holds several of joint states;  window: [s] after the first row that is used
    gap: [s] longest hole, in time or in a column, that is bridged;  columns: of the recording by name
    """

    time: str = "t"
    time_unit: Literal["s", "ms", "us", "ns"] = "s"
    records: str | None = None
    topics: tuple[str, ...] = ()
    window: Range | None = None
    gap: Positive = 0.1
    columns: dict[str, str | ColumnSpec] = {}

    @model_validator(mode="after")
    def _forward(self) -> RecordingSpec:
        if self.window is not None and not 0.0 <= self.window[0] < self.window[1]:
            raise ValueError(f"window {list(self.window)} needs 0 <= begin < end")
        return self

    @property
    def sources(self) -> dict[str, ColumnSpec]:
        """The columns, however they were written."""
        return {
            k: ColumnSpec(column=v) if isinstance(v, str) else v for k, v in self.columns.items()
        }
