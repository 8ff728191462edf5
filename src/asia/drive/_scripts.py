"""Scripts that a workspace comes with."""

PLOT = '''"""Draws the training records: python plot.py [data/NAME.csv ...] -> data.png"""

import csv
import sys
import tomllib
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

problem = tomllib.loads(Path("problem.toml").read_text("utf-8"))
units = {s["name"]: s.get("unit", "") for s in [*problem["inputs"], *problem["outputs"]]}
paths = [Path(p) for p in sys.argv[1:]] or sorted(Path("data").glob("*.csv"))
for path in paths[:8]:
    with path.open(newline="") as stream:
        header, *rows = csv.reader(stream)
    columns = list(zip(*[[float(cell) for cell in row] for row in rows]))
    figure, axes = plt.subplots(len(header) - 1, 1, sharex=True, figsize=(10, 1.6 * len(header)))
    for axis, name, values in zip(figure.axes, header[1:], columns[1:]):
        axis.plot(columns[0], values, linewidth=0.8)
        unit = units.get(name)
        axis.set_ylabel(f"{name} [{unit}]" if unit else name, rotation=0, ha="right")
    figure.axes[-1].set_xlabel(f"{header[0]} [s]")
    figure.suptitle(path.stem)
    name = "data.png" if len(paths) == 1 else f"data-{path.stem}.png"
    figure.savefig(name, bbox_inches="tight", dpi=120)
    print(name)
'''


TOOLS = '''"""Scores a candidate on training records as the evaluator does, and shows its residuals.

    python tools.py                   candidate.py on the folds of V
    python tools.py best.py --fold 1  another file, one fold
    python tools.py --blocks 5        folds of your own: each record in five parts
    python tools.py --hold-out A,B    a fold of your own: these records held out, the others train
    python tools.py --seed 1          another seed of the fits: spread of V
    python tools.py --plot            also draw simulation and residuals into plots/

It costs no experiment. The candidate runs in this process, without sandbox, time limit or memory
limit. In a script of your own:

    from tools import TOOLS
    for fold in TOOLS.evaluate("candidate.py"):
        print(fold.score.value, fold.parameters, fold.residuals(held_out=False))
"""

from pathlib import Path

from asia.tools import WorkspaceTools, main

TOOLS = WorkspaceTools(Path(__file__).parent, seed={seed})

if __name__ == "__main__":
    main(TOOLS)
'''
