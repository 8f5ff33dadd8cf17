"""The `[recording]` table of the experiment file: how the columns of a log become a recording."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from mjfim.recordings.section import Boolean, Finite, Period, Positive, Seconds, Section

# Units that a column of a log may have; their factors are in `mjfim.recordings.quantities`.
LogUnit = Literal[
    "rad", "deg", "rev", "rad/s", "deg/s", "rev/s", "rpm", "m", "cm", "mm", "m/s", "mm/s"
]


# Beginnings of the names of columns that control laws read, and of all columns that drive a
# simulation.
LAW_PREFIXES = ("reference:", "reference_velocity:", "feedforward:", "gain:", "enable:")
INPUT_PREFIXES = ("ctrl:", *LAW_PREFIXES)


class ColumnSpec(Section):
    """Rule by which one column of a recording is computed from the columns of a log.

    The value is `(scale * unit * raw + offset)` times the product of the columns in `multiply_by`.
    """

    column: str = Field(description="Name of the column in the log.")
    unit: LogUnit | None = Field(
        default=None, description="Unit of the column in the log. Default: the model's unit."
    )
    scale: Finite = Field(
        default=1.0, description="Factor by which the raw numbers are multiplied."
    )
    offset: Finite = Field(
        default=0.0, description="Constant that is added after scaling [unit of the model]."
    )
    signed: Literal[8, 16, 32] | None = Field(
        default=None,
        description=(
            "Number of bits of signed integers that the log holds as unsigned ones. Default: the "
            "numbers in the log already have a sign."
        ),
    )
    period: Positive | None = Field(
        default=None,
        description=(
            "Raw number at which a counter starts again from 0; these jumps are removed. Default: "
            "the column is not a counter."
        ),
    )
    unwrap: Boolean = Field(
        default=False, description="true: jumps of an angle by a whole turn are removed."
    )
    multiply_by: tuple[str, ...] = Field(
        default=(),
        description="Further columns or constants of the log by which the value is multiplied.",
    )


class RecordingSpec(Section):
    """Rules by which the log of a robot becomes a recording.

    By default, the log has the columns of the CSV files that mjfim writes.
    """

    time: str = Field(default="t", description="Column of the time stamps.")
    time_unit: Literal["s", "ms", "us", "ns"] = Field(
        default="s", description="Unit of the time stamps."
    )
    records: str | None = Field(
        default=None,
        description=(
            "Path of the list of records inside a JSON file, as keys joined by dots, such as "
            "`data.entries`. Default: the only list of records that the file holds."
        ),
    )
    topics: tuple[str, ...] = Field(
        default=(),
        description=(
            "Topics of the joint states of a ROS bag. Default: the only such topic in the bag."
        ),
    )
    episodes: tuple[Annotated[int, Field(ge=0, strict=True)], ...] = Field(
        default=(),
        description=(
            "Numbers of the episodes of a LeRobot dataset, each of which is one recording. "
            "Default: all episodes."
        ),
    )
    window: Period | None = Field(
        default=None,
        description=(
            "First and last time that are used, counted from the first row [s]. Default: all rows."
        ),
    )
    gap: Seconds = Field(
        default=0.1,
        description="Longest accepted gap in the time stamps or in a column [s].",
    )
    columns: dict[str, str | Finite | ColumnSpec] = Field(
        default={},
        description=(
            "Sources of the columns of the recording, by `ctrl:<actuator>`, `qpos:<joint>`, "
            "`qvel:<joint>` or sensor, and with a law in `controllers` by `reference:<actuator>` "
            "and what else it reads: the name of a column of the log, or a table; for a control "
            "also a number, its constant value (0.0 for a motor that is off). Default: the "
            "columns of the log have these names."
        ),
    )

    @model_validator(mode="after")
    def _window_increases(self) -> RecordingSpec:
        """Refuse a window that begins before the log or ends before it begins."""
        if self.window is not None and not 0.0 <= self.window[0] < self.window[1]:
            raise ValueError(f"window {list(self.window)} needs 0 <= begin < end")
        return self

    @property
    def sources(self) -> dict[str, ColumnSpec]:
        """Rule of every stated column of a log; a mere name becomes a rule without conversion."""
        return {
            name: ColumnSpec(column=source) if isinstance(source, str) else source
            for name, source in self.columns.items()
            if not isinstance(source, float)
        }

    @property
    def constants(self) -> dict[str, float]:
        """Constant values, which no column of a log holds [unit of the model]."""
        return {name: source for name, source in self.columns.items() if isinstance(source, float)}
