"""The array type and small functions on arrays that all packages use."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, TypeVar, dataclass_transform

import numpy as np
from numpy.typing import NDArray


class Stored:
    """Reader of arrays for pydantic: by the name under which an archive holds an array."""

    @staticmethod
    def __get_pydantic_core_schema__(source: Any, handler: Any) -> Any:
        """Schema that looks the name up in the arrays of the context."""
        from pydantic_core import core_schema  # slow, and needed only where a file is read

        return core_schema.with_info_plain_validator_function(_stored_array)


def _stored_array(name: Any, info: Any) -> np.ndarray:
    """The array of numbers that an archive holds under a name; ValueError where there is none."""
    array = info.context.get(name) if isinstance(name, str) else None
    if array is None:
        raise ValueError(f"the array {name!r} is missing")
    if array.dtype.kind not in "fiub":
        raise ValueError(f"the array {name!r} does not hold numbers")
    found: np.ndarray = array
    return found


Array = Annotated[NDArray[np.float64], Stored]

# Half width of the 95 % interval of a normal distribution [standard deviations].
NORMAL_95 = 1.959963984540054

# Half width of a 95 % interval over the size of the value (an entry of a vector or tensor has the
# size of the whole), from which on a parameter is poorly known, and from which on experiments do
# not determine it. They hold for predicted and for found intervals.
POORLY_KNOWN_SHARE = 0.25
UNDETERMINED_SHARE = 0.5

# Lower bound of the diagonal entries by which a matrix is scaled; it avoids a division by zero.
SMALLEST_DIAGONAL = 1e-300


T = TypeVar("T")


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(field,))
def record(kind: type[T]) -> type[T]:
    """Make a frozen dataclass whose fields are keywords. One that holds arrays equals itself only.

    `array_fields` of the class names the arrays, which the base class of saved records freezes.
    Modules that `mjfim --help` loads use `dataclass`, because this one imports NumPy.
    """
    hints = kind.__annotations__.items()
    arrays = tuple(name for name, hint in hints if hint in ("Array", "Array | None"))
    kind.array_fields = arrays  # type: ignore[attr-defined]
    has_repr = kind.__repr__ is not object.__repr__
    return dataclass(frozen=True, kw_only=True, eq=not arrays, repr=not has_repr)(kind)


def finite_or_nan(values: Array) -> Array:
    """Return the finite ones of some values, and NaN in the place of others."""
    return np.where(np.isfinite(values), values, np.nan)


def freeze(record: object, *names: str) -> None:
    """Replace named fields of a frozen record by read-only float64 arrays.

    Records share arrays that nobody can change; all other arrays are copied.

    Args:
        record: Instance of a frozen dataclass.
        *names: Fields to replace.
    """
    for name in names:
        given = getattr(record, name)
        if not _is_frozen(given):
            given = np.array(given, dtype=np.float64)
            given.setflags(write=False)
        object.__setattr__(record, name, given)


def _is_frozen(array: object) -> bool:
    """Whether this is a read-only float64 array, and no view of an array that can be written."""
    if type(array) is not np.ndarray or array.dtype != np.float64:
        return False
    owner: object = array
    while type(owner) is np.ndarray and not owner.flags.writeable:
        if owner.base is None:
            return True
        owner = owner.base

    # A file that is mapped for reading only cannot be changed through the array.
    return isinstance(owner, np.memmap) and owner.mode == "r"


def evenly_spread_indices(count: int, limit: int) -> NDArray[np.intp]:
    """Indices of at most `limit` out of `count` rows, evenly spread from the first to the last row.

    Args:
        count: Number of rows.
        limit: Largest number of indices.

    Returns:
        (min(count, limit),) ascending indices.
    """
    return np.unique(np.linspace(0, count - 1, min(count, limit)).astype(np.intp))


def scaled_to_unit_diagonal(matrix: Array) -> tuple[Array, Array]:
    """Scale rows and columns of a symmetric positive semidefinite matrix so that its diagonal is 1.

    Eigenvalues, rank and condition of the scaled matrix do not depend on the units of the unknowns.

    Args:
        matrix: (..., n, n) symmetric positive semidefinite matrices.

    Returns:
        The scaled matrices: (..., n, n), and the square roots of their diagonals: (..., n), by
        which rows and columns were divided. Rows that are zero stay zero.
    """
    diagonal = np.diagonal(matrix, axis1=-2, axis2=-1)
    scale = np.asarray(np.sqrt(np.maximum(diagonal, SMALLEST_DIAGONAL)), dtype=np.float64)
    return matrix / (scale[..., :, None] * scale[..., None, :]), scale


def scaled_pseudo_inverse(matrix: Array, tolerance: float) -> Array:
    """Pseudo-inverse of a symmetric positive semidefinite matrix.

    The matrix is scaled to unit diagonal first, so that its rank does not depend on the units of
    the unknowns.

    Args:
        matrix: (n, n) symmetric positive semidefinite matrix.
        tolerance: Eigenvalues of the scaled matrix below this fraction of the largest one count as
            zero.

    Returns:
        (n, n) pseudo-inverse.
    """
    scaled, scale = scaled_to_unit_diagonal(matrix)
    inverse = np.linalg.pinv(scaled, rcond=tolerance, hermitian=True)
    return np.asarray(inverse / np.outer(scale, scale))
