"""What a design says about itself: warnings, refusals, starts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mjfim
from mjfim.errors import ExperimentError, ModelError, UnidentifiableError
from mjfim.experiment import Experiment
from mjfim.setup import Setup

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def experiment() -> Experiment:
    return Experiment.from_file(ROOT / "models" / "cart_pendulum.toml")


def altered(tmp_path: Path, experiment: Experiment, old: str, new: str, **tables: Any) -> Experiment:
    """The cart-pendulum with a change in its MJCF."""
    text = (ROOT / "models" / "cart_pendulum.xml").read_text()
    assert old in text
    (tmp_path / "cart_pendulum.xml").write_text(text.replace(old, new))
    (tmp_path / "cart_pendulum.csv").write_bytes((ROOT / "models" / "cart_pendulum.csv").read_bytes())
    values = experiment.replace(**tables).model_dump(exclude_unset=True)
    return Experiment(**values, directory=tmp_path)


def test_scale_does_not_change_the_predicted_deviation(experiment: Experiment) -> None:
    relative = {name: {"scale": "guess"} for name in ("m", "l", "c")}
    large = {name: {"scale": 1e4} for name in ("m", "l", "c")}
    stds = []
    for table in (relative, large):
        setup = Setup(experiment.replace(parameters=table))
        stds.append(mjfim.evaluate_trajectory(setup, setup.initial).std)
    np.testing.assert_allclose(stds[0], stds[1], rtol=1e-9)


def test_actuator_delays_are_refused(experiment: Experiment, tmp_path: Path) -> None:
    late = altered(
        tmp_path,
        experiment,
        '<motor name="force" joint="slide"/>',
        '<motor name="force" joint="slide" delay="0.05" nsample="8"/>',
    )
    with pytest.raises(ModelError, match="delays"):
        Setup(late)


def test_saturation_is_said(experiment: Experiment, tmp_path: Path) -> None:
    old, new = 'joint="slide"/>', 'joint="slide" forcelimited="true" forcerange="-1.5 1.5"/>'
    weak = altered(
        tmp_path, experiment, f'<motor name="force" {old}', f'<motor name="force" {new}', descent={"max_iterations": 8}
    )
    design = mjfim.design(weak)
    assert any("forcerange clamps force" in sentence for sentence in design.warnings)
    assert not any("forcerange" in sentence for sentence in mjfim.design(experiment).warnings)


def test_instability_is_said(experiment: Experiment) -> None:
    # D-optimality with this little effort balances the pendulum upright, where every sensitivity explodes
    wild = mjfim.design(experiment.replace(cost={"criterion": "D"}, descent={"max_iterations": 60}))
    assert wild.final.growth > 1e3
    assert any("disturbance" in sentence for sentence in wild.warnings)
    steady = mjfim.design(experiment)
    assert steady.final.growth < 1e2
    assert not any("disturbance" in sentence for sentence in steady.warnings)


def test_limits_that_are_left_are_said_and_no_success(experiment: Experiment) -> None:
    tight = experiment.replace(limits={"control": {"force": [-1.0, 1.0]}})
    design = mjfim.design(tight)
    assert design.limits["control"] < 0
    assert not design.success
    assert any("control limits are exceeded" in sentence for sentence in design.warnings)


def test_own_start_is_checked(experiment: Experiment) -> None:
    with pytest.raises(ExperimentError, match=r"\(400, 1\)"):
        mjfim.design(experiment, start=np.zeros(400))
    with pytest.raises(UnidentifiableError, match="excites nothing"):
        mjfim.design(experiment, start=np.zeros((400, 1)))
    t = np.arange(400) * 0.01
    design = mjfim.design(experiment, start=np.sin(5 * t)[:, None])
    assert design.found_by == "given control"
    assert design.final.cost == pytest.approx(0.01741324, rel=1e-4)


def test_metric_weight_on_psi_needs_the_metric_descent(experiment: Experiment) -> None:
    with pytest.raises(ExperimentError, match="psi_weight"):
        experiment.replace(descent={"psi_weight": 1.0})


def test_monitor_sees_levels_and_growing_numbers(experiment: Experiment) -> None:
    rows: list[mjfim.trajectory.HistoryRow] = []
    design = mjfim.design(experiment, monitor=rows.append)
    assert [row.iteration for row in rows] == list(range(len(rows)))
    assert [row.rate for row in rows] == sorted(row.rate for row in rows)
    assert {row.rate for row in rows} == {25.0, 100.0}
    assert rows[-1].steps <= design.steps


def test_units_come_from_the_path_where_none_is_stated(experiment: Experiment) -> None:
    values = experiment.model_dump(exclude_unset=True)
    for table in values["parameters"].values():
        table.pop("unit")
    setup = Setup(Experiment(**values, directory=ROOT / "models"))
    assert setup.units == ("kg", "m", "N m s/rad")
