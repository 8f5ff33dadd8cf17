"""Information of earlier experiments: sums by name, marginals, and priors counted once."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.special import polygamma

from mjfim.errors import ExperimentError
from mjfim.excitation.design import design_task
from mjfim.excitation.prior_information import known_from
from mjfim.output import archive
from mjfim.output.words import sigma_remark
from mjfim.studies.check import check_task
from tests.support.numerics import CART_PARAMETERS, Array, cart_task


def information(seed: int, size: int) -> Array:
    """A well-conditioned information matrix."""
    root = np.random.default_rng(seed).standard_normal((2 * size, size))
    return root.T @ root


def design_file(path: Path, names: list[str], matrix: Array, prior: Array | None = None) -> Path:
    """A design.json with the entries that `earlier` reads."""
    prior = np.zeros_like(matrix) if prior is None else prior
    values = {"parameters": names, "data": (matrix - prior).tolist(), "prior": prior.tolist()}
    path.write_text(json.dumps(values), encoding="utf-8")
    return path


def marginal(matrix: Array, kept: list[int]) -> Array:
    """Information about some parameters where the others are unknown."""
    return np.linalg.inv(np.linalg.inv(matrix)[np.ix_(kept, kept)])


TWO, THREE, FOUR = (information(size, size) for size in (2, 3, 4))
SUM = np.array([[4.0, 4.0, 0.0], [4.0, 4.0, 0.0], [0.0, 0.0, 9.0]])
OWN, OF_X = np.diag([5.0, 0.0, 7.0]), np.diag([0.0, 0.0, 7.0])
START = ["a", "initial qpos:slide", "bias acc"]
OF_START = np.diag([0.0, 100.0, 0.0])
APART = np.zeros((3, 3))
APART[::2, ::2] = marginal(THREE + OF_START, [0, 2])

# The parameters of a file, its information with its prior, the prior, the parameters of the next
# experiment, and what is known about them.
KNOWN = {
    "other order": (["b", "a"], TWO, None, ["a", "b"], TWO[::-1, ::-1]),
    # The covariance of the shared parameters is that of the file, with unknown other ones.
    "further parameters": (["x", "a", "y", "b"], FOUR, None, ["a", "b"], marginal(FOUR, [1, 3])),
    # Only the sum of a and x is known, so that nothing is known about a.
    "confounded": (["a", "x", "b"], SUM, None, ["a", "b"], np.diag([0.0, 9.0])),
    # A prior would be counted again with every file; those of marginalised parameters stay.
    "prior": (["a", "b", "x"], THREE + OWN, OWN, ["a", "b", "x"], THREE),
    "prior of another": (
        ["a", "b", "x"],
        THREE + OWN,
        OWN,
        ["a", "b"],
        marginal(THREE + OF_X, [0, 1]),
    ),
    # Deviations of the initial state differ between experiments; biases of sensors are common.
    "initial state": (START, THREE + OF_START, OF_START, START, APART),
}


@pytest.mark.parametrize("case", KNOWN)
def test_what_a_file_knows_is_found_by_name(case: str, tmp_path: Path) -> None:
    names, matrix, prior, asked, wanted = KNOWN[case]
    path = design_file(tmp_path / "design.json", names, matrix, prior)
    assert_allclose(known_from([path], tuple(asked)).information, wanted, rtol=1e-11, atol=1e-12)
    twice = known_from([path, path], tuple(asked)).information
    assert_allclose(twice, 2.0 * wanted, rtol=1e-11, atol=1e-12)
    assert not known_from([], tuple(asked)).information.any()


def estimate_file(path: Path, names: list[str], honest: list[float | None], **more: object) -> Path:
    """An estimate.json with formal deviations of 0.1 and honest ones, which may be unknown.

    It is that of two recordings, unless it states others. Bounds cut half of its intervals off.
    """
    zero = np.zeros((len(names), len(names))).tolist()
    values = {"parameters": names, "data": zero, "prior": zero, "sigma": {}}
    covariance = np.diag([np.inf if each is None else each**2 for each in honest])
    values |= {"std": [0.1] * len(names), "honest_covariance": covariance.tolist()}
    values |= {"honest_std": [None if each is None else 0.5 * each for each in honest]}
    values |= {"recordings": ["one", "two"], **more}
    path.write_text(json.dumps(values), encoding="utf-8")
    return path


def test_estimates_tell_how_much_wider_honest_deviations_are(tmp_path: Path) -> None:
    """Mean squares of several estimates, at least 1; what chance explains of differences is left
    out, and unknown ones are as the others.
    """
    first = estimate_file(tmp_path / "1.json", ["b", "a", "c"], [0.2, 3.0, None], sigma={"y": 2.0})
    second = estimate_file(tmp_path / "2.json", ["a", "d"], [4.0, 0.05])
    known = known_from([first, second], ("a", "b", "c", "d"))
    logs = np.log([np.sqrt((30.0**2 + 40.0**2) / 2.0), 2.0, 1.0])
    # The variance of the logarithm of a standard deviation of four normal values, by its theory.
    chance = polygamma(1, 1.5) / 4.0
    kept = 1.0 - chance / np.var(logs)
    wanted = np.exp(logs.mean() + kept * (logs - logs.mean()))
    assert_allclose(known.inflation[[0, 1, 3]], wanted, rtol=1e-9)
    assert f"(d) to {wanted[0]:.0f} (a) times" in sigma_remark(known.inflation, "abcd")
    assert known.inflation[2] == pytest.approx(np.exp(logs.mean()))
    # One of an earlier version has no such covariance.
    alike = estimate_file(tmp_path / "3.json", ["a", "b"], [0.4, 0.6], honest_covariance=[])
    assert_allclose(known_from([alike], ("a", "b")).inflation, np.sqrt(6.0), rtol=1e-12)
    assert known.sigma == {"y": 2.0}
    design = design_file(tmp_path / "d.json", ["a"], np.eye(1))
    assert not len(known_from([design], ("a",)).inflation)


@pytest.mark.parametrize("recordings", [["one"], ["one", "two"]])
def test_sigma_is_that_of_the_residuals_of_an_earlier_estimate(
    recordings: list[str], tmp_path: Path
) -> None:
    """Data count by the honest deviation and the noise of the estimate; stated priors do not.

    One recording shows half of the variance that a model which lacks something causes.
    """
    honest = np.array([0.3, 0.2, 0.25])
    parameters = {**CART_PARAMETERS, "l": {**CART_PARAMETERS["l"], "prior": 0.02}}
    white = cart_task(tmp_path, parameters=parameters)
    sigma = dict(zip(white.system.outputs.names, 3.0 * white.system.noise.sigma, strict=True))
    data = check_task(white).information - white.prior
    more = {"data": data.tolist(), "recordings": recordings, "sigma": sigma}
    path = estimate_file(tmp_path / "e.json", ["m", "l", "c"], honest.tolist(), **more)
    found = check_task(cart_task(tmp_path, parameters=parameters, earlier=[str(path)]))
    squares = 1.0 + (3 - len(recordings)) * ((10.0 * honest) ** 2 - 1.0)
    prior = np.diag([0.0, 0.02**-2, 0.0])
    wanted = np.linalg.inv((data / 9.0 + data) / squares.prod() ** (1.0 / 3.0) + prior)
    assert_allclose([row.std for row in found.rows], np.sqrt(np.diag(wanted)), rtol=1e-6)
    assert found.steps is not None and found.steps.confirmed.all()


FAULTS = {
    "no file": (None, "cannot read: No such file"),
    "not JSON": ("{", "not a JSON file"),
    "a list": ("[1, 2]", "not a JSON object"),
    "no parameters": ('{"data": [[1.0]], "prior": [[0.0]]}', "neither a design.json nor"),
    "no information": ('{"parameters": ["a"], "prior": [[0.0]]}', "neither a design.json nor"),
    "text": ('{"parameters": ["a"], "data": [["many"]], "prior": [[0]]}', "neither a design.json"),
    "ragged": ('{"parameters": ["a", "b"], "data": [[1], [1, 2]], "prior": []}', "neither a"),
    "infinite": ('{"parameters": ["a"], "data": [[null]], "prior": [[0]]}', "not 1 x 1 finite"),
    "wrong size": ('{"parameters": ["a", "b"], "data": [[1]], "prior": [[0]]}', "not 2 x 2"),
    "wrong prior": ('{"parameters": ["a"], "data": [[1.0]], "prior": [1, 2]}', "not 1 x 1 finite"),
    "strangers": (
        '{"parameters": ["x", "y"], "data": [[1, 0], [0, 1]], "prior": [[0, 0], [0, 0]]}',
        r"information about x, y, but .* a, b",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_unusable_files_are_named(name: str, tmp_path: Path) -> None:
    """The message names the file and the fault."""
    text, message = FAULTS[name]
    path = tmp_path / "odd.json"
    if text is not None:
        path.write_text(text, encoding="utf-8")
    with pytest.raises(ExperimentError, match=rf"earlier: .*odd\.json: .*{message}"):
        known_from([path], ("a", "b"))


def test_a_design_that_was_written_is_read_back(tmp_path: Path) -> None:
    """The information of its data is prior information of the next experiment, but not its data."""
    tables = {"descent": {"max_iterations": 1}, "cost": {"criterion": "A"}}
    m, c = CART_PARAMETERS["m"], CART_PARAMETERS["c"]
    first = cart_task(tmp_path, parameters={"m": {**m, "prior": 0.1}, "c": c}, **tables)
    design = design_task(first)
    archive.write_data(tmp_path / "one", design, first.system)
    own = design.final.information - np.diag([100.0, 0.0])
    earlier = str(tmp_path / "one" / "design.json")
    turned = {"c": {**c, "prior": 2.0}, "m": m}
    second = cart_task(tmp_path, parameters=turned, earlier=(earlier,), **tables)
    assert_allclose(second.prior, own[::-1, ::-1] + np.diag([0.25, 0.0]), rtol=1e-9)
    again = design_task(second)
    archive.write_data(tmp_path / "two", again, second.system)
    files = [tmp_path / number / "design.json" for number in ("one", "two")]
    total = known_from(files, ("c", "m")).information
    assert_allclose(total, again.final.information - np.diag([0.25, 0.0]), rtol=1e-8)
    with pytest.raises(ExperimentError, match=r"experiment: earlier: .*gone\.json"):
        cart_task(tmp_path, earlier=("gone.json",))
