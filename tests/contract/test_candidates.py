import pytest

from asia.testing import check_candidate

SMALL = """
import numpy as np


class Model:
    def __init__(self, weights):
        self.weights = weights

    def simulate(self, past_u, past_y, u):
        y, v, x = np.empty(u.shape), past_u[:, -1], past_y[:, -1]
        for k in range(u.shape[1]):
            x = x * self.weights[0] + v * self.weights[1]
            v = u[:, k]
            y[:, k] = x
        return ANSWER


def fit(trajectories, context):
    t = trajectories[0]
    x = np.concatenate([t.y[:-1], t.u[:-1]], axis=1)
    return Model(np.linalg.lstsq(x, t.y[1:, 0], rcond=None)[0] + NOISE)
"""


def small(answer: str = "y", noise: str = "0") -> str:
    return SMALL.replace("ANSWER", answer).replace("NOISE", noise)


@pytest.mark.slow
def test_an_honest_candidate_conforms() -> None:
    check_candidate(small())


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("x = 1", "no top-level function fit"),
        (small(answer="y[:, :-1]"), "wrong size"),
        (small(answer="0 * y"), "no output moves"),
        (small(noise="-0.1 * np.random.default_rng().random()"), "a second fit"),
    ],
)
def test_the_suite_names_the_fault(source: str, words: str) -> None:
    with pytest.raises(AssertionError, match=words):
        check_candidate(source)
