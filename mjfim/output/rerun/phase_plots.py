"""Phase plots of the sensitivities in Rerun.

A curve shows how position and velocity change per unit of a parameter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from mjfim.arrays import Array
from mjfim.model.coordinates import split_unit
from mjfim.output.rerun.scene import EntityParts, entity_path, time_column
from mjfim.output.rerun.shapes import RobotStyle
from mjfim.records.design import Design
from mjfim.records.labels import Labels

# Largest number of phase plots.
MAX_PHASE_PLOTS = 8

# Plot coordinates of the largest position and the largest velocity; Rerun's y axis points
# downwards.
PLOT_SCALE = (1.5, -1.0)

# Ends of the positive axes, in plot coordinates, and the factor by which they exceed the largest
# values.
AXIS_ENDS = ((1.65, 0.0), (0.0, -1.1))
AXIS_FACTOR = 1.1

# Places of the values at the ends of the axes, and what is visible, in plot coordinates.
LABEL_PLACES = ((2.45, -0.15), (0.0, -1.65))
VISIBLE_X, VISIBLE_Y = (-1.7, 3.3), (-1.75, 1.2)

# Colours of the axes and of the values at their ends (0..255).
AXIS_COLOUR, LABEL_COLOUR = [150, 150, 150], [205, 205, 205]

# Thickness of axes and curves, and radius of the dots that move along the curves [points].
AXIS_THICKNESS, CURVE_THICKNESS, MOVING_DOT = 0.5, 1.0, 3.5


@dataclass(frozen=True, eq=False, kw_only=True)
class PhasePlot:
    """Sensitivity of one degree of freedom to one parameter, for both trajectories in one scale.

    Attributes:
        index: Number of the parameter.
        dof: Number of the degree of freedom.
        nv: Degrees of freedom of the model.
        parameter: Name of the parameter.
        scale: (2,) largest |psi| of position and velocity [x-unit / theta-unit].
    """

    index: int
    dof: int
    nv: int
    parameter: str
    scale: Array

    @classmethod
    def of_most_sensitive(cls, design: Design, index: int, nv: int) -> PhasePlot:
        """Return the plot of the degree of freedom whose position reacts most to a parameter.

        Args:
            design: The design; its final trajectory decides.
            index: Number of the parameter.
            nv: Degrees of freedom of the model.
        """
        psi = np.abs(design.final.sensitivity[:, :, index])
        dof = int(np.argmax(psi[:, :nv].max(axis=0)))

        columns = [dof, nv + dof]
        largest = [
            np.abs(evaluation.sensitivity[:, columns, index]).max(axis=0)
            for evaluation in (design.initial, design.final)
        ]
        scale = np.max(largest, axis=0)
        return cls(
            index=index,
            dof=dof,
            nv=nv,
            parameter=design.parameters[index],
            scale=np.where(scale > 0.0, scale, 1.0),
        )

    @property
    def parts(self) -> EntityParts:
        """Entity under which the plot is logged."""
        return ("phase", self.parameter)

    def log_axes(self, rec: rr.RecordingStream, labels: Labels) -> None:
        """Log axes through zero, with the value per unit of the parameter at each positive end.

        Args:
            rec: The recording.
            labels: Labels of the degrees of freedom.
        """
        ends = np.array(AXIS_ENDS)
        lines = rr.LineStrips2D(
            [[-ends[0], ends[0]], [-ends[1], ends[1]]],
            colors=[AXIS_COLOUR] * 2,
            radii=rr.Radius.ui_points(AXIS_THICKNESS),
        )
        rec.log(entity_path((*self.parts, "axes")), lines, static=True, strict=True)

        texts = [
            f"{AXIS_FACTOR * largest:.3g} {unit}"
            for unit, largest in zip(self._units(labels), self.scale, strict=True)
        ]
        marks = rr.Points2D(
            LABEL_PLACES,
            labels=texts,
            colors=[LABEL_COLOUR] * 2,
            radii=rr.Radius.ui_points(0.0),
            show_labels=True,
        )
        rec.log(entity_path((*self.parts, "ends")), marks, static=True, strict=True)

    def log_curve(
        self,
        rec: rr.RecordingStream,
        t: Array,
        sensitivity: Array,
        *,
        name: str,
        style: RobotStyle,
    ) -> None:
        """Log the curve of one trajectory, and a dot that moves along it with `sim_time`.

        Args:
            rec: The recording.
            t: (N+1,) times [s].
            sensitivity: (N+1, nx, p) sensitivity [x-unit / theta-unit].
            name: Name of the trajectory.
            style: Style with the colour.
        """
        points = self._points(sensitivity)
        curve = rr.LineStrips2D(
            [points], colors=[style.accent], radii=rr.Radius.ui_points(CURVE_THICKNESS)
        )
        rec.log(entity_path((*self.parts, name)), curve, static=True, strict=True)

        path = entity_path((*self.parts, name, "now"))
        dot = rr.Points2D.from_fields(colors=[style.accent], radii=rr.Radius.ui_points(MOVING_DOT))
        rec.log(path, dot, static=True, strict=True)
        rec.send_columns(path, [time_column(t)], rr.Points2D.columns(positions=points), strict=True)

    def view(self, labels: Labels) -> rrb.Spatial2DView:
        """Return the view of the plot, with a title that names parameter and position.

        Args:
            labels: Labels of the degrees of freedom.
        """
        position, _ = split_unit(labels.positions[self.dof])
        return rrb.Spatial2DView(
            origin=entity_path(self.parts),
            name=f"ψ of {self.parameter}: {position}",
            visual_bounds=rrb.VisualBounds2D(x_range=VISIBLE_X, y_range=VISIBLE_Y),
        )

    def _units(self, labels: Labels) -> tuple[str, str]:
        """Units of position and velocity per unit of the parameter."""
        units = labels.parameter_units
        per = units[self.index] if self.index < len(units) else ""
        names = (labels.positions[self.dof], labels.velocities[self.dof])
        position, velocity = (split_unit(name)[1] for name in names)
        divisor = f" / ({per})" if " " in per or "/" in per else f" / {per}"
        return (f"{position}{divisor}", f"{velocity}{divisor}") if per else (position, velocity)

    def _points(self, sensitivity: Array) -> Array:
        """Return the (N+1, 2) curve in plot coordinates of a sensitivity (N+1, nx, p)."""
        columns = [self.dof, self.nv + self.dof]
        relative = sensitivity[:, columns, self.index] / self.scale
        return np.asarray(relative * PLOT_SCALE)


def parameters_with_phase_plot(design: Design) -> list[int]:
    """Return the wanted parameters that change the motion.

    Of many, those with the largest relative standard deviations are returned.

    Args:
        design: The design.

    Returns:
        Numbers of the parameters, in ascending order.
    """
    moving = [j for j in design.wanted if _moves_something(design, j)]

    # A parameter that the design does not determine comes last.
    size = np.where(design.theta == 0.0, 1.0, np.abs(design.theta))
    std = np.where(np.isfinite(design.final.std), design.final.std, 0.0)
    relative_std = std / size
    least_known_first = sorted(moving, key=lambda j: -relative_std[j])
    return sorted(least_known_first[:MAX_PHASE_PLOTS])


def _moves_something(design: Design, j: int) -> bool:
    """Return True for a parameter that changes one of the trajectories."""
    evaluations = (design.initial, design.final)
    return any(evaluation.sensitivity[..., j].any() for evaluation in evaluations)
