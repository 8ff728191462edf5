"""The page in a browser: nothing wider than the screen, no complaint, no script of a candidate."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from html import escape, unescape
from pathlib import Path

import pytest

from asia.ledger.run import open_run
from asia.problem.load import load_problem
from asia.problem.lock import lock_text
from asia.problem.problem import Seal
from asia.report.page.page import write_page

from .made_up import write_run

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
ATTACK = "<script>document.title='owned'</script><img src=x onerror=document.title='owned'>"

# A frame has the width of a phone, which a window of a browser without a screen cannot have.
LOOK = """<!doctype html><iframe id=f width={width} height=800 srcdoc="{page}"></iframe><script>
f.onload = () => {{
  const d = f.contentDocument, e = d.documentElement;
  for (const one of d.querySelectorAll('details')) one.open = true;
  document.body.dataset.seen = JSON.stringify({{
    title: d.title, wide: e.scrollWidth, room: e.clientWidth,
    sections: d.querySelectorAll('section').length, back: getComputedStyle(d.body).backgroundColor,
    loaded: f.contentWindow.performance.getEntriesByType('resource').length,
  }});
}};</script>"""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs chromium: apt-get install chromium"),
]


def look(page: Path, folder: Path, width: int, *, dark: bool) -> tuple[dict[str, object], str]:
    """Layout of the page in a frame of a width, and the complaints of the browser."""
    assert CHROMIUM is not None
    harness = folder / f"look-{width}-{dark}.html"
    harness.write_text(LOOK.format(width=width, page=escape(page.read_text("utf-8"))), "utf-8")
    command = [CHROMIUM, "--headless", "--no-sandbox", "--dump-dom"]
    command += ["--enable-logging=stderr", f"--user-data-dir={folder / 'profile'}"]
    command += ["--virtual-time-budget=5000", "--window-size=1400,1000"]
    command += [f"--blink-settings=preferredColorScheme={0 if dark else 1}", harness.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    seen = re.search(r'data-seen="([^"]*)"', done.stdout)
    assert seen, done.stderr[-2000:]
    complaints = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    return json.loads(unescape(seen[1])), "\n".join(complaints)


@pytest.mark.parametrize(("width", "dark"), [(390, True), (1280, False)])
def test_the_page_fits_every_screen_and_complains_of_nothing(
    tmp_path: Path, width: int, dark: bool
) -> None:
    directory = tmp_path / "made"
    directory.mkdir()
    problem = load_problem("two_tanks_sim")
    (directory / "problem.lock.toml").write_text(lock_text(problem, Seal(None, None)), "utf-8")
    outcomes = (("first " + "long " * 30, 0.9), (ATTACK, 0.5), ("failing", None), ("last", 0.2))
    page = write_page(write_run(directory, problem, outcomes, unsealed=1))
    seen, complaints = look(page, tmp_path, width, dark=dark)
    assert complaints == ""
    assert seen["title"] == f"{open_run(directory).name}: report of a search"
    assert seen["wide"] == seen["room"]
    assert seen["loaded"] == 0
    assert seen["back"] == ("rgb(20, 23, 27)" if dark else "rgb(255, 255, 255)")
    assert seen["sections"] == 11
