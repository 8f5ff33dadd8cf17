"""Robots that move in Rerun: the shapes of their geoms, their colours, and their poses.

All bodies are directly under one entity with their world poses; geoms are their static children.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import mujoco
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from mjfim.arrays import Array, record
from mjfim.output.page import MEASURED
from mjfim.output.panels import ROBOT_ROLES, ROLES

GeomType = mujoco.mjtGeom

# Colours (0..255) of axes, limits and the edges of bands, and of words, before a dark background.
AXIS_COLOUR, WORD_COLOUR = (150, 150, 150), (205, 205, 205)

# Share of white in the colours of curves that have no role.
LIGHTER = 0.25

# Surfaces are drawn filled, those of an outlined robot as wire frames.
SOLID, OUTLINE = rr.components.FillMode.Solid, rr.components.FillMode.MajorWireframe

# Roles of robots that are drawn as pale outlines.
OUTLINED = (MEASURED, *ROBOT_ROLES)

# Opacity of the meshes of an outlined robot, which have no wire frame.
OUTLINE_OPACITY = 0.3

# Opacity of a robot beside which another one is drawn in the same view, and of a floor below which
# a robot goes.
PALE_OPACITY = 0.4

# Share of white in the colour of an outlined robot, and of the accent colour in that of others.
OUTLINE_WHITE, TINT = 0.4, 0.35

# Colour (0..1) of a geom that sets none; MuJoCo then takes the colour of its material.
DEFAULT_RGBA = (0.5, 0.5, 0.5, 1.0)

# Weights of red, green and blue in the brightness of a colour.
BRIGHTNESS_WEIGHTS = (0.30, 0.59, 0.11)

# Largest group of geoms that MuJoCo's viewer shows by default.
LAST_SHOWN_GROUP = 2

# Radius of the sticks of a stick figure, as a share of the model's extent.
STICK_RADIUS = 0.02

# Side of the squares of a ground plane, and smallest distance from its middle to its edges, both as
# multiples of the extent of the model.
SQUARE_SIZE, INFINITE_REACH = 0.25, 20.0

# Largest number of squares along each side of a ground plane.
MAX_SQUARES = 64

# Brightness of every second square of a ground plane.
DARK_SQUARE = 0.8


def rgb(role: str) -> tuple[int, int, int]:
    """Return the colour of a role (0..255), which can be seen before a dark background."""
    if role in ("text", "white"):
        return WORD_COLOUR
    if role in ("muted", "band"):
        return AXIS_COLOUR
    red, green, blue = bytes.fromhex(ROLES[role].removeprefix("#"))
    if role.startswith("series"):
        red, green, blue = (round(c + LIGHTER * (255 - c)) for c in (red, green, blue))
    return red, green, blue


def geom_colour(role: str, rgba: Iterable[float], moving: bool) -> list[int]:
    """Return the colour (0..255, with opacity) in which a geom of a robot is drawn.

    Args:
        role: Role of the robot; moving geoms of an outlined one are pale.
        rgba: Colour of the geom in the model (0..1).
        moving: False for a geom that no joint moves; it is grey.
    """
    model_rgba = np.fromiter(rgba, dtype=np.float64)
    alpha = 255.0 * model_rgba[3]
    accent = np.array(rgb(role), dtype=np.float64)

    if not moving:
        colour = np.full(3, 255.0 * float(model_rgba[:3] @ BRIGHTNESS_WEIGHTS))
    elif role in OUTLINED:
        colour = (1.0 - OUTLINE_WHITE) * accent + OUTLINE_WHITE * 255.0
        alpha *= OUTLINE_OPACITY
    else:
        colour = TINT * accent + (1.0 - TINT) * 255.0 * model_rgba[:3]
    return [round(channel) for channel in (*colour, alpha)]


@record
class DrawnShape:
    """A shape that is drawn in the frame of a body.

    Attributes:
        name: Name of its entity.
        position: (3,) origin of the shape in the frame of the body [m].
        quaternion: (4,) its orientation, wxyz.
        archetype: The shape in its own frame.
        rgba: Its colour (0..255, with opacity).
    """

    name: str
    position: Array
    quaternion: Array
    archetype: rr.AsComponents
    rgba: list[int]


def translucent(shape: DrawnShape) -> rrb.Visualizer:
    """Return the translucent look of a shape, which replaces its own one in some views.

    Args:
        shape: The shape.
    """
    rgba = [*shape.rgba[:3], round(PALE_OPACITY * shape.rgba[3])]
    if isinstance(shape.archetype, rr.Mesh3D):
        return rr.Mesh3D.from_fields(albedo_factor=rgba).visualizer()
    kind: Any = type(shape.archetype)
    found: rrb.Visualizer = kind.from_fields(colors=[rgba]).visualizer()
    return found


# ---- geoms of a body


def geom_rgba(model: mujoco.MjModel, geom: int) -> tuple[float, ...]:
    """Return the colour (0..1) of a geom, as MuJoCo's renderer chooses it.

    The colour of the material counts unless the geom sets one.

    Args:
        model: The model.
        geom: Number of the geom.
    """
    rgba = tuple(model.geom_rgba[geom].tolist())
    material = int(model.geom_matid[geom])
    if material >= 0 and np.allclose(rgba, DEFAULT_RGBA):
        return tuple(model.mat_rgba[material].tolist())
    return rgba


def drawn_shapes(model: mujoco.MjModel, body: int, role: str) -> Iterator[DrawnShape]:
    """Find the shapes that show a body; a moving body without geoms is a stick figure.

    Its geoms are those that MuJoCo's viewer shows, or all where these are none.

    Args:
        model: The model.
        body: Number of the body.
        role: Role of the robot, which has its colour.

    Yields:
        The shapes.
    """
    moving = bool(model.body_weldid[body])
    fill = OUTLINE if role in OUTLINED and moving else SOLID
    first = int(model.body_geomadr[body])
    every = range(first, first + int(model.body_geomnum[body]))
    visible = [geom for geom in every if geom_rgba(model, geom)[3] > 0.0]
    geoms = [geom for geom in visible if model.geom_group[geom] <= LAST_SHOWN_GROUP] or visible
    for geom in geoms:
        rgba = geom_colour(role, geom_rgba(model, geom), moving)
        archetype = geom_shape(model, geom, rgba, fill)
        if archetype is None:
            continue
        yield DrawnShape(
            name=shape_name(model, geom),
            position=geom_origin(model, geom),
            quaternion=model.geom_quat[geom],
            archetype=archetype,
            rgba=rgba,
        )

    if moving and not geoms:
        yield from stick_figure(model, body, geom_colour(role, DEFAULT_RGBA, moving), fill)


def shape_name(model: mujoco.MjModel, geom: int) -> str:
    """Return the name of the entity of a geom; unnamed geoms are numbered."""
    return str(model.geom(geom).name) or f"geom{geom}"


def geom_origin(model: mujoco.MjModel, geom: int) -> Array:
    """Return the origin of the shape of a geom in the frame of its body, (3,) [m].

    A capsule of Rerun begins at the origin of its frame; that of MuJoCo is centred on it.

    Args:
        model: The model.
        geom: Number of the geom.
    """
    position = np.array(model.geom_pos[geom])
    if int(model.geom_type[geom]) != int(GeomType.mjGEOM_CAPSULE):
        return position

    to_end = np.empty(3)
    half_length = float(model.geom_size[geom, 1])
    mujoco.mju_rotVecQuat(to_end, np.array([0.0, 0.0, -half_length]), model.geom_quat[geom])
    return position + to_end


def geom_shape(
    model: mujoco.MjModel, geom: int, rgba: list[int], fill: rr.components.FillMode
) -> rr.AsComponents | None:
    """Return the archetype of a geom in its own frame, whose origin is `geom_origin`.

    Args:
        model: The model.
        geom: Number of the geom.
        rgba: Colour (0..255).
        fill: How its surface is drawn; meshes are always filled.

    Returns:
        The archetype; None for types without a surface.
    """
    kind = GeomType(int(model.geom_type[geom]))
    # Half sizes [m]; a radius and a half length for round types.
    a, b, c = model.geom_size[geom].tolist()
    look: Any = {"colors": [rgba if fill is SOLID else [*rgba[:3], 255]], "fill_mode": fill}
    match kind:
        case GeomType.mjGEOM_SPHERE:
            return rr.Ellipsoids3D(half_sizes=[[a, a, a]], **look)
        case GeomType.mjGEOM_ELLIPSOID:
            return rr.Ellipsoids3D(half_sizes=[[a, b, c]], **look)
        case GeomType.mjGEOM_BOX:
            return rr.Boxes3D(half_sizes=[[a, b, c]], **look)
        case GeomType.mjGEOM_CYLINDER:
            return rr.Cylinders3D(lengths=[2 * b], radii=[a], **look)
        case GeomType.mjGEOM_CAPSULE:
            return rr.Capsules3D(lengths=[2 * b], radii=[a], **look)
        case GeomType.mjGEOM_PLANE:
            return _ground_plane(model, a, b, rgba)
        case GeomType.mjGEOM_HFIELD:
            return _height_field(model, int(model.geom_dataid[geom]), rgba)
        case GeomType.mjGEOM_MESH | GeomType.mjGEOM_SDF:
            return _mesh(model, int(model.geom_dataid[geom]), rgba)
    return None


def stick_figure(
    model: mujoco.MjModel, body: int, rgba: list[int], fill: rr.components.FillMode
) -> Iterator[DrawnShape]:
    """Return shapes for a body without geoms: a ball, and sticks to its children.

    Args:
        model: The model.
        body: Number of the body.
        rgba: Colour (0..255).
        fill: How the surfaces are drawn.

    Yields:
        The shapes.
    """
    radius = STICK_RADIUS * model.stat.extent
    upright = np.array([1.0, 0.0, 0.0, 0.0])
    ball = rr.Ellipsoids3D(half_sizes=[[1.5 * radius] * 3], colors=[rgba], fill_mode=fill)
    yield DrawnShape(
        name="ball", position=np.zeros(3), quaternion=upright, archetype=ball, rgba=rgba
    )

    for child in np.flatnonzero(model.body_parentid == body):
        end = np.array(model.body_pos[child])
        length = float(np.linalg.norm(end))
        if not length:
            continue

        # Capsules run along z: each is turned towards its end.
        turned = np.empty(4)
        mujoco.mju_quatZ2Vec(turned, end / length)
        stick = rr.Capsules3D(lengths=[length], radii=[radius], colors=[rgba], fill_mode=fill)
        name = f"stick {child}"
        yield DrawnShape(
            name=name,
            position=np.zeros(3),
            quaternion=turned,
            archetype=stick,
            rgba=rgba,
        )


# ---- single types


def _ground_plane(
    model: mujoco.MjModel, half_x: float, half_y: float, rgba: list[int]
) -> rr.Mesh3D:
    """Return a plane, which is infinite for MuJoCo, as a large board; larger half sizes [m] stay.

    Its squares in two tones show depth.
    """
    extent = model.stat.extent
    reach = INFINITE_REACH * extent
    half_sizes = np.maximum((half_x, half_y), reach)

    # The squares of a huge plane are larger.
    side = max(SQUARE_SIZE * extent, 2.0 * float(half_sizes.max()) / MAX_SQUARES)
    counts = np.maximum(np.rint(2.0 * half_sizes / side), 1.0).astype(np.intp)

    # (squares, 2) column and row of every square.
    squares = np.indices(tuple(counts)).reshape(2, -1).T

    # (squares, 4, 2) corners of every square, counter-clockwise.
    shifts = np.array([(0, 0), (1, 0), (1, 1), (0, 1)])
    corners = squares[:, None, :] + shifts
    xy = (2.0 * corners / counts - 1.0) * half_sizes

    vertices = np.zeros((4 * len(squares), 3))
    vertices[:, :2] = xy.reshape(-1, 2)

    is_bright = squares.sum(axis=1) % 2 == 1
    brightness = np.where(is_bright, 1.0, DARK_SQUARE)
    colours = brightness[:, None] * np.array(rgba[:3])
    return rr.Mesh3D(
        vertex_positions=vertices,
        triangle_indices=_two_triangles(4 * np.arange(len(squares)), (0, 1, 2, 3)),
        vertex_normals=np.broadcast_to((0.0, 0.0, 1.0), vertices.shape),
        vertex_colors=np.repeat(colours, 4, axis=0).astype(np.uint8),
    )


def _two_triangles(first_corners: NDArray[np.intp], shifts: tuple[int, ...]) -> NDArray[np.intp]:
    """Return (2n, 3) triangles of n squares by their first corners (n,) and shifts of all four."""
    corners = first_corners[:, None] + np.array(shifts)
    return np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])


def _height_field(model: mujoco.MjModel, field: int, rgba: list[int]) -> rr.Mesh3D:
    """Return the top surface of a height field; its rows run along y, its columns along x."""
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    first = int(model.hfield_adr[field])
    half_x, half_y, top, _ = model.hfield_size[field]

    heights = model.hfield_data[first : first + rows * columns].reshape(rows, columns)
    z = top * heights
    x = np.linspace(-half_x, half_x, columns)
    y = np.linspace(-half_y, half_y, rows)
    vertices = np.stack([*np.meshgrid(x, y), z], axis=2)

    # A normal of the surface z(x, y) is (-dz/dx, -dz/dy, 1).
    slope_y, slope_x = np.gradient(z, y, x)
    normals = np.stack([-slope_x, -slope_y, np.ones_like(z)], axis=2).reshape(-1, 3)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)

    # The first corner of every rectangle between two rows and two columns.
    row_starts = np.arange(rows - 1)[:, None] * columns
    first_corners = (row_starts + np.arange(columns - 1)).ravel()
    return rr.Mesh3D(
        vertex_positions=vertices.reshape(-1, 3),
        triangle_indices=_two_triangles(first_corners, (0, 1, columns + 1, columns)),
        vertex_normals=normals,
        albedo_factor=rgba,
    )


def _mesh(model: mujoco.MjModel, index: int, rgba: list[int]) -> rr.Mesh3D:
    """Return a compiled mesh, which MuJoCo has centred.

    It has a vertex for every distinct pair of vertex and normal.
    """
    first = int(model.mesh_faceadr[index])
    faces = slice(first, first + int(model.mesh_facenum[index]))
    vertex_indices = model.mesh_face[faces].ravel()
    normal_indices = model.mesh_facenormal[faces].ravel()

    pairs = np.stack([vertex_indices, normal_indices], axis=1)
    distinct, triangles = np.unique(pairs, axis=0, return_inverse=True)
    return rr.Mesh3D(
        vertex_positions=model.mesh_vert[model.mesh_vertadr[index] + distinct[:, 0]],
        triangle_indices=triangles.reshape(-1, 3),
        vertex_normals=model.mesh_normal[model.mesh_normaladr[index] + distinct[:, 1]],
        albedo_factor=rgba,
    )


# Parts of the path of an entity, not escaped.
EntityParts = tuple[str, ...]

# Body of the end of a robot, (1,), and the point in the frame of the body, (1, 3) [m].
EndPoint = tuple[NDArray[np.intp], Array]

# Thickness of the path of a robot's end [points].
PATH_THICKNESS = 1.0


# ---- poses


@record
class BodyPoses:
    """World poses of all bodies along a trajectory.

    Attributes:
        t: (N+1,) times [s].
        positions: (N+1, nbody, 3) origins of the bodies [m].
        quaternions: (N+1, nbody, 4) orientations, wxyz.
    """

    t: Array
    positions: Array
    quaternions: Array

    def world_paths(self, bodies: NDArray[np.intp], points: Array, every: int = 1) -> Array:
        """Return the paths of points that are fixed to bodies.

        Args:
            bodies: (n,) body of each point.
            points: (n, 3) points in the frames of their bodies [m].
            every: Step between the samples that are used.

        Returns:
            (samples, n, 3) world paths [m].
        """
        w = self.quaternions[::every, bodies, :1]
        v = self.quaternions[::every, bodies, 1:]
        shifts = 2.0 * np.cross(v, np.cross(v, points) + w * points)
        return self.positions[::every, bodies] + points + shifts


def body_poses(model: mujoco.MjModel, t: Array, qpos: Array) -> BodyPoses:
    """Compute the forward kinematics of each sample.

    Args:
        model: The model.
        t: (N+1,) times [s].
        qpos: (N+1, nq) positions.
    """
    data = mujoco.MjData(model)
    positions = np.empty((len(qpos), model.nbody, 3))
    quaternions = np.empty((len(qpos), model.nbody, 4))
    for k, q in enumerate(qpos):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        positions[k] = data.xpos
        quaternions[k] = data.xquat
    return BodyPoses(t=np.asarray(t), positions=positions, quaternions=quaternions)


def has_floor(model: mujoco.MjModel) -> bool:
    """Return True for a model with a ground plane, so that a view needs no grid.

    Args:
        model: The model.
    """
    return bool(np.any(model.geom_type == int(GeomType.mjGEOM_PLANE)))


# ---- entities and times


def entity_path(parts: EntityParts) -> str:
    """Return the path of an entity with each part escaped.

    Args:
        parts: Parts of the path.
    """
    return rr.new_entity_path(list(parts))


def time_column(t: Array) -> rr.TimeColumn:
    """Return simulated times on the timeline `sim_time`, rounded to whole nanoseconds.

    Args:
        t: (n,) times [s].
    """
    nanoseconds = np.rint(np.asarray(t) * 1e9).astype("timedelta64[ns]")
    return rr.TimeColumn("sim_time", duration=nanoseconds)


def rerun_quaternion(wxyz: Array) -> rr.Quaternion:
    """Return a quaternion of MuJoCo in the order of Rerun, xyzw.

    Args:
        wxyz: (4,) quaternion in the order of MuJoCo.
    """
    return rr.Quaternion(xyzw=np.roll(wxyz, -1))


def body_parts(model: mujoco.MjModel, root: EntityParts, body: int) -> EntityParts:
    """Return the parts of the path of a body; unnamed bodies are numbered.

    Args:
        model: The model.
        root: Entity of the robot.
        body: Number of the body.
    """
    name = model.body(body).name or f"body{body}"
    return (*root, "bodies", name)


# ---- robots


def log_robot(
    rec: rr.RecordingStream,
    model: mujoco.MjModel,
    root: EntityParts,
    poses: BodyPoses,
    role: str,
    *,
    is_ghost: bool = False,
) -> None:
    """Log the shapes of one robot, and its poses on `sim_time`.

    Args:
        rec: The recording.
        model: The model.
        root: Entity of the robot.
        poses: Poses of its bodies.
        role: Role of the robot, which has its colour.
        is_ghost: Whether it shows moving bodies only, and on this timeline only.
    """
    if is_ghost:
        rec.set_time("sim_time", duration=float(poses.t[0]))
    above = {shape_name(model, geom) for geom in planes_above(model, poses)}
    for body in np.flatnonzero(model.body_weldid).tolist() if is_ghost else range(model.nbody):
        parts = body_parts(model, root, body)
        for shape in drawn_shapes(model, body, role):
            pose = rr.Transform3D(
                translation=shape.position, quaternion=rerun_quaternion(shape.quaternion)
            )
            path = entity_path((*parts, shape.name))
            rec.log(path, pose, shape.archetype, static=not is_ghost, strict=True)
            if shape.name in above:
                pale = rr.Mesh3D.from_fields(albedo_factor=(255, 255, 255, 255 * PALE_OPACITY))
                rec.log(path, pale, static=True, strict=True)

        # Body 0 is the world, which stays at the origin.
        if body == 0:
            continue
        # No pose of a moving body is static, because static data would override the others.
        xyz, wxyz = poses.positions[:, body], poses.quaternions[:, body]
        if model.body_weldid[body]:
            xyzw = np.roll(wxyz, -1, axis=1)
            rows = rr.Transform3D.columns(translation=xyz, quaternion=xyzw)
            rec.send_columns(entity_path(parts), [time_column(poses.t)], rows, strict=True)
        else:
            pose = rr.Transform3D(translation=xyz[0], quaternion=rerun_quaternion(wxyz[0]))
            rec.log(entity_path(parts), pose, static=True, strict=True)
    if is_ghost:
        rec.reset_time()


def pale_shapes(model: mujoco.MjModel, root: EntityParts, role: str) -> dict[str, rrb.Visualizer]:
    """Return translucent shapes of the moving bodies of a robot, for a view with several robots.

    Args:
        model: The model.
        root: Entity of the robot.
        role: Role of the robot, which has its colour.

    Returns:
        The appearance of each shape, by the path of its entity.
    """
    pale = {}
    for body in np.flatnonzero(model.body_weldid).tolist():
        parts = body_parts(model, root, body)
        for shape in drawn_shapes(model, body, role):
            pale[entity_path((*parts, shape.name))] = translucent(shape)
    return pale


def log_end_path(
    rec: rr.RecordingStream,
    root: EntityParts,
    poses: BodyPoses,
    end: EndPoint | None,
    role: str,
    *,
    static: bool = False,
) -> None:
    """Log the path of a robot's end as a line, if it has one.

    Args:
        rec: The recording.
        root: Entity of the robot.
        poses: Poses of its bodies.
        end: The end of the robot.
        role: Role of the robot, which has its colour.
        static: True for all timelines, False for the time that is set.
    """
    if end is not None:
        path = rr.LineStrips3D(
            [poses.world_paths(*end)[:, 0]],
            colors=[[*rgb(role), 255]],
            radii=rr.Radius.ui_points(PATH_THICKNESS),
        )
        rec.log(entity_path((*root, "path")), path, static=static, strict=True)


def log_pose(
    rec: rr.RecordingStream,
    model: mujoco.MjModel,
    root: EntityParts,
    poses: BodyPoses,
    sample: int,
) -> None:
    """Log the pose of a robot at one sample of a motion, at the time that is set."""
    for body in np.flatnonzero(model.body_weldid).tolist():
        pose = rr.Transform3D(
            translation=poses.positions[sample, body],
            quaternion=rerun_quaternion(poses.quaternions[sample, body]),
        )
        rec.log(entity_path(body_parts(model, root, body)), pose, strict=True)


# ---- points of moving bodies


def moving_geoms(model: mujoco.MjModel) -> NDArray[np.intp]:
    """Return the geoms of moving bodies.

    Args:
        model: The model.
    """
    return np.flatnonzero(model.body_weldid[model.geom_bodyid])


def planes_above(model: mujoco.MjModel, poses: BodyPoses) -> list[int]:
    """Return the planes below which the centre of mass of a moving body goes.

    Args:
        model: The model.
        poses: Poses of its bodies.
    """
    moving = np.flatnonzero(model.body_weldid)
    centres = poses.world_paths(moving, model.body_ipos[moving])
    found = []
    for geom in np.flatnonzero(model.geom_type == int(GeomType.mjGEOM_PLANE)).tolist():
        normal = np.empty(3)
        mujoco.mju_rotVecQuat(normal, np.array([0.0, 0.0, 1.0]), model.geom_quat[geom])
        ends = model.geom_pos[geom] + np.stack([np.zeros(3), normal])
        foot, tip = poses.world_paths(model.geom_bodyid[[geom, geom]], ends)[0]
        if np.any((centres - foot) @ (tip - foot) < 0.0):
            found.append(geom)
    return found


def end_point(model: mujoco.MjModel, poses: BodyPoses) -> EndPoint | None:
    """Return the end of a robot, whose path is drawn.

    Of the origins of moving bodies and the centres of their geoms, those deepest in the tree are
    compared. The end is the one that travels farthest.

    Args:
        model: The model.
        poses: Poses of its bodies.

    Returns:
        The end; None where nothing moves.
    """
    moving, geoms = np.flatnonzero(model.body_weldid), moving_geoms(model)
    points = np.concatenate([np.zeros((len(moving), 3)), model.geom_pos[geoms]])
    bodies = np.concatenate([moving, model.geom_bodyid[geoms]])
    if not len(bodies):
        return None

    depth = np.zeros(model.nbody, dtype=np.intp)
    for body in range(1, model.nbody):
        depth[body] = depth[model.body_parentid[body]] + 1
    deepest = depth[bodies] == depth[bodies].max()

    paths = poses.world_paths(bodies[deepest], points[deepest])
    steps = np.linalg.norm(np.diff(paths, axis=0), axis=2)
    farthest = [int(np.argmax(steps.sum(axis=0)))]
    return bodies[deepest][farthest], points[deepest][farthest]
