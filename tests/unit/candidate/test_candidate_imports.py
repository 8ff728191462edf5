"""Libraries that a source loads, read without running it."""

import subprocess
import sys

import pytest

from asia.candidate import imported_libraries

FAMILIES = ("arx", "greybox", "linear", "narx", "neural_ss", "recurrent")


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("import numpy as np\nimport os", set()),
        ("import jax\nimport scipy.signal", {"jax"}),
        ("import jax.numpy as jnp", {"jax"}),
        ("from jax import numpy as jnp", {"jax"}),
        ("from scipy import signal, optimize", set()),
        ("try:\n    import jax\nexcept ImportError:\n    jax = None", {"jax"}),
        ("import jaxtyping", set()),
        ("import optax", {"jax"}),
        ("from equinox import nn", {"jax"}),
        ("if TYPE_CHECKING:\n    import jax", set()),
        ("def fit(a, b):\n    import jax", set()),
        ("import scipy._lib, jaxlib, os.path, antigravity", set()),
        ("from asia.models import ../../etc", set()),
        ("from . import jax", set()),
        ("import asia.models.no_such_family", set()),
        ("import asia.models.__init__.py", set()),
        ("x = " + "(" * 5000, set()),
    ],
)
def test_what_a_source_loads(source: str, expected: set[str]) -> None:
    assert imported_libraries(source, fitting=True) == expected


@pytest.mark.parametrize("family", FAMILIES)
def test_a_stored_model_of_the_library_loads_no_more_than_is_said(family: str) -> None:
    source = f"from asia.models import {family}"
    said = imported_libraries(source, fitting=False)
    script = f"import sys\n{source}\nprint(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert said <= set(done.stdout.split())


def test_what_a_family_trains_with_is_known_from_its_source() -> None:
    source = "from asia.models import neural_ss\nfrom asia.models.methods import Adam"
    assert imported_libraries(source, fitting=True) == {"jax"}
    assert imported_libraries("from asia.models import arx", fitting=True) == set()
