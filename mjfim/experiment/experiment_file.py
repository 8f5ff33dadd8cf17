"""Reading of an experiment file as tables, whose keys and values are not checked yet."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from mjfim.errors import ExperimentError

MAX_FILE_SIZE = 64 * 2**20  # Largest size of an experiment file [characters].
# Endings of files of other kinds, which are no experiments.
MODEL_ENDINGS = (".xml", ".mjcf", ".urdf")
LOG_ENDINGS = (".csv", ".gz", ".parquet", ".npz", ".json", ".mcap", ".db3")


def read_tables(path: Path) -> dict[str, Any]:
    """Read the keys and tables of an experiment file.

    Args:
        path: TOML file.

    Raises:
        ExperimentError: The file cannot be read, or is not TOML.
    """
    try:
        return tomllib.loads(_read_text(path))
    except OSError as error:
        raise ExperimentError(
            f"{path}: cannot read the experiment file: {error.strerror}"
        ) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        if path.suffix.lower() in MODEL_ENDINGS:
            raise ExperimentError(
                f"{path}: a model, but an experiment file (TOML) is needed, which states the "
                f"model; `mjfim init {path}` writes a first one"
            ) from None
        if path.suffix.lower() in LOG_ENDINGS:
            raise ExperimentError(
                f"{path}: a log, but an experiment file (TOML) is needed; it comes before the logs"
            ) from None
        raise ExperimentError(f"{path}: not valid TOML: {error}") from None
    except RecursionError:
        raise ExperimentError(
            f"{path}: lists or tables are nested too deeply; an experiment file needs three levels"
        ) from None


def _read_text(path: Path) -> str:
    """The text of an experiment file.

    Args:
        path: The file. Devices have no end, so that it is not read beyond the largest size.

    Raises:
        ExperimentError: The file is too large.
        OSError: The file cannot be read.
        UnicodeDecodeError: The file is not UTF-8.
    """
    with path.open(encoding="utf-8") as stream:
        text = stream.read(MAX_FILE_SIZE + 1)
    if len(text) > MAX_FILE_SIZE:
        raise ExperimentError(
            f"{path}: more than {MAX_FILE_SIZE >> 20} million characters; this is no experiment "
            "file"
        )
    return text
