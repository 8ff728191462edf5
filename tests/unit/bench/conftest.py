from collections.abc import Iterator

import pytest

from tests.unit.painting import unpainted


@pytest.fixture(scope="package", autouse=True)
def unpainted_pictures() -> Iterator[None]:
    with unpainted():
        yield
