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

from mjfim.atomic_io import replacing
from mjfim.model.coordinates import output_label
from mjfim.output.rerun.camera import Camera
from mjfim.output.rerun.panels import (
    LayoutPart,
    grid_parts,
    series_view,
    series_views,
    stack_parts,
)
from mjfim.output.rerun.scene import EntityParts, entity_path, has_floor
from mjfim.records.labels import Labels
from mjfim.records.recording import Recording

# Colour of the background of the 3D views (0..255).
BACKGROUND_COLOUR = (214, 219, 226)

# Width over height of the region of the robots, with text below it and without.
ASPECT_WITH_TEXT, ASPECT_WITHOUT_TEXT = 1.35, 0.75

# Heights of robots and text, and widths of the left and the right side, relative to each other.
ROBOTS_TO_TEXT = [3, 2]
LEFT_TO_RIGHT = [2, 3]

# Largest number of positions and of controls of a model whose signals are all visible; those of
# others are in tabs.
MAX_VISIBLE_SIGNALS = 3

# Columns, and largest number of views, of a grid of outputs or residuals.
OUTPUT_COLUMNS, OUTPUTS_PER_PAGE = 2, 6


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
    views: Sequence[rrb.View], camera: Camera, panels: Sequence[LayoutPart], *, text: bool = True
) -> rrb.Horizontal:
    """Arrange robots and text on the left, and signals on the right.

    Args:
        views: Views of the robots.
        camera: Camera of these views.
        panels: Signals.
        text: False for a recording without text.
    """
    robots = rrb.Vertical(*views) if camera.stacked else rrb.Horizontal(*views)
    left: rrb.Container = robots
    if text:
        document = rrb.TextDocumentView(origin=entity_path(("summary",)), name="summary")
        left = rrb.Vertical(robots, document, row_shares=ROBOTS_TO_TEXT)

    if not panels:
        return rrb.Horizontal(left)
    return rrb.Horizontal(left, stack_parts(panels), column_shares=LEFT_TO_RIGHT)


def robot_views(
    model: mujoco.MjModel, camera: Camera, roots: Mapping[str, EntityParts]
) -> list[rrb.View]:
    """Return 3D views of robots, all seen from the same camera.

    Args:
        model: The model.
        camera: The camera.
        roots: Entity of each view, by its title.
    """
    grid_helps = not has_floor(model) and not camera.edge_on
    ground = rrb.LineGrid3D(visible=grid_helps)
    views: list[rrb.View] = []
    for title, root in roots.items():
        view = rrb.Spatial3DView(
            origin=entity_path(root),
            name=title,
            eye_controls=camera.controls(),
            line_grid=ground,
            background=BACKGROUND_COLOUR,
        )
        views.append(view)
    return views


def state_parts(labels: Labels) -> list[LayoutPart]:
    """Return panels of positions, velocities and controls; those of large models are in tabs.

    Args:
        labels: Labels of the model's columns.
    """
    positions = series_views(("positions",), labels.positions, legend=True)
    velocities = series_views(("velocities",), labels.velocities)
    controls = series_views(("controls",), labels.controls)
    parts = [
        *grid_parts("positions", positions),
        *grid_parts("velocities", velocities),
        *grid_parts("controls", controls),
    ]

    signals = max(len(labels.positions), len(labels.controls))
    if not parts or signals <= MAX_VISIBLE_SIGNALS:
        return parts
    tabs = rrb.Tabs(*(part.content for part in parts), active_tab=0)
    return [LayoutPart(content=tabs, rows=parts[0].rows)]


def recording_page(model: mujoco.MjModel, index: int, recording: Recording) -> rrb.Vertical:
    """Return outputs above residuals of one recording.

    Args:
        model: The model.
        index: Number of the recording.
        recording: The recording.
    """
    name = f"recording {index + 1}"
    titles = [output_label(model, output) for output in recording.outputs]
    outputs = series_views(("outputs", name), titles, legend=True)
    residuals: list[rrb.View] = []
    for title in titles:
        parts = ("residuals", name, title)
        residuals.append(series_view(parts, f"residual of {title}", legend=False))

    grids = [
        *grid_parts("outputs", outputs, columns=OUTPUT_COLUMNS, per_page=OUTPUTS_PER_PAGE),
        *grid_parts("residuals", residuals, columns=OUTPUT_COLUMNS, per_page=OUTPUTS_PER_PAGE),
    ]
    return stack_parts(grids, name=f"{name}: {Path(recording.name).name}")
