"""The live pages in a browser, under a search that goes on."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, Page, expect, sync_playwright

from asia.ledger.artifacts import Store
from asia.ledger.chain import Chain
from asia.ledger.verification import verify
from asia.problem.problem import Problem
from asia.report.page.page import write_page
from tests.unit.report.made_up import append_experiment

from .conftest import ATTACK, make_run, write_linear

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
SIZES = {"wide": {"width": 1280, "height": 900}, "phone": {"width": 390, "height": 844}}
PAGES = (
    "/",
    "/runs/made",
    "/runs/made/simulations",
    "/runs/made/experiments/2",
    "/compare?run=other&e=made/1&e=made/2",
    "/runs/made/linear",
)

# A busy machine is slow.
expect.set_options(timeout=60_000)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs chromium: apt-get install chromium"),
]


@dataclass
class Server:
    """`asia view` as a process of its own."""

    runs: Path
    port: int = 0
    address: str = ""
    process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        command = [sys.executable, "-c", "from asia.interfaces.cli import main; main()", "view"]
        command += [str(self.runs), "--port", str(self.port)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        self.address = self.process.stdout.readline().split()[1]
        self.port = urlsplit(self.address).port or 0

    def end(self, number: int = signal.SIGKILL) -> int:
        assert self.process is not None
        assert self.process.stdout is not None
        self.process.send_signal(number)
        code = self.process.wait(60)
        self.process.stdout.close()
        return code

    def at(self, path: str) -> str:
        return f"http://127.0.0.1:{self.port}{path}"


@dataclass
class Watched:
    """A page with what the browser complains of and asks for."""

    page: Page
    complaints: list[str] = field(default_factory=list)
    hosts: set[str] = field(default_factory=set)

    def begin(self) -> None:
        self.page.on("console", lambda m: self.complaints.append(f"{m.type}: {m.text}"))
        self.page.on("pageerror", lambda e: self.complaints.append(str(e)))
        self.page.on("request", lambda r: self.hosts.add(urlsplit(r.url).netloc))


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield started
        started.close()


@pytest.fixture
def server(runs: Path, problem: Problem) -> Iterator[Server]:
    make_run(runs / "other", problem, (("only", 0.25),))
    write_linear(runs / "made")
    server = Server(runs)
    server.start()
    yield server
    if server.process is not None and server.process.poll() is None:
        server.end()


@pytest.fixture
def watched(server: Server, browser: Browser) -> Iterator[Watched]:
    """A page that was given the token."""
    context = browser.new_context(viewport=SIZES["wide"])
    watched = Watched(context.new_page())
    watched.begin()
    watched.page.goto(server.address)
    yield watched
    context.close()


def grow(runs: Path, problem: Problem, number: int, title: str) -> None:
    directory = runs / "made"
    with Chain(directory / "ledger.jsonl") as chain:
        append_experiment(chain, Store(directory / "artifacts"), problem, number, title, 0.3, 1.0)


def test_a_new_experiment_appears_and_a_title_stays_text(
    server: Server, watched: Watched, problem: Problem
) -> None:
    page = watched.page
    page.goto(server.at("/runs/made"))
    expect(page.locator("#connection")).to_have_text("live")
    grow(server.runs, problem, 5, ATTACK)
    expect(page.locator("#rows li").first).to_have_id("e5")
    expect(page.locator("#e5")).to_contain_text("<script>")
    expect(page.locator("#now")).to_contain_text("0.3000")
    expect(page.locator("#live")).to_contain_text("Experiment 5, keep, V 0.3000")
    expect(page.locator("#verdict")).to_contain_text("<script>")
    expect(page.locator("#curve .best use")).to_have_count(3)
    assert page.title() == "made · ASIA"
    assert (watched.complaints, watched.hosts) == ([], {f"127.0.0.1:{server.port}"})


@pytest.mark.long
def test_the_address_keeps_the_chosen_experiments(
    server: Server, watched: Watched, problem: Problem
) -> None:
    page = watched.page
    page.goto(server.at("/runs/made"))
    expect(page.locator("#connection")).to_have_text("live")
    page.get_by_label("in order").select_option("v")
    expect(page.locator("#rows li").first).to_have_id("e2")
    page.get_by_label("Show").select_option("kept")
    expect(page.locator("#rows li")).to_have_count(2)
    page.get_by_label("with the words").fill("first")
    expect(page.locator("#rows li")).to_have_count(1)
    assert page.url == server.at("/runs/made?kind=kept&order=v&words=first")
    page.reload()
    expect(page.locator("#rows li")).to_have_count(1)
    expect(page.get_by_label("with the words")).to_have_value("first")
    page.get_by_label("with the words").fill("")
    grow(server.runs, problem, 5, "fresh")
    expect(page.locator("#rows li").first).to_have_id("e5")
    assert watched.complaints == []


def test_a_page_outlives_its_server(server: Server, watched: Watched, problem: Problem) -> None:
    page = watched.page
    page.goto(server.at("/runs/made"))
    expect(page.locator("#connection")).to_have_text("live")
    server.end(signal.SIGKILL)
    expect(page.locator("#connection")).to_contain_text("no connection")
    grow(server.runs, problem, 5, "meanwhile")
    server.start()
    expect(page.locator("#connection")).to_have_text("live")
    expect(page.locator("#e5")).to_contain_text("meanwhile")
    grow(server.runs, problem, 6, "afterwards")
    expect(page.locator("#e6")).to_contain_text("afterwards")
    assert server.end(signal.SIGINT) == 0


@pytest.mark.long
def test_the_list_of_runs_moves(server: Server, watched: Watched, problem: Problem) -> None:
    page = watched.page
    page.get_by_label("choose made").check()
    with Chain(server.runs / "other" / "ledger.jsonl"):
        expect(page.locator("#list .state.running")).to_have_count(1)
        expect(page.get_by_label("choose made")).to_be_checked()
    page.get_by_label("choose other").check()
    page.get_by_role("button", name="Compare the chosen runs").click()
    expect(page.get_by_role("heading", level=1)).to_have_text("Comparison")
    page.locator(".chooser summary").get_by_text("made").click()
    page.get_by_label("#04").check()
    page.get_by_role("button", name="Show the chosen").click()
    query = parse_qs(urlsplit(page.url).query)
    assert {name: sorted(values) for name, values in query.items()} == {
        "run": ["made", "other"],
        "e": ["made/2", "made/4", "other/1"],
    }
    for name in ("made #02", "made #04", "other #01"):
        expect(page.locator("#overlays svg").first).to_contain_text(name)
    box = page.locator(".zoomable").first
    whole = box.locator(".other path").first.get_attribute("d")
    box.get_by_role("button", name="zoom in").click()
    expect(box.locator(".other path").first).not_to_have_attribute("d", whole or "")
    assert watched.complaints == []


def test_a_search_is_steered_with_the_keyboard_alone(server: Server, watched: Watched) -> None:
    page = watched.page
    page.goto(server.at("/runs/made"))
    page.get_by_text("Steer this search").focus()
    page.keyboard.press("Enter")
    page.keyboard.press("Tab")
    page.keyboard.type("the pump saturates at 8 V")
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    expect(page.locator(".steering [role=status]").last).to_contain_text("noted")
    (note,) = (server.runs / "made" / "control").glob("steer-*.txt")
    assert note.read_text() == "the pump saturates at 8 V"
    expect(page.get_by_role("button", name="Stop after")).to_be_disabled()
    with Chain(server.runs / "made" / "ledger.jsonl"):
        page.once("dialog", lambda dialog: dialog.accept())
        page.get_by_role("button", name="Stop after").click()
        expect(page.locator(".steering [role=status]").last).to_contain_text("stops after")
    assert (server.runs / "made" / "control" / "stop").exists()


@pytest.mark.long
def test_overlays_zoom_by_keyboard_and_pointer(server: Server, watched: Watched) -> None:
    page = watched.page
    page.goto(server.at("/runs/made/experiments/2"))
    box = page.locator(".zoomable").first
    line = box.locator(".measured path")
    whole = line.get_attribute("d")
    assert whole is not None
    box.get_by_role("button", name="zoom in").focus()
    page.keyboard.press("Enter")
    expect(line).not_to_have_attribute("d", whole)
    expect(page.locator("#live")).to_contain_text("samples")
    box.get_by_role("button", name="show all").click()
    expect(line).to_have_attribute("d", whole)
    place = box.locator(".plot").first.bounding_box()
    assert place is not None
    middle = place["y"] + place["height"] / 2
    page.mouse.move(place["x"] + place["width"] / 4, middle)
    page.mouse.down()
    page.mouse.move(place["x"] + place["width"] / 2, middle, steps=3)
    page.mouse.up()
    expect(line).not_to_have_attribute("d", whole)
    first, last = (int(box.get_attribute(f"data-{end}") or 0) for end in ("first", "last"))
    count = int(box.get_attribute("data-count") or 0)
    assert (round(first / count, 1), round((last - first) / count, 2)) == (0.2, 0.25)
    assert watched.complaints == []


@pytest.mark.parametrize(
    ("size", "scheme"),
    [("wide", "light"), ("phone", "dark")],
)
def test_pages_fit_the_screen_and_are_accessible(
    server: Server, browser: Browser, size: str, scheme: str
) -> None:
    context = browser.new_context(viewport=SIZES[size], color_scheme=scheme)  # pyright: ignore
    watched = Watched(context.new_page())
    watched.begin()
    page = watched.page
    page.goto(server.address)
    report = write_page(server.runs / "made").as_uri()
    found: list[str] = []
    for address in (*map(server.at, PAGES), report):
        page.goto(address)
        if address.endswith("/runs/made"):
            expect(page.locator("#reproduce pre")).to_be_visible()
        for one in Axe().run(page).response["violations"]:
            if one["impact"] in ("serious", "critical"):
                places = [node["html"][:120] for node in one["nodes"][:3]]
                found.append(f"{address}: {one['id']}: {places}")
        room, wide = page.evaluate("[innerWidth, document.documentElement.scrollWidth]")
        assert wide <= room, address
    context.close()
    assert found == []
    assert watched.complaints == []
    assert watched.hosts <= {f"127.0.0.1:{server.port}", ""}


@pytest.mark.long
def test_an_experiment_is_tagged_with_the_keyboard_alone(server: Server, watched: Watched) -> None:
    page = watched.page
    page.goto(server.at("/runs/made/experiments/2"))
    expect(page.locator("#connection")).to_have_text("live")
    page.get_by_text("Note or tag this experiment").focus()
    page.keyboard.press("Enter")
    for text in ("it diverges <b>late</b>", "unstable again", "", "Ada"):
        page.keyboard.press("Tab")
        page.keyboard.type(text)
    page.keyboard.press("Enter")
    expect(page.locator("#story")).to_contain_text("+unstable +again it diverges <b>late</b>")
    expect(page.locator("#story .label")).to_have_text(["unstable", "again"])
    page.get_by_label("Tags to remove").fill("missing")
    page.get_by_label("Note, or reason").fill("no such tag")
    page.keyboard.press("Enter")
    expect(page.locator(".steering [role=status]")).to_have_text(
        "there is no tag 'missing' to remove"
    )
    page.goto(server.at("/runs/made"))
    expect(page.locator("#e2 .label").first).to_have_text("unstable")
    expect(page.locator("#notes li")).to_contain_text("#02 +unstable +again it diverges")
    assert verify(server.runs / "made", ledger_alone=True).records == 13
