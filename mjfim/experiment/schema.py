"""The experiment file as a checked record, with the names of its keys in TOML and in Python."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, InstanceOf, ValidationError
from pydantic.json_schema import SkipJsonSchema
from pydantic_core import PydanticSerializationError

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, ModelError, unknown
from mjfim.experiment.arguments import checked
from mjfim.experiment.system_tables import (
    ControllerSpec,
    Correlated,
    Initial,
    NoiseSpec,
    Nuisance,
    ParameterSpec,
    TermSpec,
)
from mjfim.experiment.task_tables import (
    Boundary,
    Cost,
    Descent,
    FitSpec,
    Limits,
    RehearsalSpec,
    Robust,
)
from mjfim.model.model_files import PackedFiles
from mjfim.recordings.section import (
    Hertz,
    PositiveWithUnit,
    RecordingSpec,
    Seconds,
    Section,
    explain,
)

# Texts that are paths of models, for which nothing needs to be read yet.
MODEL_PATH = re.compile(r"[^<\0]*\.(xml|mjcf|urdf)", re.IGNORECASE)

# Endings of files of other kinds, which are no experiments.
MODEL_ENDINGS = (".xml", ".mjcf", ".urdf")
LOG_ENDINGS = (".csv", ".gz", ".parquet", ".npz", ".json", ".mcap", ".db3")

DIALECT = "https://json-schema.org/draft/2020-12/schema"  # Dialect of the JSON schema.


class Experiment(Section):
    """An experiment: the model, its unknown parameters, the measurements and the task.

    Immutable; `replace` makes a changed copy. Relative paths inside are relative to `directory`,
    the folder of the experiment file.
    """

    only_in_python = ("directory", "source", "files")

    model: str = Field(
        description=(
            "Path of the MJCF or URDF file, relative to the experiment file, or a name of the "
            "package robot_descriptions, such as `so_arm100_mj_description`."
        )
    )
    rate: Hertz = Field(
        description=(
            "Rate of the samples and of the control updates [Hz]. One sample is a whole number of "
            "engine time steps."
        )
    )
    measure_rate: Hertz | None = Field(
        default=None,
        description="Rate of the measurements [Hz]; it divides `rate`. Default: `rate`.",
    )
    playback_rate: Hertz | None = Field(
        default=None,
        description=(
            "Rate of the rows of design.csv, that of the robot's controller [Hz]; a multiple of "
            "`rate`. Default: `rate`."
        ),
    )
    horizon: Seconds | None = Field(
        default=None,
        description=(
            "Duration of a designed experiment [s], a whole number of samples. Identification "
            "does not need it."
        ),
    )
    initial: Initial = Field(
        default=Initial(), description="Initial state and initial control of the experiment."
    )
    terms: dict[str, TermSpec] = Field(
        default_factory=dict,
        description=(
            "Physical terms that are added to the model, such as Stribeck friction of a joint or "
            "the lag of an actuator, by name, one table each. Default: none."
        ),
    )
    parameters: dict[str, ParameterSpec] = Field(
        min_length=1,
        description=(
            "Unknown parameters by name, one table each. Their order in the file is the order of "
            "theta."
        ),
    )
    controllers: dict[str, ControllerSpec] = Field(
        default_factory=dict,
        description=(
            "Laws with which the drivers of actuators compute their controls, one table by name of "
            "the actuator. A log then holds the column `reference:<actuator>` instead of "
            "`ctrl:<actuator>`. Default: logs hold the controls themselves."
        ),
    )
    noise: dict[str, PositiveWithUnit | NoiseSpec] = Field(
        default_factory=dict,
        description=(
            "Measured outputs: standard deviation of the noise [output unit] or a table, by "
            "`state` (all positions and velocities), `qpos:<joint>`, `qvel:<joint>` or sensor "
            "name. Default: the sensors whose `noise` the MJCF states."
        ),
    )
    correlated: tuple[Correlated, ...] = Field(
        default=(), description="Covariances of outputs whose noise is correlated."
    )
    nuisance: Nuisance = Field(
        default=Nuisance(),
        description=(
            "Deviations of the initial state, biases and delay that are unknown, but whose "
            "accuracy the design does not optimise."
        ),
    )
    earlier: tuple[str, ...] = Field(
        default=(),
        description=(
            "Files design.json or estimate.json of other experiments. Their information is added "
            "to the information of this experiment. Of estimates, `check` and `design` take the "
            "noise as well, and widen σ by honest over formal σ."
        ),
    )
    cost: Cost = Field(default=Cost(), description="The cost that a design minimises.")
    robust: Robust | None = Field(
        default=None,
        description=(
            "Design that allows for an inaccurate guess. Default: the design is made for the guess "
            "alone."
        ),
    )
    descent: Descent = Field(default=Descent(), description="How a design minimises the cost.")
    limits: Limits = Field(default=Limits(), description="Hard limits of a design.")
    boundary: Boundary = Field(
        default=Boundary(), description="States in which a design begins and ends."
    )
    rehearsal: RehearsalSpec = Field(
        default=RehearsalSpec(), description="Robots on which a design is rehearsed."
    )
    recording: RecordingSpec = Field(
        default=RecordingSpec(),
        description=(
            "How the columns of a log become a recording. Default: the columns are named as in the "
            "CSV files that mjfim writes."
        ),
    )
    fit: FitSpec = Field(
        default=FitSpec(), description="How parameters are estimated from recordings."
    )
    directory: SkipJsonSchema[Path] = Field(
        default=Path("."),
        exclude=True,
        description="Folder to which paths inside the experiment are relative.",
    )
    source: SkipJsonSchema[str] = Field(
        default="experiment",
        exclude=True,
        description="Name of the experiment in messages, the path of its file.",
    )
    files: SkipJsonSchema[InstanceOf[PackedFiles] | None] = Field(
        default=None,
        exclude=True,
        description="Files of a packed experiment, which are not read from the disk any more.",
    )

    def __init__(self, **values: Any) -> None:
        """Check the values of an experiment.

        Args:
            **values: Keys and tables, with the names of the experiment file. `model` is a path, the
                text of an MJCF or URDF, an MjSpec, an MjModel, or a name of robot_descriptions.
                `parameters` is a table, in which a path stands for `{"target": path}`, a
                `ParameterDict` of mujoco.sysid, or a list of paths, in which `*` stands for any
                text and each match is a parameter with the path as its name.

        Raises:
            ExperimentError: A key or a value is not valid; the message has one line per fault.
        """
        source = str(values.get("source", "experiment"))
        try:
            values = _plain(values)
        except RecursionError:
            raise ExperimentError(f"{source}: tables stand too deep inside each other") from None
        _hold_model(values, source)
        if "parameters" in values:
            values["parameters"] = _tables(values["parameters"])
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise ExperimentError(explain(error, source, values)) from None

    @staticmethod
    @checked
    def from_file(path: str | Path) -> Experiment:
        """Read an experiment file (TOML); its folder becomes `directory`.

        Raises:
            ExperimentError: The file cannot be read, or a key or a value in it is not valid.
        """
        path = Path(path)
        try:
            values = tomllib.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise ExperimentError(
                f"{path}: cannot read the experiment file: {error.strerror}"
            ) from None
        except (ValueError, RecursionError) as error:
            fault = f"not valid TOML: {error}"
            if path.suffix.lower() in MODEL_ENDINGS:
                fault = (
                    "a model, but an experiment file (TOML) is needed, which states the model; "
                    f"`mjfim init {path}` writes a first one"
                )
            if path.suffix.lower() in LOG_ENDINGS:
                fault = "a log, but an experiment file (TOML) is needed; it comes before the logs"
            raise ExperimentError(f"{path}: {fault}") from None
        for key in Experiment.only_in_python:
            if key in values:
                raise ExperimentError(f"{path}: {unknown('key', key, Experiment.valid_keys())}")
        return Experiment(**values, directory=path.parent, source=str(path))

    def replace(self, **tables: Any) -> Experiment:
        """Make a changed copy, which is checked again.

        Tables merge into the old ones, one level deep: `experiment.replace(cost={"control": 1e-2})`
        keeps the other keys of `cost`. The table `parameters` merges parameter by parameter. None
        removes what is stated: `replace(parameters={"m": None}, noise={"qvel:slide": None})`. A
        list of parameters replaces all of them.

        Args:
            **tables: Keys and tables to change, as for `Experiment`.

        Raises:
            ExperimentError: A new value is not valid.
        """
        values = self.model_dump(exclude_unset=True)
        for key, value in tables.items():
            is_named = key == "parameters"
            given = _tables(_plain(value)) if is_named else value
            values = _merged(values, {key: given}, levels=3 if is_named else 2)
        return self.restated(values)

    def restated(self, values: Mapping[str, Any]) -> Experiment:
        """Make an experiment of other keys with the folder, the name and the files of this one.

        Args:
            values: All keys and tables, with the names of the experiment file.

        Raises:
            ExperimentError: A value is not valid.
        """
        place = {"directory": self.directory, "source": self.source, "files": self.files}
        return Experiment(**{**place, **values})

    def stated(self) -> dict[str, Any]:
        """All keys that are stated, with the folder and the name, as JSON holds them.

        Raises:
            TypeError: A parameter is a Python function, which no file can hold.
        """
        try:
            values = self.model_dump(mode="json", exclude_unset=True)
        except PydanticSerializationError:
            raise TypeError("a parameter that is a Python function cannot be saved") from None
        return {**values, "directory": str(self.directory), "source": self.source}

    def packed(self) -> Experiment:
        """Make a copy that contains all its files, for a process that has none of them.

        The copy holds the model with its included files and assets, the table of the initial
        control, previous designs and earlier results as bytes. It can be pickled, and a worker
        process on another computer computes with it to the last digit what this process does.
        The files are read now; what changes in them later does not concern the copy.

        Returns:
            The copy; this experiment itself if it contains all its files already.

        Raises:
            ExperimentError: A file cannot be read.
            ModelError: There is no such model file.
        """
        before = self.files or PackedFiles.of({})
        tables = [self.directory / name for name in self.tables]
        files = before.with_model(self.directory / self.model)
        if all(files.content(file) is not None for file in tables):
            return self if files is before else self.model_copy(update={"files": files})
        needed = [*map(Path, files.contents), *tables]
        return self.model_copy(update={"files": PackedFiles.read(needed, files)})

    @property
    def tables(self) -> tuple[str, ...]:
        """Names of the files that the experiment states besides its model."""
        control = self.initial.control
        files = [control] if isinstance(control, str) else []
        return tuple(dict.fromkeys([*self.descent.previous, *self.earlier, *files]))


# An experiment, or the path of its file.
ExperimentLike = Experiment | str | Path


def experiment_of(given: ExperimentLike) -> Experiment:
    """The experiment, read where its path is given."""
    return given if isinstance(given, Experiment) else Experiment.from_file(given)


def _plain(value: Any) -> Any:
    """A value with lists and numbers in place of arrays and numbers of NumPy."""
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value


def _hold_model(values: dict[str, Any], source: str) -> None:
    """Replace a model that Python gives by its name and files, and a list of paths by tables."""
    directory, files = values.get("directory", "."), values.get("files")
    is_placed = isinstance(directory, (str, Path)) and isinstance(files, PackedFiles | None)
    if "model" not in values or not is_placed:
        return
    model, patterns = values["model"], values.get("parameters")
    listed = patterns if isinstance(patterns, list) else []
    is_list = bool(listed) and all(isinstance(each, str) for each in listed)
    is_path = isinstance(model, (str, Path)) and MODEL_PATH.fullmatch(str(model))
    if is_path and not is_list:
        values["model"] = str(model)
        return

    # They import the engine, which takes long where a key of a file is wrong.
    from mjfim.model.given import packed
    from mjfim.model.loading import packed_model
    from mjfim.model.paths import matches

    try:
        values["model"], given = packed(model, Path(directory))
        if given is not None:
            held = {} if files is None else files.contents
            contents = {Path(name): each for name, each in {**held, **given.contents}.items()}
            values["files"] = files = PackedFiles.of(contents)

        if is_list:
            path = Path(directory) / values["model"]
            found = packed_model((files or PackedFiles.of({})).with_model(path), path)
            paths = matches(listed, found.model, found.decoration)
            values["parameters"] = {each: {"target": each} for each in paths}
    except (ExperimentError, ModelError) as error:
        raise type(error)(f"{source}: {error}") from None


def _tables(parameters: Any) -> Any:
    """The tables of parameters by name; a path stands for its table."""
    if hasattr(parameters, "as_nominal_vector"):
        return parameter_tables(parameters)
    if not isinstance(parameters, Mapping):
        return parameters
    return {
        name: {"target": table} if isinstance(table, str) else table
        for name, table in parameters.items()
    }


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


def json_schema() -> dict[str, Any]:
    """JSON schema of the experiment file, for editors that complete and check TOML.

    Returns:
        The schema with the description of every key; keys that exist only in Python are left out.
    """
    schema = Experiment.model_json_schema()

    return {"$schema": DIALECT, **schema, "title": "mjfim experiment"}


def by_name(
    key: str, value: float | Mapping[str, float], names: tuple[str, ...], kind: str
) -> Array:
    """Turn one number for all names, or a table by name, into an array.

    Args:
        key: Key of the experiment file, for messages.
        value: One number, or numbers by name; names that the table leaves out get 0.
        names: The n valid names.
        kind: Noun for a name in messages, such as "actuator".

    Returns:
        (n,) values in the order of the names.

    Raises:
        ExperimentError: The table holds an unknown name.
    """
    if not isinstance(value, Mapping):
        return np.full(len(names), float(value))

    for name in value:
        if name not in names:
            raise ExperimentError(f"{key}: {unknown(kind, name, names)}")

    return np.array([float(value.get(name, 0.0)) for name in names])


def _merged(old: Any, new: Any, levels: int) -> Any:
    """A value with its changes; tables merge down to some levels, and None removes a key."""
    if levels == 0 or not isinstance(old, Mapping) or not isinstance(new, Mapping):
        return new
    removed = {key for key, value in new.items() if value is None and key in old}
    changed = {key: _merged(old.get(key), value, levels - 1) for key, value in new.items()}
    return {key: value for key, value in {**old, **changed}.items() if key not in removed}
