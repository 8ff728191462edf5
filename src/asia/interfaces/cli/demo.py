"""asia demo: the example notebooks."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from asia._text import nearest, say
from asia.errors import UserError


def demo(
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="One notebook.")] = None,
    out: Annotated[Path, typer.Option(help="Directory to copy it to.")] = Path(),
) -> None:
    """List the example notebooks, or copy one to work on."""
    import shutil

    found = {path.stem: path for path in sorted(_folder().glob("*.ipynb"))}
    if name is None:
        width = max(map(len, found))
        for stem, path in found.items():
            say(f"{stem:<{width}}  {_title(path)}")
        say("asia demo NAME copies one into this directory; open it with: jupyter lab NAME.ipynb")
        return
    if name not in found:
        raise UserError(f"no notebook '{name}'{nearest(name, list(found))}")
    target = out / f"{name}.ipynb"
    if target.exists():
        raise UserError(f"{target} exists: give another --out")
    if not out.is_dir():
        raise UserError(f"{out} is not a directory: make it first, or give another --out")
    shutil.copyfile(found[name], target)
    say(f"{target}: open it with: jupyter lab {target}")


def _folder() -> Path:
    """Return the folder of the notebooks: in the installed package, or in the repository."""
    import asia

    package = Path(asia.__file__).parent
    installed = package / "notebooks"
    return installed if installed.is_dir() else package.parents[1] / "examples/notebooks"


def _title(path: Path) -> str:
    import json

    first = json.loads(path.read_text("utf-8"))["cells"][0]["source"]
    text = first if isinstance(first, str) else "".join(first)
    return text.splitlines()[0].removeprefix("# ")
