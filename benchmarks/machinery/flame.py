"""Flame graphs of recorded stacks, one below the other on one scale of seconds.

py-spy record -r 100 -s -f raw -o fold.txt -- python -c "$(python benchmarks/machinery/flame.py)"
python benchmarks/machinery/flame.py before.txt=before fold.txt=after --out flame.png

Without arguments: prints a script that evaluates one grey-box fold, to be recorded. Stacks of all
processes and threads count, those that wait left out by py-spy. A box is a function; what it calls
lies above it. Boxes are coloured by the package that the function is of.
"""

from __future__ import annotations

import argparse
import runpy
import sys
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

RATE = 100
DEEPEST = 60
COLOURS = {"asia": "#4477aa", "jax": "#cc6677", "numpy": "#ddcc77", "import": "#117733"}
NARROWEST, LABELLED = 0.004, 0.06


@dataclass
class Frame:
    """A function and what it calls."""

    samples: int = 0
    inner: dict[str, Frame] = field(default_factory=lambda: defaultdict(Frame))


def main() -> None:
    """Draw, or print the script."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("stacks", nargs="*", help="FILE=TITLE")
    parser.add_argument("--out", type=Path, default=Path("flame.png"))
    given = parser.parse_args()
    if not given.stacks:
        seconds = Path(__file__).parents[1] / "searches" / "seconds.py"
        sys.stdout.write(runpy.run_path(str(seconds))["FOLD"])
        return
    from matplotlib import pyplot

    pairs = [word.partition("=") for word in given.stacks]
    roots = [(title or file, read(Path(file))) for file, _, title in pairs]
    longest = max(root.samples for _, root in roots) / RATE
    figure, axes = pyplot.subplots(len(roots), 1, figsize=(9, 4.2 * len(roots)), squeeze=False)
    for (title, root), axis in zip(roots, axes[:, 0], strict=True):
        draw(axis, root, 0.0, 0, longest)
        axis.set(xlim=(0, longest), ylim=(0, DEEPEST), yticks=[])
        axis.set_xlabel("seconds of running threads")
        axis.set_title(f"{title}: {root.samples / RATE:.1f} s", loc="left", fontsize=10)
        axis.spines[["top", "right", "left"]].set_visible(False)
    for name, colour in COLOURS.items():
        axes[-1, 0].bar([0], [0], color=colour, label=name)
    axes[-1, 0].legend(loc="upper right", fontsize=8, frameon=False)
    figure.tight_layout()
    figure.savefig(given.out, dpi=110)


def read(file: Path) -> Frame:
    """The tree of the stacks in py-spy's raw format: names from the outside in, then a count."""
    root = Frame()
    for line in file.read_text().splitlines():
        names, _, count = line.rpartition(" ")
        at = root
        at.samples += int(count)
        for name in (n for n in names.split(";") if not n.startswith("process ")):
            at = at.inner[name]
            at.samples += int(count)
    return root


def draw(axis: Any, frame: Frame, left: float, depth: int, longest: float) -> None:
    """Boxes of what `frame` calls."""
    for name, inner in sorted(frame.inner.items(), key=lambda item: -item[1].samples):
        width = inner.samples / RATE
        if depth < DEEPEST and width > NARROWEST * longest:
            colour = colour_of(name)
            axis.barh(
                depth + 0.5, width, 0.95, left=left, color=colour, edgecolor="white", linewidth=0.3
            )
            if width > LABELLED * longest:
                words = name.partition(" (")[0].partition(":")[0][: int(150 * width / longest)]
                axis.text(left, depth + 0.5, f" {words}", fontsize=4, va="center")
            draw(axis, inner, left, depth + 1, longest)
        left += width


def colour_of(name: str) -> str:
    """By the file that py-spy names."""
    if "importlib" in name:
        return COLOURS["import"]
    packages = {"jax": "/jax", "numpy": "/numpy", "asia": "asia/"}
    found = next((key for key, part in packages.items() if part in name or f"({key}/" in name), "")
    return COLOURS.get(found, "#bbbbbb")


if __name__ == "__main__":
    main()
