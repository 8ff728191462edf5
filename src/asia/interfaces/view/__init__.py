"""The page of a run, live: a server on this machine alone that follows ledgers as they grow."""

from asia._plugins import is_installed
from asia.errors import UserError


def require_server() -> None:
    """Raises UserError where the extra is not installed."""
    if not (is_installed("starlette") and is_installed("uvicorn")):
        raise UserError(
            "asia view needs Starlette and uvicorn, which are an extra: "
            "pip install '.[view]' in a clone of ASIA"
        )
