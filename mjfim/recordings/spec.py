"""The `[recording]` table of the experiment file: how the columns of a log become a recording."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False, strict=True)]
Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]
Range = tuple[Annotated[float, Field(strict=True)], Annotated[float, Field(strict=True)]]


class Section(BaseModel):
    """A table of the experiment file: immutable, no unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class ColumnSpec(Section):
    """Where one column of a recording comes from: `(scale * unit * raw + offset) * times`.

    column: of the log;  unit: of what the log holds, where it is not the model's (angles, times of angles);  scale, offset
    signed: bits of an integer that the log holds as unsigned;  period: raw numbers after which a counter begins anew
    unwrap: angles that jump by a whole turn are made continuous, once they are in rad
    times: further columns or constants of the log that it is multiplied with, as they are
    """

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
    times: tuple[str, ...] = ()


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
