"""How fluent the live page of a long search is, in a browser.

python benchmarks/machinery/view.py [--experiments 2000] [--news 20] [--browser PATH]

Writes a run of made-up experiments of the simulated tanks, starts `asia view` as a process and
opens the run's page in a headless Chromium of 1280 x 900. Prints seconds from the request to the
load event and to the first row and curve on the screen, frames per second while the list of
experiments and the whole page scroll, and the time from the line in the ledger to the row in the
page, with the load of the machine.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from playwright.sync_api import Page, sync_playwright

from asia.judge.scoring.outcome import FoldRecord, Score
from asia.ledger.artifacts import Store
from asia.ledger.chain import Chain
from asia.ledger.events import Evaluated, Proposed, ReferenceScored, Started
from asia.problem.folds import make_folds
from asia.problem.load import load_problem
from asia.problem.lock import lock_text
from asia.problem.problem import Problem, Seal

NAME = "long"
SCROLL = """async ([query, pixels, seconds]) => {
  const place = query ? document.querySelector(query) : document.scrollingElement;
  const times = [];
  const begun = performance.now();
  return new Promise((done) => {
    const step = (now) => {
      times.push(now);
      place.scrollTop += pixels;
      if (place.scrollTop + place.clientHeight >= place.scrollHeight - 2) place.scrollTop = 0;
      if (now - begun < 1000 * seconds) return requestAnimationFrame(step);
      const gaps = times.slice(1).map((t, k) => t - times[k]).sort((a, b) => a - b);
      done([1000 * gaps.length / (times.at(-1) - times[0]), gaps[Math.floor(0.99 * gaps.length)]]);
    };
    requestAnimationFrame(step);
  });
}"""
SHOWN = """() => {
  const row = document.querySelector("#rows li"), curve = document.querySelector("#curve svg");
  return Boolean(row && row.getBoundingClientRect().height && curve);
}"""


def main() -> None:
    """Write, open, measure, print."""
    options = argparse.ArgumentParser()
    options.add_argument("--experiments", type=int, default=2000)
    options.add_argument("--news", type=int, default=20)
    options.add_argument("--browser", default=shutil.which("chromium"))
    options.add_argument("--repeats", type=int, default=5)
    asked = options.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        runs = Path(folder)
        writer = Writer(runs / NAME, asked.experiments)
        print(f"{asked.experiments} experiments, {_megabytes(runs / NAME / 'ledger.jsonl')}")
        print(f"load of the machine {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
        with serving(runs) as address, sync_playwright() as playwright:
            browser = playwright.chromium.launch(
                executable_path=asked.browser, args=["--no-sandbox"]
            )
            page = browser.new_page(viewport={"width": 1280, "height": 900})
            measure(page, address, writer, asked.repeats, asked.news)
            browser.close()


def measure(page: Page, address: str, writer: Writer, repeats: int, news: int) -> None:
    """A row a measurement."""
    loaded: list[tuple[float, float]] = []
    for _ in range(repeats):
        begun = time.perf_counter()
        page.goto(address)
        load = time.perf_counter() - begun
        page.wait_for_function(SHOWN)
        loaded.append((load, time.perf_counter() - begun))
    first, best = loaded[0], min(loaded, key=lambda pair: pair[1])
    print(f"load, first time      {first[0]:.2f} s, rows and curve shown {first[1]:.2f} s")
    print(f"load, best of {repeats}       {best[0]:.2f} s, rows and curve shown {best[1]:.2f} s")
    page.wait_for_timeout(2000)
    for words, query in (("list of experiments", "#rows"), ("whole page", "")):
        page.evaluate("document.querySelector('#rows').scrollIntoView()")
        rate, worst = page.evaluate(SCROLL, [query, 60, 5])
        print(f"scroll, {words:<20} {rate:.0f} frames/s, 99 % of frames within {worst:.0f} ms")
    late: list[float] = []
    for _ in range(news):
        number = writer.add()
        begun = time.perf_counter()
        page.wait_for_selector(f"#e{number} .status:not(.running)", state="attached")
        late.append(time.perf_counter() - begun)
    late.sort()
    print(f"a new experiment      median {statistics.median(late):.2f} s, most {late[-1]:.2f} s")


class Writer:
    """Writes made-up experiments of the simulated tanks."""

    def __init__(self, directory: Path, experiments: int) -> None:
        self._random = random.Random(0)
        self._problem = load_problem("two_tanks_sim")
        self._store = Store(directory / "artifacts")
        self._best = 1.0
        self._number = 0
        directory.mkdir()
        lock = directory / "problem.lock.toml"
        lock.write_text(lock_text(self._problem, Seal(None, None)), "utf-8")
        self._outputs = self._make_outputs()
        self._chain = Chain(directory / "ledger.jsonl")
        self._chain.append(_started(self._problem, experiments))
        self._chain.append(ReferenceScored("linear model", Score(0.6, ())))
        for _ in range(experiments):
            self.add()

    def add(self) -> int:
        """One more; its number."""
        self._number = n = self._number + 1
        value = self._best * (0.97 if self._random.random() < 0.02 else 1 + self._random.random())
        status = "keep" if value < self._best or n == 1 else "discard"
        self._best = min(self._best, value)
        source = self._store.put(f"# candidate {n}\n".encode())
        title = f"state space with {4 + n % 60} neurons and a delay of {n % 7} samples"
        words = ("explore", "state_space", title, "a slow state is missing", "V below the best")
        self._chain.append(Proposed(n, max(1, n - 1) if n > 1 else None, *words, source, str(n)))
        numbers = value, (value,), (value,), (50.0,), (0.75,)
        folds = tuple(
            FoldRecord(*numbers, model=source, y_hat=y_hat, curve=source, fit_seconds=1.0)
            for y_hat in self._outputs
        )
        self._chain.append(Evaluated(n, status, Score(value, folds), None, 2.0))
        return n

    def _make_outputs(self) -> list[str]:
        folds = make_folds(self._problem.train, self._problem.protocol)
        return [self._store.put_arrays([0.9 * b.y for b in fold.held_out]) for fold in folds]


def _started(problem: Problem, experiments: int) -> Started:
    return Started(
        run=NAME,
        problem=problem.name,
        agent="expert",
        seed=0,
        experiments=experiments,
        hours=None,
        outputs=tuple(signal.name for signal in problem.outputs),
        lock_digest="",
        protocol_digest="",
        test_digest=None,
        isolation="namespace",
        isolation_notes=(),
        environment={},
    )


@contextmanager
def serving(runs: Path) -> Iterator[str]:
    """`asia view` as a process of its own; the address of the run's page."""
    asia = str(Path(sys.executable).parent / "asia")
    command = [asia, "view", str(runs / NAME), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield process.stdout.readline().split()[1]
        finally:
            process.terminate()


def _megabytes(path: Path) -> str:
    return f"{path.stat().st_size / 1e6:.1f} MB of ledger"


if __name__ == "__main__":
    main()
