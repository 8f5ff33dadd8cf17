"""The architecture over the syntax tree: imports go one way, heavy libraries stay in their corner, nothing unpickles."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping, Sequence
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "mjfim"

# A part imports only from those before it; a part is a module, or a folder of modules.
ORDER = (
    "errors",
    "trajectory",
    "files",
    "quiet",
    "tangent",
    "lq",
    "barrier",
    "spectral",
    "pronto",
    "directions",
    "newton",
    "basis",
    "clearance",
    "inertia",
    "slots",
    "paths",
    "units",
    "mjcf",
    "dry",
    "models",
    "level",
    "parameters",
    "retouch",
    "noise",
    "lag",
    "outputs",
    "engine",
    "workers",
    "fence",
    "plant",
    "extended",
    "criteria",
    "fisher",
    "robust",
    "objective",
    "interior",
    "ladder",
    "experiment",
    "tables",
    "sensing",
    "earlier",
    "unknowns",
    "limits",
    "signals",
    "setup",
    "logs",
    "bounds",
    "starts",
    "identifiability",
    "survey",
    "roughness",
    "descent",
    "enclosed",
    "audit",
    "contest",
    "evaluation",
    "designer",
    "together",
    "goals",
    "bracket",
    "duration",
    "excitations",
    "arena",
    "series",
    "baselines",
    "comparison",
    "compare",
    "selftest",
    "losses",
    "condensed",
    "levenberg",
    "layout",
    "tracks",
    "pieces",
    "residuals",
    "whiteness",
    "misfit",
    "uncertainty",
    "accuracy",
    "left",
    "prediction",
    "suspects",
    "estimated",
    "estimate",
    "montecarlo",
    "campaign",
    "redesign",
    "sequential",
    "checker",
    "playback",
    "archive",
    "identified",
    "labels",
    "places",
    "rerun_log",
    "plots",
    "report",
    "__init__",
    "results",
    "cli",
    "__main__",
)

# The only parts that may import a library.
CORNERS = {
    "rerun": {"rerun_log"},
    "matplotlib": {"plots"},
    "typer": {"cli"},
    "rich": {"cli", "report"},
    "pydantic": {"experiment"},
}

# What a part must not reach, not even through others.
FORBIDDEN = {
    "lq": {"mujoco", "mjfim.fisher", "mjfim.plant", "mjfim.objective"},
    "pronto": {"mujoco", "mjfim.fisher", "mjfim.plant", "mjfim.objective"},
    "trajectory": {"mujoco"},
    "barrier": {"mujoco", "mjfim.plant", "mjfim.fence"},
    "basis": {"mujoco", "mjfim.plant"},
    "spectral": {"mujoco", "mjfim.plant", "mjfim.fisher"},
    "newton": {"mujoco", "mjfim.plant", "mjfim.fence", "mjfim.objective"},
    "experiment": {"mujoco"},
    "inertia": {"mujoco"},
    "noise": {"mujoco"},
    "lag": {"mujoco"},
    "criteria": {"mujoco", "mjfim.plant"},
    "identifiability": {"mujoco", "mjfim.plant", "mjfim.setup"},
}

HEAVY = {"mjfim.rerun_log", "mjfim.results"}  # cli imports these where they are needed
UNSAFE = {"pickle", "cPickle", "dill", "marshal", "shelve", "joblib", "cloudpickle"}


def read_package() -> dict[str, str]:
    """Source by module: `mjfim.lq`, `mjfim.plots.design`; a package's own file is `mjfim.plots`."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = ["mjfim", *path.relative_to(PACKAGE).with_suffix("").parts]
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path.read_text(encoding="utf-8")
    return found


def part(module: str) -> str:
    """The entry of ORDER to which a module of the package belongs."""
    return module.split(".")[1] if "." in module else "__init__"


def targets(node: ast.AST, modules: Mapping[str, str]) -> Iterator[str]:
    """Modules that one import statement names; `from mjfim import x` is `mjfim.x` where that is a module."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        if node.level or node.module is None:
            raise AssertionError(f"line {node.lineno}: relative import; write out `from mjfim...`")
        for alias in node.names:
            inner = f"{node.module}.{alias.name}"
            yield inner if inner in modules else node.module


def imports(source: str, modules: Mapping[str, str]) -> set[str]:
    """Everything that a source imports, at any depth."""
    return {name for node in ast.walk(ast.parse(source)) for name in targets(node, modules)}


def graph(modules: Mapping[str, str], deferred: bool = True) -> dict[str, set[str]]:
    """Imports among the modules themselves; deferred: those inside functions as well."""
    edges = {}
    for name, source in modules.items():
        found = imports(source, modules)
        if not deferred:
            found -= {target for _, target in inner_imports(source, modules)}
        edges[name] = found & set(modules) - {name}
    return edges


def cycle(modules: Mapping[str, str]) -> list[str] | None:
    """Modules of one import cycle, or None."""
    try:
        list(TopologicalSorter(graph(modules)).static_order())
    except CycleError as error:
        return list(error.args[1])
    return None


def upward(modules: Mapping[str, str], order: Sequence[str]) -> list[str]:
    """Sentences on imports of a part that does not come before the importing one."""
    place = {name: i for i, name in enumerate(order)}
    return [
        f"{name} imports {target}"
        for name, found in graph(modules).items()
        for target in sorted(found)
        if part(name) != part(target) and place[part(target)] >= place[part(name)]
    ]


def reach(module: str, modules: Mapping[str, str]) -> set[str]:
    """All that a module imports, directly or through other modules of the package; libraries by their first name."""
    seen: set[str] = set()
    waiting = [module]
    while waiting:
        for name in imports(modules[waiting.pop()], modules):
            known = name if name in modules else name.split(".")[0]
            if known not in seen:
                seen.add(known)
                waiting += [known] if known in modules else []
    return seen


def inner_imports(source: str, modules: Mapping[str, str]) -> Iterator[tuple[int, str]]:
    """Line and target of the imports inside functions."""
    for function in ast.walk(ast.parse(source)):
        if isinstance(function, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
            for node in ast.walk(function):
                yield from ((node.lineno, name) for name in targets(node, modules))  # type: ignore[attr-defined]


def unsafe(source: str) -> list[str]:
    """Sentences on eval, exec, pickle and anything but a plain `allow_pickle=False`."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            names = UNSAFE & {name.split(".")[0] for name in targets(node, {})}
            found += [f"line {node.lineno}: {name}" for name in sorted(names)]
        if isinstance(node, ast.Name) and node.id in ("eval", "exec", "__import__"):
            found.append(f"line {node.lineno}: {node.id}")
        if isinstance(node, ast.keyword) and node.arg == "allow_pickle":
            refused = isinstance(node.value, ast.Constant) and node.value.value is False
            found += [] if refused else [f"line {node.value.lineno}: allow_pickle"]
    return found


