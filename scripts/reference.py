"""Write what the reference pages say of the package itself into their files.

    python -m scripts.reference

The text behind a comment such as `<!-- generated: terms -->`, up to `<!-- end -->`, is that of the
function of this name in `PARTS`. Words behind the colon of `keys:` and `python:` are names of
`mjfim`.
"""

from __future__ import annotations

import ast
import inspect
import json
import re
import textwrap
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields
from pathlib import Path
from pydoc import locate
from typing import Any

from typer.main import get_command

import mjfim.cli.main  # noqa: F401 -- it registers the verbs
from mjfim.cli.common import app
from mjfim.experiment.schema import json_schema
from mjfim.model.paths import MODEL_ARRAYS, fields_of
from mjfim.model.terms.library import KINDS
from mjfim.records.base import Verdict

FOLDER = Path(__file__).resolve().parent.parent / "docs" / "reference"
SCHEMA = FOLDER / "experiment.schema.json"
PART = re.compile(r"(<!-- generated: ([\w ]+):?(.*?) -->\n).*?(?=<!-- end -->)", re.DOTALL)

# Entries of the section `Attributes` of a docstring.
ATTRIBUTE = re.compile(r"^    (\w+): (.*(?:\n {8}.*)*)", re.MULTILINE)

# Kinds of paths whose fields do not depend on the model.
PATHS = (*MODEL_ARRAYS, "controller", "initial", "output")

# Number of verbs from which on an option is described once for all of them.
SHARED_BY = 4

LONG_SIGNATURE = re.compile(r"^ *(?:def|class) .{90,}$", re.MULTILINE)


