"""Labels of axes and panels with units, such as `slide [m]`."""

from __future__ import annotations

from dataclasses import field

from mjfim.errors import MjfimError
from mjfim.records.base import Record, record


def with_unit(name: str, unit: str) -> str:
    """Return the label of a quantity; only its name where no unit is known.

    Args:
        name: Name of the quantity.
        unit: Its unit; may be empty.
    """
    return f"{name} [{unit}]" if unit else name


@record
class Labels(Record):
    """Labels of all columns that are shown, `<name> [<unit>]` unless stated otherwise.

    Attributes:
        qpos: nq labels of the numbers of qpos.
        positions: nv labels of the positions by degree of freedom; rotations of ball and free
            joints are rotation vectors.
        velocities: nv labels of the velocities by degree of freedom.
        controls: nu labels of the controls.
        parameters: p names of the parameters, without unit.
        parameter_units: p units of the parameters; empty where a parameter has none.
        outputs: Labels of the measured columns, by column; others are shown by the name of their
            column.
    """

    qpos: tuple[str, ...]
    positions: tuple[str, ...]
    velocities: tuple[str, ...]
    controls: tuple[str, ...]
    parameters: tuple[str, ...] = ()
    parameter_units: tuple[str, ...] = ()
    outputs: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that every parameter has a unit."""
        names, units = len(self.parameters), len(self.parameter_units)
        if names != units:
            raise MjfimError(
                f"labels name {names} parameters but {units} units; give one unit (or '') per "
                "parameter"
            )

    def parameter(self, j: int) -> str:
        """Return the label of parameter j."""
        return with_unit(self.parameters[j], self.parameter_units[j])

    def output(self, column: str) -> str:
        """Return the label of a measured column."""
        return self.outputs.get(column, f"{column} [model unit]")

    def check(self, **sizes: int) -> None:
        """Check the lengths of fields.

        Args:
            sizes: Length of the data by the name of the field.

        Raises:
            MjfimError: A field has another length.
        """
        for name, size in sizes.items():
            have = len(getattr(self, name))
            if have != size:
                raise MjfimError(
                    f"labels.{name} has {have} entries, the data has {size}; give exactly {size}"
                )
