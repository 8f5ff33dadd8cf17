"""Comparison of two robots: rates of false and true alarms, its sentences, and what limits it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import t as student

import mjfim
from mjfim.arrays import NORMAL_95
from mjfim.errors import ExperimentError
from mjfim.identification.assessment.recording_comparison import compare_evidence
from mjfim.identification.assessment.robust_covariance import (
    block_length,
    independent_blocks,
    recording_evidence,
    robust_uncertainty,
)
from mjfim.output.pages import page_of
from mjfim.records.base import Level
from mjfim.records.estimate import PriorDirections
from mjfim.records.robots import RobotComparison
from mjfim.records.trajectory import Recording
from mjfim.studies.robot_comparison import compare_estimates, holm, honest_std
from tests.identification.test_robust_covariance import FINE, Linear, noise, waves
from tests.support.made_records import bare_estimate

NAMES = ("mass", "damping", "length")
UNITS = ("kg", "N m s/rad", "m")


def recordings(count: int, seed: int) -> tuple[Recording, ...]:
    """Recordings that differ from those of other seeds."""
    return tuple(
        Recording(
            t=np.arange(2.0),
            ctrl=np.zeros((1, 1)),
            y=np.array([[float(seed)], [float(k)]]),
            outputs=("y",),
            name=f"robot_{seed}_{k}.csv",
        )
        for k in range(count)
    )


def estimate(seed: int = 0, count: int = 2, **changes: Any) -> mjfim.Estimate:
    """An estimate of three parameters."""
    std = np.array([0.02, 0.01, 0.01])
    fields: dict[str, Any] = {
        "parameters": NAMES,
        "units": UNITS,
        "theta": np.array([2.0, 0.15, 1.0]),
        "std": std,
        "covariance": np.diag(std**2),
        "recordings": recordings(count, seed),
    }
    return bare_estimate(**{**fields, **changes})


# ---- one comparison


def test_a_worn_joint_is_named() -> None:
    worn = estimate(1, theta=np.array([2.01, 0.21, 1.0]))
    found = compare_estimates(estimate(), worn, names=("monday", "friday"))
    assert found.changed == (1,)
    assert found.differs
    sentence = found.sentence(1)
    assert sentence.startswith("damping of friday is 40 % above that of monday: 0.21 ± 0.02 ag")
    assert "0.15 ± 0.02 N m s/rad, p = " in sentence
    assert found.words == "There is a difference between monday and friday in damping."
    assert page_of(found).verdict.level is Level.DOUBTFUL

    # The distance is 4.2 standard deviations; four tests are made.
    sigmas = 0.06 / np.hypot(0.01, 0.01)
    assert found.p[1] == pytest.approx(4 * 2 * student.sf(sigmas, 1e6), rel=1e-2)
    half = NORMAL_95 * 0.01 * 2**0.5
    assert_allclose(found.interval[1], [0.06 - half, 0.06 + half], rtol=1e-3)

    # The other way round, the sign changes.
    back = compare_estimates(worn, estimate())
    assert "of B is 29 % below that of A" in back.sentence(1)


def test_equal_robots_say_what_would_have_been_found() -> None:
    found = compare_estimates(estimate(), estimate(1, theta=np.array([2.01, 0.152, 0.998])))
    assert not found.differs
    assert "no difference between A and B. A change of" in found.words
    assert "% in mass" in found.words
    assert "with 80 % power" in found.words
    assert page_of(found).verdict.level is Level.GOOD

    # 2.50 standard deviations for significance, and 0.84 for the power.
    expected = (student.isf(0.025 / 4, 1e6) + student.isf(0.2, 1e6)) * 0.02 * 2**0.5
    assert found.detectable[0] == pytest.approx(expected, rel=1e-3)


def test_entries_of_vectors_have_no_percentage() -> None:
    sizes = {"sizes": np.array([2.0, 1.0, 1.0])}
    changed = estimate(1, theta=np.array([2.0, 0.3, 1.0]), **sizes)
    found = compare_estimates(estimate(**sizes), changed)
    assert "damping of B is 0.15 N m s/rad above that of A" in found.sentence(1)


def test_combinations_may_differ_although_no_parameter_does() -> None:
    """Strongly correlated errors: the sum is known, and differs."""
    wide = 0.01 * np.array([[1.0, -0.99, 0.0], [-0.99, 1.0, 0.0], [0.0, 0.0, 1.0]])
    fields = {"std": np.full(3, 0.1), "covariance": wide}
    second = estimate(1, theta=np.array([1.06, 1.06, 1.0]), **fields)
    found = compare_estimates(estimate(theta=np.ones(3), **fields), second)
    assert found.changed == ()
    assert found.joint_p < 1e-3
    assert found.differs
    assert "do not say in which single parameter" in found.words


def test_wide_intervals_count_and_bounds_do_not() -> None:
    theta = np.array([2.0, 0.0, 1.0])
    interval = np.array([[1.8, 2.2], [0.0, 0.3], [0.9, 1.1]])
    wide = estimate(theta=theta, interval=interval, at_bound=("damping",))
    assert_allclose(honest_std(wide) * NORMAL_95, [0.2, 0.3, 0.1])


PRIOR = {"prior": np.diag([1.0, 0.0, 0.0])}
OF_MODEL = PriorDirections(bodies=("link",), count=10, determined=7, parameters=())


@pytest.mark.parametrize(
    ("of_both", "of_second", "said"),
    [
        ({}, {"misfit": True}, "does not explain the recordings of B (misfit)"),
        ({}, {"converged": False, "status": "stopped"}, "of B is not reliable: stopped"),
        ({}, {"units": ("g", *UNITS[1:])}, "mass is not compared: its units differ (kg and g)"),
        ({}, {"std": np.array([np.inf, 0.1, 0.1])}, "recordings of B do not determine it"),
        ({}, {"per_recording": {"mass": (1.0, 2.0)}}, "B has a value for each recording"),
        ({}, {"parameters": ("load", *NAMES[1:])}, "load: a parameter of B, but fixed for A"),
        ({}, {"count": 1}, "of B there is a single recording"),
        ({"count": 1}, {}, "single recordings say nothing"),
        ({}, {"seed": 0, "count": 3}, "both estimates contain robot_0_0.csv, robot_0_1.csv"),
        (PRIOR, {}, "mass: the priors"),
        ({}, {"prior_directions": OF_MODEL}, "B: combinations of inertias"),
        ({}, {"prior_directions": OF_MODEL}, "cad_prior = false"),
    ],
)
def test_remarks(of_both: dict[str, Any], of_second: dict[str, Any], said: str) -> None:
    found = compare_estimates(estimate(**of_both), estimate(**{"seed": 1, **of_both, **of_second}))
    assert any(said in remark for remark in found.remarks), found.remarks
    is_poor = "misfit" in of_second or "converged" in of_second
    assert found.is_reliable is not is_poor


def test_known_combinations_are_compared_by_the_honest_covariance() -> None:
    """Noise five times as large as stated, of which single parameters hardly show anything."""
    sums, differences = np.array([1.0, 1.0, 0.0]), np.array([1.0, -1.0, 0.0])
    wide = 0.005 * np.outer(differences, differences) + np.diag([0.0, 0.0, 1e-4])
    formal, honest = (wide + (0.5 * k) ** 2 * 1e-6 * np.outer(sums, sums) for k in (1.0, 5.0))
    std = np.sqrt(np.diag(formal))
    apart = 0.003 * sums

    def joint_p(**fields: Any) -> float:
        """Probability of the difference of the sums by chance."""
        fields = {"std": std, "covariance": formal, **fields}
        theta = np.ones(3)
        first, second = (estimate(k, theta=theta + k * apart, **fields) for k in (0, 1))
        return compare_estimates(first, second).joint_p

    assert joint_p() < 0.05
    assert joint_p(honest_covariance=honest) > 0.5
    assert joint_p(honest_covariance=formal) < 0.05

    # An interval that is 5 % wider does not hide the difference.
    half = NORMAL_95 * std * [1.05, 1.0, 1.0]
    interval = np.column_stack([1.0 - half, 1.0 + half])
    assert joint_p(interval=interval, honest_covariance=formal) < 0.05


def test_misuse() -> None:
    for second, names, message in (
        (estimate(1, parameters=("a", "b", "c")), ("A", "B"), "no parameter in common"),
        (estimate(), ("A", "B"), "from the same recordings"),
        (estimate(1), ("A", "A"), "two different names"),
    ):
        with pytest.raises(ExperimentError, match=message):
            compare_estimates(estimate(), second, names=names)


def test_initial_states_are_not_compared() -> None:
    names = ("mass", "initial qpos:hinge", "length")
    found = compare_estimates(estimate(parameters=names), estimate(1, parameters=names))
    assert found.parameters == ("mass", "length")
    assert not any("initial" in remark for remark in found.remarks)


def test_holm() -> None:
    assert_allclose(holm(np.array([0.04, 0.001, 0.03, 0.5])), [0.09, 0.004, 0.09, 0.5])
    assert holm(np.zeros(0)).shape == (0,)


# ---- rates


@dataclass(frozen=True, eq=False)
class Setting:
    """Two robots with K recordings each.

    Attributes:
        K: Number of recordings of each robot.
        phi: Correlation of successive noise values.
        tau: Scatter between recordings [standard deviations of one recording].
        c: Number of parameters.
    """

    K: int
    phi: float = 0.0
    tau: float = 0.0
    c: int = 3

    def estimated(self, rng: np.random.Generator, shift: float, seed: int) -> mjfim.Estimate:
        """Estimate of a robot whose first parameter is shifted."""
        N = 400
        X = waves(self.K, N, self.c)
        growth = (1.0 + self.phi) / (1.0 - self.phi)
        deviations = self.tau * np.sqrt(2.0 / N * growth) * rng.normal(size=(self.K, self.c))
        deviations[:, 0] += shift
        y = noise(self.phi, (self.K, N), rng) + np.einsum("knc,kc->kn", X, 1.0 + deviations)

        theta, condensed = Linear(X=X).fitted(y)
        recording = condensed.segment_of_block
        rows = np.full(len(recording), float(FINE))
        length = block_length([growth], self.K * N)
        own = np.zeros((self.K, 0), dtype=int)
        uncertainty = robust_uncertainty(
            condensed, theta, recording, rows, min_rows=length, draws=100, rng=rng, own=own
        )
        names, units = tuple(f"p{j}" for j in range(self.c)), ("",) * self.c
        comparison = None
        if self.K > 1:
            blocks = independent_blocks(condensed, recording, rows, length)
            comparison = compare_evidence(
                theta,
                recording_evidence(condensed, blocks, recording, own),
                recordings=list("abcd"[: self.K]),
                parameters=names,
                units=units,
                is_single=np.ones(self.c, dtype=bool),
            )
        covariance = np.linalg.inv(condensed.information())
        return estimate(
            seed,
            self.K,
            parameters=names,
            units=units,
            theta=theta,
            covariance=covariance,
            std=np.sqrt(np.diag(covariance)),
            std_sandwich=uncertainty.sandwich,
            interval=uncertainty.interval,
            between_recordings=uncertainty.between,
            recording_comparison=comparison,
        )

    def compared(self, rng: np.random.Generator, shift: float = 0.0) -> RobotComparison:
        """Compare two robots."""
        return compare_estimates(self.estimated(rng, 0.0, 1), self.estimated(rng, shift, 2))


@pytest.mark.slow
@pytest.mark.parametrize(
    "setting",
    [Setting(K=2), Setting(K=1, phi=0.9), Setting(K=3, phi=0.9, c=8), Setting(K=4, tau=3.0)],
    ids=str,
)
def test_rate_of_false_alarms(setting: Setting) -> None:
    """The stated level is 5 %; 60 comparisons give more than 7 with a probability of 1 %."""
    rng = np.random.default_rng(1)
    assert sum(setting.compared(rng).differs for _ in range(60)) <= 7


@pytest.mark.slow
@pytest.mark.parametrize("setting", [Setting(K=1), Setting(K=4, phi=0.9)], ids=str)
def test_rate_of_true_alarms(setting: Setting) -> None:
    """A shift as large as the difference that would be found with a probability of 80 %."""
    rng = np.random.default_rng(2)
    found, hits = setting.compared(rng), 0
    # A binomial number with 60 and 0.8 is outside with a probability of 4e-4.
    for _ in range(60):
        found = setting.compared(rng, float(found.detectable[0]))
        hits += 0 in found.changed
    assert 37 <= hits <= 57
