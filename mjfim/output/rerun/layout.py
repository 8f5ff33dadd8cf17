"""Layout of a Rerun recording, and the stream that writes the file.

Robots and text are on the left, signals on the right.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import mujoco
import rerun as rr
import rerun.blueprint as rrb

from mjfim.files import replacing
from mjfim.output.rerun.camera import Camera
from mjfim.output.rerun.scene import EntityParts, entity_path, first_shape_parts, has_floor

# Colour of the background of the 3D views (0..255).
BACKGROUND_COLOUR = (214, 219, 226)

# Width over height of the region of the robots, with text below it and without.
ASPECT_WITH_TEXT, ASPECT_WITHOUT_TEXT = 1.5, 0.75

# Heights of robots and text, and widths of the left and the right side, relative to each other.
ROBOTS_TO_TEXT = [5, 4]
LEFT_TO_RIGHT = [2, 3]


@contextmanager
def open_recording(
    path: Path, model: mujoco.MjModel, kind: str, layout: rrb.Container
) -> Iterator[rr.RecordingStream]:
    """Open a stream into a temporary file, which replaces `path` once it is complete.

    Args:
        path: The file.
        model: The model; the application id holds its name, so that the viewer keeps layouts of
            different models apart.
        kind: Kind of the recording, for the application id.
        layout: The layout.

    Yields:
        The stream.
    """
    time_panel = rrb.TimePanel(
        state="collapsed", timeline="sim_time", play_state="playing", loop_mode="all"
    )
    blueprint = rrb.Blueprint(
        layout,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        time_panel,
        auto_layout=False,
        auto_views=False,
    )

    # The names of a compiled model begin with that of the model.
    name = model.names.split(b"\0", 1)[0].decode()
    application = f"mjfim {kind} {name}".strip()
    with replacing(path) as partial, rr.RecordingStream(application) as rec:
        rec.set_log_time_enabled(False)
        rec.save(partial, default_blueprint=blueprint)
        yield rec


def arrange(
    robots: rrb.Container | rrb.View, tabs: Sequence[rrb.Container], *, text: bool = True
) -> rrb.Horizontal:
    """Arrange robots and text on the left, and tabs of signals on the right.

    Args:
        robots: Views of the robots.
        tabs: One group of signals each; the first one is open.
        text: False for a recording without text.
    """
    left = robots
    if text:
        document = rrb.TextDocumentView(origin=entity_path(("summary",)), name="summary")
        left = rrb.Vertical(robots, document, row_shares=ROBOTS_TO_TEXT)

    if not tabs:
        return rrb.Horizontal(left)
    return rrb.Horizontal(left, rrb.Tabs(*tabs, active_tab=0), column_shares=LEFT_TO_RIGHT)


def robot_views(
    model: mujoco.MjModel,
    camera: Camera,
    roots: Mapping[str, EntityParts],
    followed: EntityParts | None = None,
    overrides: Mapping[str, rrb.Visualizer] | None = None,
) -> list[rrb.View]:
    """Return 3D views of robots, all seen from the same camera.

    Args:
        model: The model.
        camera: The camera.
        roots: Entity of each view, by its title.
        followed: Entity of the robot that the camera follows, where it follows one; by default
            that of the view.
        overrides: Appearance of entities in these views, by path.
    """
    grid_helps = not has_floor(model) and not camera.edge_on
    ground = rrb.LineGrid3D(visible=grid_helps)
    views: list[rrb.View] = []
    for title, root in roots.items():
        tracked = None
        if camera.followed is not None:
            tracked = entity_path(first_shape_parts(model, followed or root, camera.followed))
        view = rrb.Spatial3DView(
            origin=entity_path(root),
            name=title,
            eye_controls=camera.controls(tracked),
            line_grid=ground,
            background=BACKGROUND_COLOUR,
            overrides=dict((overrides or {}).items()),
        )
        views.append(view)
    return views


def separate_and_overlaid(
    views: Sequence[rrb.View], camera: Camera, overlay: rrb.View
) -> rrb.Container:
    """Return a tab with several robots beside each other, and one with all of them in one view.

    Args:
        views: A view for each robot.
        camera: Camera of these views.
        overlay: View of all robots.
    """
    arranged = rrb.Vertical if camera.stacked else rrb.Horizontal
    separate = arranged(*views, name="separate")
    return separate if len(views) < 2 else rrb.Tabs(separate, overlay, active_tab=0)