MODULES = read_package()


def test_every_part_has_a_place() -> None:
    """A new module must be put into ORDER, and ORDER names nothing that is gone."""
    assert {part(name) for name in MODULES} == set(ORDER)


def test_no_cycles() -> None:
    """The modules have a topological order."""
    assert cycle(MODULES) is None


def test_imports_go_one_way() -> None:
    """No module imports from a later part."""
    assert upward(MODULES, ORDER) == []


@pytest.mark.parametrize("name", FORBIDDEN)
def test_lower_layers_stay_ignorant(name: str) -> None:
    """The linear algebra and the descent know neither MuJoCo nor Fisher, not even through others."""
    assert reach(f"mjfim.{name}", MODULES) & FORBIDDEN[name] == set()


@pytest.mark.parametrize("library", CORNERS)
def test_libraries_stay_in_their_corner(library: str) -> None:
    """Only the named parts import rerun, matplotlib, typer, and they do."""
    users = {
        part(name)
        for name, source in MODULES.items()
        if library in {target.split(".")[0] for target in imports(source, MODULES)}
    }
    assert users == CORNERS[library]


def test_importing_the_package_stays_light() -> None:
    """`import mjfim` draws neither rerun nor matplotlib nor typer; the command line draws the first two on demand."""
    assert reach("mjfim", MODULES) & {"rerun", "matplotlib", "typer", "rich"} == set()
    assert graph(MODULES, deferred=False)["mjfim.cli"] & HEAVY == set()


def test_imports_stand_at_the_top() -> None:
    """Inside functions only the command line imports, and only the heavy parts."""
    found = {(name, target) for name, source in MODULES.items() for _, target in inner_imports(source, MODULES)}
    assert found == {("mjfim.cli", target) for target in HEAVY}


@pytest.mark.parametrize("name", MODULES)
def test_nothing_unpickles_or_evaluates(name: str) -> None:
    """No eval, exec, pickle, allow_pickle=True."""
    assert unsafe(MODULES[name]) == []


MADE_UP = {
    "mjfim": "from mjfim.high import go",
    "mjfim.low": "import numpy as np",
    "mjfim.middle": "from mjfim import low\nimport mujoco.viewer",
    "mjfim.high": "from mjfim.middle import thing",
}


def test_checker_accepts_a_clean_set() -> None:
    """What the checks below must tell from faulty sets."""
    assert cycle(MADE_UP) is None
    assert upward(MADE_UP, ("low", "middle", "high", "__init__")) == []
    assert reach("mjfim.high", MADE_UP) == {"mjfim.middle", "mjfim.low", "numpy", "mujoco"}


@pytest.mark.parametrize("fault", ["import mjfim.high", "from mjfim import high", "def f():\n    import mjfim.high"])
def test_checker_finds_a_cycle(fault: str) -> None:
    """A cycle through three modules, however it is written."""
    found = cycle({**MADE_UP, "mjfim.low": fault})
    assert found is not None
    assert set(found) == {"mjfim.low", "mjfim.middle", "mjfim.high"}


def test_checker_finds_an_upward_import() -> None:
    """No cycle, yet against the order."""
    assert upward(MADE_UP, ("middle", "low", "high", "__init__")) == ["mjfim.middle imports mjfim.low"]


def test_checker_finds_imports_in_functions() -> None:
    """With line and target, in methods too."""
    source = "import os\nclass A:\n    def f(self):\n        from mjfim import low\n"
    assert set(inner_imports(source, MADE_UP)) == {(4, "mjfim.low")}


@pytest.mark.parametrize(
    "source",
    [
        "eval('1')",
        "exec('x = 1')",
        "f = eval",
        "import pickle",
        "from pickle import loads",
        "import numpy as np\nnp.load('x', allow_pickle=True)",
        "np.load('x', allow_pickle=flag)",
    ],
)
def test_checker_finds_unsafe_code(source: str) -> None:
    """Each of these must be reported once."""
    assert len(unsafe(source)) == 1


def test_checker_accepts_refused_pickles() -> None:
    """`allow_pickle=False` is what we want."""
    assert unsafe("np.load('x', allow_pickle=False)") == []


def test_checker_refuses_relative_imports() -> None:
    """They would slip through the check of the order."""
    with pytest.raises(AssertionError, match="relative import"):
        imports("from . import low", MADE_UP)
