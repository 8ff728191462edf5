"""Write the list of docs/plants.md from the catalogue: `make plants`."""

from __future__ import annotations

from pathlib import Path

from asia.plants.catalogue import catalogue

PAGE = Path(__file__).parents[1] / "plants.md"
MARK = "<!-- written by docs/site/plants.py -->\n"


def listed() -> str:
    """One line a plant; a signal in brackets may be missing."""
    lines: list[str] = []
    for plant in catalogue().values():
        entry = plant.entry
        inputs = [f"({n})" if r.absent else n for n, r in entry.inputs.items()]
        outputs = [f"({n})" if r.optional else n for n, r in entry.outputs.items()]
        signals = " → ".join(map(", ".join, (inputs, outputs)))
        lines.append(f"- `{plant.name}`: {plant.title}: {signals}")
    return "\n".join(lines) + "\n"


def page(text: str) -> str:
    """The page with a new list behind the mark."""
    return text.partition(MARK)[0] + MARK + listed()


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
