"""LeRobot datasets of the formats v2.1 and v3.0, written with pyarrow alone."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet


def write_dataset(
    folder: Path,
    episodes: Sequence[dict[str, np.ndarray]],
    names: dict[str, Any],
    *,
    version: str = "v3.0",
    fps: float = 100.0,
    info: dict[str, Any] | None = None,
) -> Path:
    """Write a dataset and return its folder.

    Args:
        folder: Folder of the dataset.
        episodes: (M, n) values of each feature, by episode; (M,) values are written as numbers.
        names: The names in info.json, by feature.
        version: Version of the format.
        fps: Frames per second.
        info: Further entries of info.json, and others than the right ones.
    """
    tables = []
    for number, features in enumerate(episodes):
        rows = len(next(iter(features.values())))
        columns = {
            feature: pa.array(values.astype(np.float32).tolist())
            for feature, values in features.items()
        }
        columns["timestamp"] = pa.array((np.arange(rows) / fps).astype(np.float32))
        columns["frame_index"] = pa.array(np.arange(rows))
        columns["episode_index"] = pa.array(np.full(rows, number))
        columns["observation.image"] = pa.array(["none"] * rows)
        tables.append(pa.table(columns))

    data = folder / "data" / "chunk-000"
    data.mkdir(parents=True)
    if version.startswith("v2"):
        for number, table in enumerate(tables):
            pyarrow.parquet.write_table(table, data / f"episode_{number:06d}.parquet")
    else:
        pyarrow.parquet.write_table(pa.concat_tables(tables), data / "file-000.parquet")

    described = {
        feature: {
            "dtype": "float32",
            "shape": [values.shape[1] if values.ndim > 1 else 1],
            "names": names.get(feature),
        }
        for feature, values in episodes[0].items()
    }
    described["observation.image"] = {"dtype": "video", "shape": [9, 9, 3], "names": None}
    contents = {
        "codebase_version": version,
        "total_episodes": len(episodes),
        "fps": fps,
        "features": described,
    }
    (folder / "meta").mkdir()
    text = json.dumps({**contents, **(info or {})})
    (folder / "meta" / "info.json").write_text(text, encoding="utf-8")
    return folder
