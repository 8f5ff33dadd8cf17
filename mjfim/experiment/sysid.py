"""Parameters and sequences of `mujoco.sysid` as tables of parameters and as columns of logs.

They are read by their attributes, so that sysid need not be installed.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from typing import Any

import numpy as np

# Ends of the names of signals of sysid, and what mjfim calls them.
SUFFIXES = {"MjStateQPos": "qpos", "MjStateQVel": "qvel", "MjCtrl": "ctrl"}


def parameter_tables(parameters: Any) -> dict[str, dict[str, Any]]:
    """Tables of parameters of a `ParameterDict`, without the frozen ones.

    A modifier becomes a `function`. A parameter without one is a path by its name, or changes the
    guess and the bounds of the parameter that an experiment has under this name.
    """
    tables = {}
    for name, each in parameters.items():
        numbers = (
            [] if each.frozen else list(zip(each.as_vector(), *each.get_bounds(), strict=True))
        )
        waiting: dict[int, list[float]] = {}
        for i, (value, low, high) in enumerate(numbers):
            key = name if len(numbers) == 1 else f"{name}[{i}]"
            tables[key] = {"guess": float(value), "bounds": [float(low), float(high)]}
            if each.modifier is not None:
                tables[key]["function"] = _Edit(each, i, waiting)
            elif ":" in name:
                tables[key]["target"] = key
    return tables


class _Edit:
    """Function of an MjSpec for one number of a parameter whose modifier needs all of them.

    The numbers are edited in their order, and the last one calls the modifier.
    """

    def __init__(self, parameter: Any, index: int, waiting: dict[int, list[float]]) -> None:
        self._parameter, self._index, self._waiting = parameter, index, waiting

    def __call__(self, spec: Any, value: float) -> None:
        """Edit the spec."""
        if self._index == 0:
            self._waiting[id(spec)] = []
        self._waiting[id(spec)].append(value)
        if self._index == self._parameter.size - 1:
            changed = deepcopy(self._parameter)
            changed.update_from_vector(np.array(self._waiting.pop(id(spec))))
            changed.modifier(spec, changed)


def columns_of(sequences: Any) -> Iterator[tuple[str, dict[str, Any]]]:
    """Names and columns of the sequences of a `ModelSequences`; their initial states are not used.

    A time of a measurement is that of the state that is measured.
    """
    for name, control, measured in zip(
        sequences.sequence_name, sequences.control, sequences.sensordata, strict=True
    ):
        t = np.union1d(control.times, measured.times)
        columns = {"t": t}
        for series, whole in ((control, "ctrl"), (measured, "sensordata")):
            rows = np.full((len(t), series.data.shape[1]), np.nan)
            rows[np.searchsorted(t, series.times)] = series.data
            for signal, (kind, indices) in (series.signal_mapping or {whole: (None, ...)}).items():
                quantity = SUFFIXES.get(getattr(kind, "name", ""))
                key = signal
                if quantity is not None:
                    key = f"{quantity}:{signal.removesuffix(f'_{quantity}')}"
                columns[key] = rows[:, indices]
        yield name, columns
