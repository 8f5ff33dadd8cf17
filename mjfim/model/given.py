"""Models as Python gives them: specs, compiled models, texts, and names of robot descriptions.

Two compiled models are the same where everything agrees that determines the motion.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjfim.errors import ExperimentError, ModelError, in_words, shortened
from mjfim.model.inertia import BodyInertia, body_inertia
from mjfim.model.loading import compile_spec, packed_model, refused, resolve_packages
from mjfim.model.model_files import PackedFiles
from mjfim.model.paths import MODEL_ARRAYS

# What a model may be, for messages.
KINDS = (
    "the path of an MJCF or URDF file, the text of one, a mujoco.MjSpec, a mujoco.MjModel, or a "
    "name of the package robot_descriptions, such as 'so_arm100_mj_description'"
)

# Why a model has no text.
NO_SPEC = (
    "model: MuJoCo does not write it as an MJCF; of an MjModel it knows the spec only where it "
    "loaded this one last from an XML; give the MjSpec, or the path of the file"
)

# Names of modules of robot_descriptions.
DESCRIPTION = re.compile(r"\w+_description")

# Digits of the numbers in a written XML. MuJoCo's default of 6 would change the model.
DIGITS = 15

# Kinds of assets that name files, and the folder of the compiler in which they are.
ASSETS = {
    "meshes": "meshdir",
    "hfields": "meshdir",
    "skins": "meshdir",
    "textures": "texturedir",
}

# Relative difference of a model whose meshes are written with the single precision of MjModel.
SINGLE_PRECISION = 1e-5


def packed(given: Any, directory: Path) -> tuple[str, PackedFiles | None]:
    """Name and files of a model, as an experiment holds them; what is given is never changed.

    Args:
        given: What `KINDS` says.
        directory: Folder to which paths are relative, and in which the assets of a text are.

    Returns:
        The path of the model, and its files; None for a model that is on the disk.

    Raises:
        ExperimentError: It is something else.
        ModelError: It is no model, an asset is absent, or MuJoCo cannot give its spec back.
    """
    if "\0" in str(given):
        raise ExperimentError(f"model: no name of a file: {shortened(repr(given))}")
    if isinstance(given, Path):
        return str(given), None
    if isinstance(given, str) and not given.lstrip().startswith("<"):
        is_name = DESCRIPTION.fullmatch(given) and not os.path.exists(directory / given)
        return _described(given) if is_name else given, None
    compiled = None
    if isinstance(given, str):
        with refused("model: MuJoCo cannot read the text"):
            spec = mujoco.MjSpec.from_string(given)
    elif isinstance(given, mujoco.MjSpec):
        spec = given.copy()
    elif isinstance(given, mujoco.MjModel):
        spec, compiled = _spec_of(given), given
    else:
        raise ExperimentError(f"model: needs {KINDS}; not {in_words(given)}")

    name = re.sub(r"[^\w-]+", "_", spec.modelname) + ".xml"
    path, origin = directory / name, Path(spec.modelfiledir or directory)
    resolve_packages(spec, origin / name)
    wanted = compile_spec(spec.copy(), path) if compiled is None else compiled
    # An attached model has forgotten its folder, where another file may have the same name.
    for fills in (False, True):
        complete = spec.copy()
        assets, is_filled = _assets(complete, origin, wanted, fills=fills)
        complete.assets = assets
        with refused(f"model: MuJoCo cannot write {spec.modelname!r}"), exact_numbers():
            assets[name] = complete.to_xml().encode()
        files = PackedFiles.of({directory / file: content for file, content in assets.items()})
        if _agrees(packed_model(files, path).model, wanted, filled=is_filled):
            return name, files
    raise ModelError(NO_SPEC)


def _described(name: str) -> str:
    """Path of the model file of a module of robot_descriptions, which may download it first."""
    try:
        module = importlib.import_module(f"robot_descriptions.{name}")
    except ModuleNotFoundError as error:
        raise ModelError(
            f"model: {name!r} is neither a file nor a name of the package robot_descriptions, "
            f"which comes with pip install 'mjfim[robots]' ({error})"
        ) from None
    return str(getattr(module, "MJCF_PATH", None) or module.URDF_PATH)


def _spec_of(model: Any) -> Any:
    """Spec of a compiled model, which MuJoCo keeps for the model that it loaded last."""
    with tempfile.TemporaryDirectory(prefix="mjfim-") as folder, exact_numbers(), refused(NO_SPEC):
        file = Path(folder) / "model.xml"
        mujoco.mj_saveLastXML(str(file), model)
        return mujoco.MjSpec.from_file(str(file))


@contextmanager
def exact_numbers() -> Iterator[None]:
    """Let MuJoCo write all digits of numbers, which its library can set and its Python cannot."""
    folder = Path(mujoco.__file__).parent
    files = [f for f in folder.glob("*mujoco*") if {".so", ".dylib", ".dll"} & set(f.suffixes)]
    library = ctypes.CDLL(str(files[0])) if files else None
    digits = getattr(library, "_mjPRIVATE__get_xml_precision", int)()
    set_digits = getattr(library, "_mjPRIVATE__set_xml_precision", int)
    set_digits(DIGITS)
    try:
        yield
    finally:
        set_digits(digits)


def _assets(
    spec: Any, origin: Path, compiled: Any, *, fills: bool
) -> tuple[dict[str, bytes], bool]:
    """Bytes of all files that a spec names by their absolute paths; it names them so then.

    Args:
        spec: The spec (`mujoco.MjSpec`), which is changed.
        origin: Folder of its file.
        compiled: Its compiled model.
        fills: Whether the vertices of the compiled model replace all files of meshes, not only
            those that are absent.

    Returns:
        The files, and whether vertices replace some of them.
    """
    found, is_filled = dict[str, bytes](), False
    held = {Path(name): bytes(content) for name, content in spec.assets.items()}
    for kind, folder in ASSETS.items():
        for element in (each for each in getattr(spec, kind) if each.file):
            stated = Path(getattr(element.compiler, folder) or getattr(spec, folder))
            name = stated / (Path(element.file).name if spec.strippath else element.file)
            place = Path(os.path.abspath(origin / name))
            content = held.get(name, held.get(Path(element.file)))
            if content is None and place.is_file():
                content = place.read_bytes()
            if content is not None and not (fills and kind == "meshes"):
                element.file = place.as_posix()
                found[element.file] = content
            elif kind == "meshes":
                is_filled = True
                _fill(element, compiled)
            else:
                raise ModelError(f"model: {place}: no such file; add its bytes to spec.assets")
    spec.meshdir = spec.texturedir = ""
    return found, is_filled


def _fill(mesh: Any, compiled: Any) -> None:
    """State vertices and faces of a mesh in its spec in place of a file."""
    number = compiled.mesh(mesh.name).id
    first, count = compiled.mesh_vertadr[number], compiled.mesh_vertnum[number]
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, compiled.mesh_quat[number])
    vertices = compiled.mesh_vert[first : first + count].astype(float) @ rotation.reshape(3, 3).T
    first, count = compiled.mesh_faceadr[number], compiled.mesh_facenum[number]
    mesh.uservert = (vertices + compiled.mesh_pos[number]).ravel()
    mesh.userface = compiled.mesh_face[first : first + count].ravel()
    mesh.file, mesh.content_type = "", ""
    mesh.scale, mesh.refpos, mesh.refquat = np.ones(3), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])


def _agrees(found: Any, wanted: Any, *, filled: bool) -> bool:
    """Whether two models have equal names and dynamics; filled: their meshes have other axes."""
    if found.names != wanted.names:
        return False
    if not filled:
        return np.array_equal(found.mesh_vert, wanted.mesh_vert) and same_dynamics(found, wanted)
    different = differences(found, wanted, SINGLE_PRECISION)
    return all(name in ("geom_pos", "geom_quat", "geom_size") for name in different)


# ---- comparison of compiled models

# Relative difference of numbers that is rounding.
ROUNDING = 1e-12

# Prefixes of the arrays that determine the motion, and of those among them that only speed it up,
# follow from others, or are compared as matrices.
COMPARED = (
    *("body_", "jnt_", "dof_", "qpos", "actuator_", "tendon_", "pair_friction", "pair_solref"),
    *("site_pos", "site_quat", "geom_pos", "geom_quat", "geom_size", "geom_friction"),
    "geom_solref",
)
NOT_COMPARED = (
    *("body_bvh", "body_simple", "body_sameframe", "body_margin", "body_inertia", "body_iquat"),
    *("body_invweight0", "dof_simplenum"),
)

# Relative difference below which numbers count as equal: of the number itself, and of the largest
# one of its array.
TOLERANCE = 1e-9

# Arrays of MjModel that hold mass, place, axes and moments of the inertia of bodies.
INERTIAL = ("body_ipos", "body_mass", "body_iquat", "body_inertia")


def same_dynamics(a: Any, b: Any) -> bool:
    """Whether everything that determines the motion agrees in two MjModels."""
    return not differences(a, b, TOLERANCE)


def differences(a: Any, b: Any, tolerance: float) -> list[str]:
    """The arrays that determine the motion and differ between two models."""
    names = [n for n in dir(a) if n.startswith(COMPARED) and not n.startswith(NOT_COMPARED)]
    pairs = {name: (getattr(a, name), getattr(b, name)) for name in names}
    pairs |= {n: (getattr(a.opt, n), getattr(b.opt, n)) for n in MODEL_ARRAYS["option"]}
    found = [name for name, (x, y) in pairs.items() if not _is_equal(x, y, tolerance)]
    return found if same_inertias(a, b, tolerance) else [*found, "body_inertia"]


def same_inertias(a: Any, b: Any, tolerance: float) -> bool:
    """Whether all bodies of two models have the same inertias, with axes named in any order."""
    return a.nbody == b.nbody and not any(
        differ_in_inertia(a, b, i, tolerance) for i in range(a.nbody)
    )


def _is_equal(x: Any, y: Any, tolerance: float) -> bool:
    """Whether two arrays have the same shape and nearly the same numbers, in any unit."""
    x, y = np.asarray(x), np.asarray(y)
    if np.array_equal(x, y):
        return True
    if x.shape != y.shape:
        return False
    largest = float(np.abs(y[np.isfinite(y)]).max(initial=0.0))
    rounding = largest * max(ROUNDING, tolerance * tolerance)
    return bool(np.isclose(x, y, rtol=tolerance, atol=rounding).all())


def differ_in_inertia(a: Any, b: Any, body: int, tolerance: float) -> bool:
    """Whether a body has different inertias in two models, by a share of its mass and size."""
    pairs = [(getattr(a, array)[body], getattr(b, array)[body]) for array in INERTIAL]
    if all(np.array_equal(*pair) for pair in pairs):
        return False
    return not same_inertia(body_inertia(a, body), body_inertia(b, body), tolerance)


def same_inertia(a: BodyInertia, b: BodyInertia, tolerance: float = ROUNDING) -> bool:
    """Whether two inertias differ by at most a share of the mass and the size of the body."""
    if not (a.mass > 0.0 and b.mass > 0.0):
        return a.mass == b.mass
    radius, trace = b.gyration_radius, float(np.trace(b.inertia))
    return (
        abs(a.mass - b.mass) <= tolerance * b.mass
        and bool((np.abs(a.com - b.com) <= tolerance * radius).all())
        and bool((np.abs(a.inertia - b.inertia) <= tolerance * trace).all())
    )