def table(headings: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    """A table in Markdown."""
    escaped = [[cell.replace("|", "\\|") for cell in row] for row in rows]
    lines = [headings, ("---",) * len(headings), *escaped]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def command_line(_: str) -> str:
    """Options that verbs share, then each verb with its arguments and other options."""
    # Their order is that in which this process imported them.
    verbs: dict[str, Any] = dict(sorted(get_command(app).commands.items()))  # type: ignore[attr-defined]
    rows = {
        name: [option_row(each) for each in verb.params if each.name != "help"]
        for name, verb in verbs.items()
    }
    count = Counter(row for each in rows.values() for row in each)
    shared = [row for row in count if count[row] >= SHARED_BY]
    parts = ["## Options of several verbs", table(("option", "meaning"), shared)]
    for name, verb in verbs.items():
        own = [row for row in rows[name] if row not in shared]
        also = ", ".join(row[0] for row in rows[name] if row in shared)
        parts += [f"## `mjfim {name}`", verb.help.partition("\n\n")[0]]
        parts += [table(("argument or option", "meaning"), own)] if own else []
        parts += [f"Also: {also}."] if also else []
    return "\n\n".join(parts) + "\n"


def option_row(parameter: Any) -> tuple[str, str]:
    """Name and meaning of an argument or option."""
    is_option = parameter.param_type_name == "option"
    names = sorted(parameter.opts, key=len) if is_option else []
    metavar = [parameter.metavar] if parameter.metavar else []
    return f"`{' '.join([', '.join(names), *metavar]).strip()}`", str(parameter.help)


def terms(_: str) -> str:
    """Sections of the terms of the library."""
    return "\n".join(
        "\n".join(
            [
                f"### `{kind}`\n\n{term.description}\n\n    {term.equation}\n",
                f"Names: {f'`{term.acts_on}`' if term.acts_on else 'none, it acts on the base'}. "
                f"MuJoCo: {term.elements}.\n",
                table(
                    ("field", "meaning", "unit at a hinge"),
                    [
                        (f"`{field}`", meaning, unit or "none")
                        for field, meaning, unit in term.fields
                    ],
                ),
                *(f"* {source}" for source in term.sources),
                "",
            ]
        )
        for kind, term in KINDS.items()
    )


def paths(_: str) -> str:
    """Fields of each kind of parameter path."""
    rows = [(f"`{kind}`", ", ".join(f"`{each}`" for each in fields_of(kind))) for kind in PATHS]
    return table(("kind", "fields"), rows)


def keys(name: str) -> str:
    """Keys of the JSON file of a record, with the meaning of its attributes."""
    record: Any = locate(f"mjfim.{name}")
    meanings: dict[str, str] = {}
    for base in (Verdict, *reversed(record.__mro__)):
        section = (inspect.getdoc(base) or "").partition("Attributes:\n")[2].partition("\n\n")[0]
        meanings |= ATTRIBUTE.findall(section)
    rows = []
    for path in record.in_json or [each.name for each in fields(record)]:
        name = path.rpartition(".")[2]
        meaning = meanings.get(name) or inspect.getdoc(getattr(record, name)) or ""
        key = record.json_names.get(path, name)
        rows.append((f"`{key}`", " ".join(meaning.partition("\n\n")[0].split())))
    return table(("key", "meaning"), rows)


def python(names: str) -> str:
    """Signatures and descriptions of functions and classes."""
    stubs = []
    for name in names.split(","):
        source = inspect.getsource(locate(f"mjfim.{name.strip()}"))  # type: ignore[arg-type]
        text = ast.unparse(without_body(ast.parse(source).body[0], len))
        stubs.append(LONG_SIGNATURE.sub(lambda line: folded(line[0]), text))
    return "```pyi\n" + "\n\n\n".join(stubs) + "\n```\n"


def without_body(node: Any, length: Callable[[str], int]) -> Any:
    """Leave the description of a function or class, and the first lines of its methods."""
    methods = [
        without_body(each, lambda text: (text + "\n").index("\n"))
        for each in (node.body if isinstance(node, ast.ClassDef) else ())
        if isinstance(each, ast.FunctionDef) and not each.name.startswith("_")
    ]
    text = ast.get_docstring(node) or ""
    described = textwrap.indent(text[: length(text)], "    ").lstrip()
    node.body = [ast.Expr(ast.Constant(described)), *methods]
    if not isinstance(node, ast.FunctionDef):
        node.decorator_list = []
    return node


def folded(line: str) -> str:
    """A signature on several lines."""
    return "\n        ".join(textwrap.wrap(line, 90, break_on_hyphens=False))


def experiment_file(_: str) -> str:
    """Tables of the keys of the file, then those of every table in it."""
    schema = json_schema()
    tables = schema["$defs"]
    parts = [key_table("## Keys of the file", schema)]

    def add(title: str, field: Mapping[str, Any]) -> None:
        """Add the tables that a value may hold, and those inside them."""
        for name in re.findall(r'"#/\$defs/(\w+)"', json.dumps(field)):
            parts.append(key_table(title, tables[name]))
            for key, inner in tables[name]["properties"].items():
                add(f"{title}, key `{key}`", inner)

    for key, field in schema["properties"].items():
        form = {"array": f"[[{key}]]", "object": f"[{key}.<name>]"}
        add(f"## `{form.get(str(field.get('type')), f'[{key}]')}`", field)
    return "\n".join(parts)


def key_table(title: str, described: Mapping[str, Any]) -> str:
    """A heading, the sentence of a table of the file, and one row for each key."""
    required, rows = described.get("required", []), []
    for key, field in described["properties"].items():
        value = field.get("default")
        is_shown = value not in (None, "", [], {}) and not isinstance(value, dict)
        default = f"`{json.dumps(value)}`" if is_shown else ""
        cells = values(field), "required" if key in required else default
        rows.append((f"`{key}`", *cells, field.get("description", "")))
    introduction = f"{described['description']}\n\n" if "$defs" not in described else ""
    return f"{title}\n\n{introduction}{table(('key', 'values', 'default', 'meaning'), rows)}"


def values(field: Mapping[str, Any]) -> str:
    """Values of a key in words."""
    if "$ref" in field:
        return "table"
    if "anyOf" in field:
        branches = [values(part) for part in field["anyOf"] if part.get("type") != "null"]
        return " or ".join(dict.fromkeys(branches))
    stated = field.get("enum", [field["const"]] if "const" in field else [])
    if stated:
        return ", ".join(f"`{json.dumps(value)}`" for value in stated)
    if field.get("format") == "quantity":
        return "text with unit"
    if "prefixItems" in field:
        return f"[{', '.join(values(item) for item in field['prefixItems'])}]"
    if field["type"] == "array":
        return f"list of {values(field['items'])}"
    if field["type"] == "object":
        return f"table of {values(field['additionalProperties'])} by name"
    for sign, bound in (">", "exclusiveMinimum"), ("≥", "minimum"):
        if bound in field:
            return f"{field['type']} {sign} {field[bound]:g}"
    return str(field["type"])


PARTS: dict[str, Callable[[str], str]] = {
    "command line": command_line,
    "experiment file": experiment_file,
    "keys": keys,
    "paths": paths,
    "python": python,
    "terms": terms,
}


def written(page: str) -> str:
    """Return the text of a page with its generated parts as they are today."""
    return PART.sub(lambda part: f"{part[1]}\n{PARTS[part[2]](part[3].strip())}\n", page)


def schema_text() -> str:
    """Return the JSON schema of the experiment file."""
    return json.dumps(json_schema(), indent=2, ensure_ascii=False) + "\n"


def main() -> None:
    """Write the pages and the JSON schema."""
    for path in FOLDER.glob("*.md"):
        path.write_text(written(path.read_text(encoding="utf-8")), encoding="utf-8")
    SCHEMA.write_text(schema_text(), encoding="utf-8")


if __name__ == "__main__":
    main()
