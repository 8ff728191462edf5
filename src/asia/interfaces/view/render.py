"""Templates of the live pages, and addresses in them."""

from __future__ import annotations

from typing import Any, Final
from urllib.parse import quote

from markupsafe import Markup

from asia._files import PACKAGE
from asia.report.page.render import environment


def run_address(name: str) -> str:
    """The path of a run's page."""
    return f"/runs/{quote(name, safe='')}"


def experiments_of(name: str) -> str:
    """The path of an experiment's page, without its number at the end."""
    return f"{run_address(name)}/experiments/"


_VIEW: Final = environment(PACKAGE / "interfaces" / "view" / "templates")
_ADDRESSES: Final[dict[str, Any]] = {"run_address": run_address, "experiments_of": experiments_of}
_VIEW.globals.update(_ADDRESSES)


def fill(template: str, **values: Any) -> Markup:
    """Fill a template of the live pages or of the report."""
    return Markup(_VIEW.get_template(template).render(values))
