"""Plots of measured and predicted outputs, and of their differences, in Rerun."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import rerun.blueprint as rrb

from mjfim.arrays import Array, evenly_spread_indices
from mjfim.model.coordinates import output_label
from mjfim.output import vocabulary
from mjfim.output.rerun.panels import PLOTS_PER_PAGE, fit_in_a_row, row_height
from mjfim.output.rerun.series import LIMIT_COLOUR, Curve, SeriesPlot
from mjfim.records.estimate import Estimate
from mjfim.records.trajectory import Recording

# Largest number of outputs on one page, each with its residual beside it.
PAIRS_PER_PAGE = PLOTS_PER_PAGE // 2

# Largest number of samples of a recording in a file.
MAX_SAMPLES = 20_000

# Width of the curve of the identified model relative to others, so that it is visible below the
# measured dots.
IDENTIFIED_WIDTH = 2.0

# Half width of the band around a prediction [standard deviations of the noise], and the least share
# of the values of a plot that the whole band has to fill: the edges of a narrower one cover the
# curves.
BAND, LEAST_BAND = 2.0, 0.15


@dataclass(frozen=True, kw_only=True, eq=False)
class OutputPlots:
    """Plots of one recording: each output beside its difference from the prediction.

    Attributes:
        name: Name of the tab.
        pairs: Plot of the output and plot of the difference, for each output that was measured.
    """

    name: str
    pairs: Sequence[tuple[SeriesPlot, SeriesPlot]]

    @property
    def plots(self) -> Iterator[SeriesPlot]:
        """All plots."""
        for pair in self.pairs:
            yield from pair

    def tabs(self) -> list[rrb.Container]:
        """Return the tab, none without outputs; further pages are tabs in it."""
        count = len(self.pairs)
        pages = np.array_split(np.arange(count), max(-(-count // PAIRS_PER_PAGE), 1))
        if not count:
            return []
        if len(pages) == 1:
            return [self._grid(range(count), self.name, pages=1)]

        grids = []
        for page in pages:
            name = f"{page[0] + 1} to {page[-1] + 1} of {count}"
            grids.append(self._grid(page.tolist(), name, len(pages)))
        return [rrb.Tabs(*grids, name=self.name, active_tab=0)]

    def _grid(self, page: Sequence[int], name: str, pages: int) -> rrb.Grid:
        """A page of several with two columns: outputs, and residuals."""
        height = row_height(len(page), pages)
        views = []
        for place, k in enumerate(page):
            shown, residual = (plot.with_height(height) for plot in self.pairs[k])
            views += [shown.view(legend=not place), residual.view()]
        return rrb.Grid(*views, grid_columns=2, name=name)


def output_plots(model: mujoco.MjModel, estimate: Estimate) -> list[OutputPlots]:
    """Return the plots of every fitted recording.

    Args:
        model: The model.
        estimate: The estimate.
    """
    found = []
    for k, (recording, predicted) in enumerate(
        zip(estimate.recordings, estimate.predicted, strict=True), start=1
    ):
        name = f"{k}: {Path(recording.name).name}"
        pairs = _pairs(
            model, f"recording {k}", recording, {"identified": predicted}, estimate.sigma
        )
        found.append(OutputPlots(name=name, pairs=pairs))
    return found


def held_out_plots(model: mujoco.MjModel, estimate: Estimate) -> list[OutputPlots]:
    """Return the plots of every held-out recording, with the nominal model as well.

    Args:
        model: The model.
        estimate: The estimate.
    """
    found = []
    recorded = [(p, p.recording) for p in estimate.predictions if p.recording is not None]
    for k, (prediction, recording) in enumerate(recorded, start=1):
        predicted = {
            "identified": prediction.identified_outputs,
            "nominal": prediction.nominal_outputs,
        }
        pairs = _pairs(model, f"held out {k}", recording, predicted, estimate.sigma)
        name = f"held out: {Path(recording.name).name}"
        found.append(OutputPlots(name=name, pairs=pairs))
    return found


def recording_tabs(
    fitted: Sequence[OutputPlots], held_out: Sequence[OutputPlots], others: Sequence[str]
) -> list[rrb.Container]:
    """Return the tabs of all recordings; those of many recordings are tabs in two common ones.

    Args:
        fitted: The fitted recordings.
        held_out: The held-out recordings.
        others: Names of the tabs beside them.
    """
    flat = [tab for recording in (*fitted, *held_out) for tab in recording.tabs()]
    names = [recording.name for recording in (*fitted, *held_out)]
    if fit_in_a_row([*names, *others]):
        return flat

    grouped: list[rrb.Container] = []
    for name, recordings in (("recordings", fitted), ("held out", held_out)):
        tabs = [tab for recording in recordings for tab in recording.tabs()]
        if tabs:
            grouped.append(rrb.Tabs(*tabs, name=name, active_tab=0))
    return grouped


def _pairs(
    model: mujoco.MjModel,
    name: str,
    recording: Recording,
    predicted: Mapping[str, Array],
    sigma: Mapping[str, float],
) -> list[tuple[SeriesPlot, SeriesPlot]]:
    """Plots of each measured output and of its difference from the identified model.

    Args:
        model: The model.
        name: Entity of the recording.
        recording: The recording.
        predicted: (M, ny) outputs of each model.
        sigma: Noise of each output [unit of the output].
    """
    rows = evenly_spread_indices(len(recording.t), MAX_SAMPLES)
    t = recording.t[rows]
    pairs = []
    for column, output in enumerate(recording.outputs):
        measured = recording.y[rows, column]
        if not np.isfinite(measured).any():
            continue

        label = output_label(model, output)
        models = {word: values[rows, column] for word, values in predicted.items()}
        band = BAND * sigma.get(output, np.nan)
        spread = float(np.nanmax(measured) - np.nanmin(measured))
        shown_band = band if 2.0 * band >= LEAST_BAND * spread else np.nan
        shown = SeriesPlot(
            parts=("outputs", name, label),
            title=label,
            curves=[_measured("measured", t, measured), *_predicted(t, models, shown_band)],
        )
        difference = SeriesPlot(
            parts=("residuals", name, label),
            title=f"residual of {label}",
            curves=[
                _measured("difference", t, measured - models["identified"]),
                _edges(t, np.zeros(len(t)), band, LIMIT_COLOUR),
            ],
        )
        pairs.append((shown, difference))
    return pairs


def _measured(name: str, t: Array, values: Array) -> Curve:
    """Measured samples, or differences from them, as dots."""
    return Curve(name=name, t=t, values=values, colour=vocabulary.MEASURED.rgb, look="dots")


def _predicted(t: Array, models: Mapping[str, Array], band: float) -> Iterator[Curve]:
    """Outputs of the models as lines, with the noise around those of the identified one."""
    terms = {term.word: term for term in vocabulary.TERMS}
    for word, values in models.items():
        width = IDENTIFIED_WIDTH if word == vocabulary.IDENTIFIED.word else 1.0
        yield Curve(name=word, t=t, values=values, colour=terms[word].rgb, width=width)
    yield _edges(t, models["identified"], band, LIMIT_COLOUR)


def _edges(t: Array, middle: Array, band: float, colour: tuple[int, int, int]) -> Curve:
    """The edges of a band of a half width around values; nothing where the width is unknown."""
    edges = np.column_stack([middle - band, middle + band])
    words = (f"±{BAND:.0f} σ of the noise",) * 2
    return Curve(name="band", t=t, values=edges, colour=colour, look="edges", legend=words)
