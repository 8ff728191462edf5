"""Pictures that are drawn and laid out, but not painted: most of the time of a short search goes
into paint, which the tests of the report look at."""

from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO

import pytest
from matplotlib.figure import Figure

_PAINT, _LAYOUT = Figure.savefig, Figure.draw_without_rendering


def _blank(figure: Figure, stream: BytesIO, **settings: object) -> None:
    assert figure.axes, "the picture shows nothing"
    assert settings["format"] in ("png", "pdf", "svg")
    is_svg = settings["format"] == "svg"
    stream.write(b'<svg viewBox="0 0 1 1"/>' if is_svg else b"not painted")


@contextmanager
def unpainted() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", _blank)
        patch.setattr(Figure, "draw_without_rendering", lambda _: None)
        yield


@contextmanager
def painted() -> Iterator[None]:
    """As outside tests, where `unpainted` holds as well."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", _PAINT)
        patch.setattr(Figure, "draw_without_rendering", _LAYOUT)
        yield
