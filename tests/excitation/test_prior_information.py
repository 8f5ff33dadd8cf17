"""Information of earlier experiments: sums by name, marginals, and priors counted once."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mjfim.errors import ExperimentError
from mjfim.excitation.design import design_task
from mjfim.excitation.task_parts import information_of
from mjfim.output import archive
from tests.support.numerics import CART_PARAMETERS, Array, cart_task


def information(seed: int, size: int) -> Array:
    """A well-conditioned information matrix."""
    root = np.random.default_rng(seed).standard_normal((2 * size, size))
    return np.asarray(root.T @ root)


def design_file(path: Path, names: list[str], matrix: Array, prior: Array | None = None) -> Path:
    """A design.json with the entries that `earlier` reads."""
    prior = np.zeros_like(matrix) if prior is None else prior
    values = {"parameters": names, "data": (matrix - prior).tolist(), "prior": prior.tolist()}
    path.write_text(json.dumps(values), encoding="utf-8")
    return path


def test_designs_and_estimates_add_up_by_name(tmp_path: Path) -> None:
    """The names may be in any order."""
    first, second = information(0, 2), information(1, 2)
    design = design_file(tmp_path / "design.json", ["b", "a"], first)
    estimate = design_file(tmp_path / "estimate.json", ["c", "a"], second)
    wanted = np.zeros((3, 3))
    wanted[np.ix_([1, 0], [1, 0])] += first
    wanted[np.ix_([2, 0], [2, 0])] += second
    assert_allclose(information_of([design, estimate], ("a", "b", "c")), wanted, rtol=1e-12)
    assert not information_of([], ("a", "b")).any()


def marginal(matrix: Array, kept: list[int]) -> Array:
    """Information about some parameters where the others are unknown."""
    return np.asarray(np.linalg.inv(np.linalg.inv(matrix)[np.ix_(kept, kept)]))


def test_further_parameters_of_a_file_are_marginalised(tmp_path: Path) -> None:
    """The covariance of the shared parameters is that of the file, with unknown other ones."""
    matrix = information(2, 4)
    path = design_file(tmp_path / "design.json", ["x", "a", "y", "b"], matrix)
    assert_allclose(information_of([path], ("a", "b")), marginal(matrix, [1, 3]), rtol=1e-11)


def test_nothing_is_known_about_a_parameter_that_is_confounded_with_others(tmp_path: Path) -> None:
    """Only the sum of a and x is known, so that nothing is known about a."""
    matrix = np.array([[4.0, 4.0, 0.0], [4.0, 4.0, 0.0], [0.0, 0.0, 9.0]])
    path = design_file(tmp_path / "design.json", ["a", "x", "b"], matrix)
    assert_allclose(information_of([path], ("a", "b")), np.diag([0.0, 9.0]), atol=1e-12)


def test_the_prior_of_a_file_is_left_out(tmp_path: Path) -> None:
    """It would be counted again with every file; priors of marginalised parameters stay."""
    data, prior = information(3, 3), np.diag([5.0, 0.0, 7.0])
    path = design_file(tmp_path / "design.json", ["a", "b", "x"], data + prior, prior)
    assert_allclose(information_of([path], ("a", "b", "x")), data, rtol=1e-12)
    joint = data + np.diag([0.0, 0.0, 7.0])
    assert_allclose(information_of([path], ("a", "b")), marginal(joint, [0, 1]), rtol=1e-11)


def test_deviations_of_the_initial_state_belong_to_one_experiment(tmp_path: Path) -> None:
    """Their values differ between experiments; sensor biases are common to all experiments."""
    names = ["a", "initial qpos:slide", "bias acc"]
    data, prior = information(4, 3), np.diag([0.0, 100.0, 0.0])
    path = design_file(tmp_path / "design.json", names, data + prior, prior)
    found = information_of([path], tuple(names))
    assert not found[1].any() and not found[:, 1].any()
    assert_allclose(found[::2, ::2], marginal(data + prior, [0, 2]), rtol=1e-11)


FAULTS = {
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
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ExperimentError, match=rf"earlier: .*odd\.json: .*{message}"):
        information_of([path], ("a", "b"))


def test_missing_files_are_named(tmp_path: Path) -> None:
    for path, fault in ((tmp_path / "gone.json", "No such file"), (tmp_path, "Is a directory")):
        with pytest.raises(ExperimentError, match=f"{path.name}: cannot read: {fault}"):
            information_of([path], ("a",))


def test_a_design_that_was_written_is_read_back(tmp_path: Path) -> None:
    """The information of its data is prior information of the next experiment, but not its data."""
    tables = {"descent": {"max_iterations": 1}, "cost": {"criterion": "A"}}
    m, c = CART_PARAMETERS["m"], CART_PARAMETERS["c"]
    first = cart_task(tmp_path, parameters={"m": {**m, "prior": 0.1}, "c": c}, **tables)
    design = design_task(first)
    archive.write_design(tmp_path / "one", design, first.system)
    own = design.final.information - np.diag([100.0, 0.0])
    earlier = str(tmp_path / "one" / "design.json")
    turned = {"c": {**c, "prior": 2.0}, "m": m}
    second = cart_task(tmp_path, parameters=turned, earlier=(earlier,), **tables)
    assert_allclose(second.prior, own[::-1, ::-1] + np.diag([0.25, 0.0]), rtol=1e-9)
    again = design_task(second)
    archive.write_design(tmp_path / "two", again, second.system)
    files = [tmp_path / number / "design.json" for number in ("one", "two")]
    total = information_of(files, ("c", "m"))
    assert_allclose(total, again.final.information - np.diag([0.25, 0.0]), rtol=1e-8)
    with pytest.raises(ExperimentError, match=r"experiment: earlier: .*gone\.json"):
        cart_task(tmp_path, earlier=("gone.json",))
