"""mjfim: optimal experiment design and system identification with MuJoCo.

`propose` makes a first experiment of a model, `check` says which parameters can be identified,
`design` finds the excitation that gives the most information about them, `simulate` makes a
synthetic recording, `identify` estimates the parameters from recordings, and `monte_carlo` compares
the estimates with the Cramér-Rao bound.
"""

from importlib import import_module

__version__ = "0.1.0"

# Module of each public name, by the lines `from module import name as name` of the stub. Programs
# import each of them when they use it first: importing all of them takes seconds, in which the
# command line must be able to react to Ctrl-C. The lines are split here, because a parser would be
# imported from the current folder until `mjfim.__main__` has removed that from the search path.
with open(f"{__file__.rpartition('.')[0]}.pyi", encoding="utf-8") as _stub:
    _lines = [_line.split() for _line in _stub if _line.startswith("from ")]
MODULES = {_words[-1]: _words[1] for _words in _lines}
__all__ = sorted(MODULES)


def __getattr__(name: str) -> object:
    """Import a name when it is used first."""
    if name in MODULES:
        return getattr(import_module(MODULES[name]), name)

    raise AttributeError(f"module 'mjfim' has no attribute {name!r}")


def __dir__() -> list[str]:
    """Public names of the package, also those that are not imported yet."""
    return sorted({*__all__, "__version__", "__doc__"})
