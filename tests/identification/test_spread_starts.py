"""Starts that are spread about a guess, where a fit found no minimum from it or cannot begin."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import mjfim
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.identification.starts import SPREAD_STARTS, spread_starts
from mjfim.records.trajectory import Recording
from tests.identification.test_inverse_dynamics import cart, cart_log, true_of
from tests.support.numerics import require_found

# The angle alone tells enough of the motion, but there is no equation of motion without the cart.
ANGLE = ("qpos:hinge", "qvel:hinge")


@pytest.fixture(scope="module")
def experiment(tmp_path_factory: pytest.TempPathFactory) -> Experiment:
    folder = tmp_path_factory.mktemp("cart")
    return cart(folder, fit={"bootstrap": 0}, noise=dict.fromkeys(ANGLE, 0.01))


@pytest.fixture(scope="module")
def log(experiment: Experiment) -> Recording:
    return cart_log(experiment, 0.01, seconds=4.0, measured=ANGLE)


def test_starts_cover_factors_of_ten_within_bounds(experiment: Experiment) -> None:
    system = System.resolve(experiment.replace(parameters={"c": {"bounds": [0.2, 0.9]}}))
    parameters, theta = system.parameters, system.parameters.guess
    rng = np.random.default_rng(1)
    starts = spread_starts(parameters, theta, ("d",), system.impossible, rng)
    assert starts.shape == (SPREAD_STARTS, len(theta))
    assert_array_equal(starts[0], theta)

    # One start in each of the equal parts of the logarithm.
    m, c, d = (parameters.names.index(name) for name in ("m", "c", "d"))
    shares = np.log10(starts[1:, m] / theta[m])
    strata = np.floor((shares + 1.0) / 2.0 * (SPREAD_STARTS - 1)).astype(int)
    assert_array_equal(np.sort(strata), np.arange(SPREAD_STARTS - 1))

    assert starts[:, c].min() == 0.2 and starts[:, c].max() == 0.9
    assert_array_equal(starts[:, d], theta[d])


@pytest.mark.slow
@pytest.mark.parametrize("diverges", [True, False])
def test_a_start_that_diverges_or_explains_no_motion_is_left(
    experiment: Experiment, log: Recording, diverges: bool
) -> None:
    true = true_of(experiment)
    rng = np.random.default_rng([7, 2])
    factors = np.exp(rng.uniform(np.log(10.0), np.log(30.0), 4)) ** rng.choice([-1.0, 1.0], 4)
    wrong = true * ([10.0, 0.1, 10.0, 0.1] if diverges else factors)
    found = mjfim.identify(experiment, [log], start=wrong)
    require_found(found, true, 5.0)
    assert found.inverse_dynamics is None
    starts = f"at the best of {SPREAD_STARTS} starts spread about"
    if diverges:
        said = found.warnings[0]
        assert said.startswith("the model diverges at the start (m = 15, l = 0.08, ")
        assert said.endswith(f"{starts} it instead")
    else:
        assert found.restart.starts == SPREAD_STARTS
        assert f"{starts} the guess" in str(found.restart)
        assert found.restart.cost < 0.01 * found.restart.cost_before
