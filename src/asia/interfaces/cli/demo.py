"""asia demo: the example notebooks."""

import json
import shutil
from pathlib import Path
from typing import Annotated

import typer

import asia
from asia._text import nearest, say
from asia.errors import UserError


def demo(
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="One notebook.")] = None,
    out: Annotated[Path, typer.Option(help="Directory to copy it to.")] = Path(),
) -> None:
    """List the example notebooks, or copy one to work on."""
    # In the installed package, or in the repository.
    package = Path(asia.__file__).parent
    folder = package / "notebooks"
    if not folder.is_dir():
        folder = package.parents[1] / "examples/notebooks"
    found = {path.stem: path for path in sorted(folder.glob("*.ipynb"))}
    if name is None:
        width = max(map(len, found))
        for stem, path in found.items():
            first = json.loads(path.read_text("utf-8"))["cells"][0]["source"]
            title = "".join(first).splitlines()[0].removeprefix("# ")
            say(f"{stem:<{width}}  {title}")
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
