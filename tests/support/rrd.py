"""Contents of Rerun files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rerun.chunk import RrdReader

from mjfim.arrays import Array
from mjfim.output.rerun.scene import entity_path


class Recorded:
    """What a Rerun file holds.

    Attributes:
        entities: Every entity path.
    """

    def __init__(self, path: Path) -> None:
        self._reader = RrdReader(path)
        self._chunks = [
            (str(chunk.entity_path), chunk.is_static, chunk.to_record_batch())
            for chunk in self._reader.stream().to_chunks()
        ]
        self.entities = {entity for entity, _, _ in self._chunks}

    def rows(
        self, at: tuple[str, ...] | str, component: str, timeline: str | None = "sim_time"
    ) -> tuple[Array, Array]:
        """Times and values of a component, sorted by time; without a timeline, static data."""
        found: list[tuple[int, Any]] = []
        entity = at if isinstance(at, str) else entity_path(at)
        for place, is_static, batch in self._chunks:
            names = batch.schema.names
            if place != entity or component not in names:
                continue
            values = batch.column(component).to_pylist()
            if timeline in names:
                times = batch.column(timeline).cast("int64").to_pylist()
                found += zip(times, values, strict=True)
            elif timeline is None and is_static:
                found += [(0, value) for value in values]
        found.sort(key=lambda row: row[0])
        times = np.array([time for time, _ in found])
        try:
            return times, np.array([value for _, value in found])
        except ValueError:  # rows of several lengths
            return times, np.array([value for _, value in found], dtype=object)

    def scalars(self, at: tuple[str, ...] | str) -> tuple[Array, Array]:
        """Times [s] and values of a curve."""
        times, values = self.rows(at, "Scalars:scalars")
        return 1e-9 * times, np.ravel(values)

    def blueprint(self, component: str) -> dict[str, Any]:
        """The component of each part of the blueprint that has it."""
        (layout,) = self._reader.blueprints()
        return {
            str(chunk.entity_path): batch.column(component).to_pylist()[0]
            for chunk in self._reader.stream(store=layout).to_chunks()
            if component in (batch := chunk.to_record_batch()).schema.names
        }
