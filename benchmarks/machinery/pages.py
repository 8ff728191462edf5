"""Pictures of the pages of asia view, for the documentation.

python benchmarks/machinery/pages.py RUNS RUN [--real RUN] [--out docs/img/pages] [--browser PATH]

Starts `asia view` on the folder RUNS and opens its pages in a headless Chromium: the page of RUN,
its trade-offs, comparison and tabs at 1280 pixels in light. --real: a search on measured data, for
the curve of the first page. Prints the files.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

from playwright.sync_api import Browser, expect, sync_playwright

SCREEN = {"width": 1280, "height": 860}


def main() -> None:
    """Take all pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path)
    parser.add_argument("run")
    parser.add_argument("--real", default="")
    parser.add_argument("--out", type=Path, default=Path("docs/img/pages"))
    parser.add_argument("--browser", default=shutil.which("chromium"))
    given = parser.parse_args()
    page, real = f"/runs/{given.run}", f"/runs/{given.real}"
    # Name, address, section to show (none: the top of the page).
    pictures = [
        ("run", page, ""),
        ("trade-offs", page, "tradeoff"),
        ("simulations", f"{page}/simulations", ""),
        ("overlay", f"/compare?e={given.run}/2&e={given.run}/4&e={given.run}/8", "overlays"),
        ("linear", f"{page}/linear", ""),
        *([("search", real, "progress")] if given.real else []),
    ]
    asia = str(Path(sys.executable).parent / "asia")
    command = [asia, "view", str(given.runs), "--port", "0"]
    given.out.mkdir(parents=True, exist_ok=True)
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            address = process.stdout.readline().split()[1]
            with sync_playwright() as playwright:
                browser = playwright.chromium.launch(
                    executable_path=given.browser, args=["--no-sandbox"]
                )
                take(browser, address, pictures, given.out)
        finally:
            process.terminate()


def take(browser: Browser, address: str, pictures: list[tuple[str, str, str]], out: Path) -> None:
    """Take pictures on one screen."""
    context = browser.new_context(viewport=SCREEN, color_scheme="light")  # pyright: ignore
    page = context.new_page()
    page.goto(address)
    host = address.partition("/?")[0]
    for name, path, section in pictures:
        page.goto(host + path)
        waiting = page.locator("section:not([hidden]) [data-part]:empty")
        expect(waiting).to_have_count(0, timeout=60_000)
        file = out / f"view-{name}.png"
        # The bar of sections would lie over the top of a long section.
        page.evaluate(
            "for (const nav of document.querySelectorAll('nav')) nav.style.position = 'static'"
        )
        if section in ("progress", "overlays", "settings", "timeline", "tradeoff"):
            page.set_viewport_size({"width": SCREEN["width"], "height": 2000})
            page.locator(f"#{section}").screenshot(path=file)
            page.set_viewport_size(SCREEN)  # pyright: ignore
        else:
            if section:
                page.evaluate(f"document.querySelector('#{section}').scrollIntoView()")
            page.wait_for_timeout(700)
            page.screenshot(path=file)
        print(file)
    context.close()


if __name__ == "__main__":
    main()
