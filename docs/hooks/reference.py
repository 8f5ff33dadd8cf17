"""Hooks of mkdocs that write reference pages from the package.

They write the keys of the experiment file, its JSON schema, the command line and the library of
terms. A page asks for generated text by the comment `<!-- generated: experiment file -->`,
`<!-- generated: command line -->` or `<!-- generated: terms -->`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from typer.cli import get_docs_for_click
from typer.main import get_command

from mjfim.cli.main import app
from mjfim.experiment.schema import json_schema
from mjfim.model.terms import drives, friction
from mjfim.model.terms.library import KINDS, SWEVERS_2007
from mjfim.model.terms.term import Term

SCHEMA_FILE = "reference/experiment.schema.json"  # Place of the JSON schema on the site.

Schema = Mapping[str, Any]

TEDALDI_2014 = (
    "D. Tedaldi, A. Pretto and E. Menegatti, A robust and easy to implement method for IMU "
    "calibration without external equipments, IEEE International Conference on Robotics and "
    "Automation, 2014"
)

LJUNG_1999 = (
    "L. Ljung, System Identification: Theory for the User, 2nd edition, Prentice Hall, 1999"
)

BATCHELOR_1967 = "G. K. Batchelor, An Introduction to Fluid Dynamics, Cambridge University Press"


@dataclass(frozen=True, kw_only=True)
class MjcfNumber:
    """A number of the MJCF that describes a physical term, so that it needs no table.

    Attributes:
        name: Name of the number in words.
        description: One sentence about the physics.
        equation: The force, torque or reading.
        paths: Parameter paths of the number.
        sources: Publications that describe it.
    """

    name: str
    description: str
    equation: str
    paths: tuple[str, ...]
    sources: tuple[str, ...]


NUMBERS = (
    MjcfNumber(
        name="dry friction",
        description="Coulomb friction of a joint or a tendon, which sticks at rest.",
        equation="F = -f sgn(v)",
        paths=("joint/<name>:frictionloss", "tendon/<name>:frictionloss"),
        sources=(friction.OLSSON_1998,),
    ),
    MjcfNumber(
        name="viscous friction",
        description="Friction of a lubricant, and the back-EMF of a motor with short circuit.",
        equation="F = -b0 v",
        paths=("joint/<name>:damping", "tendon/<name>:damping"),
        sources=(friction.ARMSTRONG_1994,),
    ),
    MjcfNumber(
        name="drag",
        description="Quadratic drag in air or oil, and a viscosity that changes with the speed.",
        equation="F = -(b0 v + b1 v |v| + b2 v³)",
        paths=("joint/<name>:damping[1]", "joint/<name>:damping[2]"),
        sources=(BATCHELOR_1967, friction.ARMSTRONG_1994),
    ),
    MjcfNumber(
        name="rotor inertia",
        description="Inertia of a rotor behind a gear, reflected to the joint.",
        equation="F = -J q̈",
        paths=("joint/<name>:armature", "tendon/<name>:armature"),
        sources=(drives.SPONG_1987,),
    ),
    MjcfNumber(
        name="spring",
        description="A spring of a joint, such as that of a cable or a balance.",
        equation="F = -(k0 x + k1 x |x| + k2 x³), x = q - springref",
        paths=("joint/<name>:stiffness", "joint/<name>:springref", "joint/<name>:stiffness[1]"),
        sources=(LJUNG_1999,),
    ),
    MjcfNumber(
        name="torque constant",
        description="Torque of a direct drive per unit of its control.",
        equation="τ = gain · control",
        paths=("actuator/<name>:gainprm[0]",),
        sources=(drives.KRAUSE_2013,),
    ),
    MjcfNumber(
        name="gravity",
        description="Direction and size of gravity; `tilt` turns it and keeps its size.",
        equation="F = m g",
        paths=("option:gravity[i]",),
        sources=(SWEVERS_2007,),
    ),
    MjcfNumber(
        name="air or water",
        description="Forces of a fluid on all bodies, by their inertia boxes.",
        equation="MuJoCo's fluid forces, linear in viscosity, quadratic with density",
        paths=("option:density", "option:viscosity", "option:wind[i]"),
        sources=(BATCHELOR_1967,),
    ),
    MjcfNumber(
        name="misalignment of a sensor",
        description="A sensor whose axes are turned against the site that the MJCF states.",
        equation="y = R(rot) y of the site",
        paths=("site/<name>:rot[i]",),
        sources=(TEDALDI_2014,),
    ),
    MjcfNumber(
        name="scale of a sensor",
        description="A reading that is too large by a constant share s.",
        equation="y = (1 + s) h + b",
        paths=("output/<name>:scale",),
        sources=(TEDALDI_2014,),
    ),
    MjcfNumber(
        name="bias of a sensor",
        description="A reading with a constant offset b.",
        equation="y = (1 + s) h + b",
        paths=("output/<name>:bias",),
        sources=(TEDALDI_2014,),
    ),
    MjcfNumber(
        name="delay",
        description="Readings that are late against the controls.",
        equation="y(t) = h(t - d)",
        paths=("output:delay",),
        sources=(LJUNG_1999,),
    ),
)


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
    sections = [
        "## Terms of the library",
        "",
        *(line for each in KINDS.values() for line in _term(each)),
    ]
    return "\n".join([*sections, *numbers])


def _term(entry: type[Term]) -> Iterator[str]:
    """Section of one term of the library."""
    yield f"### `{entry.kind}`"
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
