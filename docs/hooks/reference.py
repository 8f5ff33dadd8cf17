"""Hooks of mkdocs that write reference pages from the package.

They write the keys of the experiment file, its JSON schema, the command line and the library of
terms. A page asks for generated text by the comment `<!-- generated: experiment file -->`,
`<!-- generated: command line -->` or `<!-- generated: terms -->`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from typer.cli import get_docs_for_click
from typer.main import get_command

from mjfim.cli.main import app
from mjfim.experiment.schema import json_schema
from mjfim.model.terms.library import NUMBERS, TERMS, CatalogueEntry

SCHEMA_FILE = "reference/experiment.schema.json"  # Place of the JSON schema on the site.

Schema = Mapping[str, Any]


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the JSON schema to the files of the site."""
    text = json.dumps(json_schema(), indent=2, ensure_ascii=False) + "\n"
    files.append(File.generated(config, SCHEMA_FILE, content=text))

    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put the generated text in the place of its comment."""
    makers = {
        "<!-- generated: experiment file -->": experiment_reference,
        "<!-- generated: command line -->": command_line_reference,
        "<!-- generated: terms -->": terms_reference,
    }

    for comment, make in makers.items():
        if comment in markdown:
            markdown = markdown.replace(comment, make())

    return markdown


def command_line_reference() -> str:
    """Arguments and options of every verb, as Markdown that typer writes."""
    command = get_command(app)
    context = command.make_context("mjfim", [], resilient_parsing=True)
    text = str(get_docs_for_click(obj=command, ctx=context, name="mjfim"))

    # The page has a title already: drop that of typer.
    return text.partition("\n")[2]


def terms_reference() -> str:
    """Sections of the page of physical terms: the terms of the library, and numbers of the MJCF."""
    numbers = ["## Numbers of the MJCF", "", "These terms need no table, only a parameter.", ""]
    numbers += _table(
        ("term", "equation", "paths", "source"),
        [
            (
                f"{entry.name}: {entry.description}",
                f"`{entry.equation}`",
                ", ".join(f"`{path}`" for path in entry.paths),
                "; ".join(entry.sources),
            )
            for entry in NUMBERS
        ],
    )
    sections = ["## Terms of the library", "", *(line for e in TERMS for line in _term(e))]
    return "\n".join([*sections, *numbers])


def _term(entry: CatalogueEntry) -> Iterator[str]:
    """Section of one term of the library."""
    yield f"### `{entry.name}`"
    yield ""
    yield entry.description
    yield ""
    yield f"    {entry.equation}"
    yield ""
    acts_on = f"`{entry.acts_on}`" if entry.acts_on else "nothing, it acts on the base"
    yield f"Names: {acts_on}. MuJoCo: {entry.elements}."
    yield ""
    yield from _table(
        ("field", "meaning", "unit at a hinge"),
        [(f"`{f.name}`", f.description, f.unit or "none") for f in entry.fields],
    )
    for source in entry.sources:
        yield f"* {source}"
    yield ""


def _table(headings: tuple[str, ...], rows: list[tuple[str, ...]]) -> list[str]:
    """A table in Markdown, and an empty line."""
    escaped = [[cell.replace("|", "\\|") for cell in row] for row in rows]
    lines = [headings, ("---",) * len(headings), *escaped]
    return [*(f"| {' | '.join(line)} |" for line in lines), ""]


def experiment_reference() -> str:
    """Sections of the reference page: the keys of the file, then those of every table."""
    schema = json_schema()
    tables = schema["$defs"]
    sections = [_section("Keys of the file", "", schema, tables)]

    for key, field in schema["properties"].items():
        for name in _referenced(field):
            sections += _table_sections(_heading(key, field), name, tables)

    return "\n".join(sections)


def _table_sections(title: str, name: str, tables: Schema) -> Iterator[str]:
    """Section of one table, then those of the tables inside it."""
    table = tables[name]
    yield _section(title, table.get("description", ""), table, tables)

    for key, field in table["properties"].items():
        for inner in _referenced(field):
            yield from _table_sections(f"{title}, key `{key}`", inner, tables)


def _heading(key: str, field: Schema) -> str:
    """Heading of a table as it stands in TOML."""
    if field.get("type") == "array":
        return f"`[[{key}]]`"
    if field.get("type") == "object":
        return f"`[{key}.<name>]`"

    return f"`[{key}]`"


def _section(title: str, introduction: str, table: Schema, tables: Schema) -> str:
    """A heading, the sentence of the table, and one row for each key."""
    required = table.get("required", [])
    rows = ["| key | values | default | meaning |", "|---|---|---|---|"]

    for key, field in table["properties"].items():
        default = "required" if key in required else _default(field)
        meaning = field.get("description", "").replace("|", "\\|")
        rows.append(f"| `{key}` | {_values(field, tables)} | {default} | {meaning} |")

    return "\n".join([f"## {title}", "", introduction, "", *rows, ""])


def _default(field: Schema) -> str:
    """Default of a key; empty where the text says what happens without the key."""
    value = field.get("default")
    if value in (None, "", [], {}) or isinstance(value, dict):
        return ""

    return f"`{json.dumps(value)}`"


def _referenced(field: Schema) -> list[str]:
    """Names of the tables that a value may hold."""
    reference = field.get("$ref")
    found = [] if reference is None else [reference.rsplit("/", 1)[-1]]

    for part in (*field.get("anyOf", ()), field.get("items"), field.get("additionalProperties")):
        if isinstance(part, Mapping):
            found += _referenced(part)

    return found


def _values(field: Schema, tables: Schema) -> str:
    """Values of a key in words."""
    if "$ref" in field:
        return "table"
    if "anyOf" in field:
        branches = [_values(part, tables) for part in field["anyOf"] if part.get("type") != "null"]
        return " or ".join(dict.fromkeys(branches))
    if "const" in field:
        return f"`{json.dumps(field['const'])}`"
    if "enum" in field:
        return ", ".join(f"`{json.dumps(value)}`" for value in field["enum"])
    if field.get("format") == "quantity":
        return "text with unit"
    if field["type"] == "array":
        return _array(field, tables)
    if field["type"] == "object":
        return f"table of {_values(field['additionalProperties'], tables)} by name"

    return field["type"] + _range(field)


def _array(field: Schema, tables: Schema) -> str:
    """Values of a list in words."""
    if "prefixItems" in field:
        members = [_values(item, tables) for item in field["prefixItems"]]
        return f"[{', '.join(members)}]"

    return f"list of {_values(field['items'], tables)}"


def _range(field: Schema) -> str:
    """Range of a number, in words."""
    if "exclusiveMinimum" in field:
        return f" > {field['exclusiveMinimum']:g}"
    if "minimum" in field:
        return f" ≥ {field['minimum']:g}"

    return ""
