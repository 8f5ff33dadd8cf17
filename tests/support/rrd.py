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

    def __init__(self, path: Path, timeline: str = "sim_time") -> None:
        self._reader, self._timeline = RrdReader(path), timeline
        self._chunks = [
            (str(chunk.entity_path), chunk.is_static, chunk.to_record_batch())
            for chunk in self._reader.stream().to_chunks()
        ]
        self.entities = {entity for entity, _, _ in self._chunks}
        assert not any("warning" in entity for entity in self.entities)

    def rows(
        self, at: tuple[str, ...] | str, component: str, timeline: str = ""
    ) -> tuple[Array, list[Any]]:
        """Times and values of a component of an entity, sorted by time."""
        name, found = timeline or self._timeline, []
        entity = at if isinstance(at, str) else entity_path(at)
        for place, _, batch in self._chunks:
            if place == entity and {component, name} <= {*batch.schema.names}:
                times = batch.column(name).cast("int64").to_pylist()
                found += zip(times, batch.column(component).to_pylist(), strict=True)
        found.sort(key=lambda row: row[0])
        return np.array([time for time, _ in found]), [value for _, value in found]

    def static(self, at: tuple[str, ...] | str, component: str) -> list[Any]:
        """Values of a component that belong to no time."""
        entity = at if isinstance(at, str) else entity_path(at)
        return [
            value
            for place, is_static, batch in self._chunks
            if is_static and place == entity and component in batch.schema.names
            for value in batch.column(component).to_pylist()
        ]

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
