"""Content of the live pages."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from starlette.testclient import TestClient

from asia.agents.registry import reads_notes
from asia.analysis.importance import share_of_variance
from asia.errors import Reason, UserError
from asia.interfaces.view.followed import FollowedRun, RunFolder
from asia.interfaces.view.pages import importance_part, steering_panel
from asia.judge.scoring.outcome import Failure
from asia.ledger.artifacts import Store
from asia.ledger.chain import Chain
from asia.ledger.events import Evaluated, Proposed
from asia.ledger.run import open_run
from asia.problem.problem import Problem
from asia.recipe import Recipe
from asia.report.page.page import page_of
from tests.unit.report.made_up import append_experiment, append_test

from .conftest import ATTACK, TOKEN, make_run, write_linear

POST = {"x-asia-token": TOKEN}
PAIR = "/compare?run=made&e=made/4"
SECTIONS = ("verdict", "model", "accuracy", "test", "use", "integrity", "reproduce")


def test_the_list_has_every_run(client: TestClient, runs: Path, problem: Problem) -> None:
    make_run(runs / "other", problem, (("only", None),))
    (runs / "torn").mkdir()
    (runs / "torn" / "ledger.jsonl").write_text("{}\n")
    page = client.get("/").text
    assert re.findall(r'<a href="/runs/(\w+)">', page) == ["torn", "other", "made"]
    assert "two_tanks_sim" in page
    assert "4 of 4" in page
    assert "cannot be read" in page
    assert re.findall(r'<span class="state (\w+)">', page) == ["finished", "interrupted"]


def test_a_run_that_another_process_writes_is_running(client: TestClient, runs: Path) -> None:
    with Chain(runs / "made" / "ledger.jsonl"):
        assert '<span class="state running">' in client.get("/").text
        assert '<span class="state running">' in client.get("/runs/made").text


def test_the_page_of_a_run_has_its_experiments_the_last_one_first(client: TestClient) -> None:
    page = client.get("/runs/made").text
    assert re.findall(r'<li id="e(\d)" class="(\w+)">', page) == [
        ("4", "other"),
        ("3", "failed"),
        ("2", "kept"),
        ("1", "kept"),
    ]
    assert 'href="/runs/made/experiments/4"' in page
    assert re.findall(r'class="why">([^<]*)', page) == [
        "V 40.0 % above #02",
        "the simulation diverged to NaN or infinity: constrain stability, bound the states or "
        "lower the learning rate",
        "V 44.4 % below #01",
        "the first with a score",
    ]


def test_an_experiment_of_an_interrupted_search_does_not_run(
    client: TestClient, runs: Path
) -> None:
    with Chain(runs / "made" / "ledger.jsonl") as chain:
        source = Store(runs / "made" / "artifacts").put(b"# unfinished\n")
        words = "because", "lower", source, "5"
        chain.append(Proposed(5, None, "explore", "family", "unfinished", *words))
        assert '<span class="status running">running' in client.get("/runs/made/rows").text
    assert '<span class="status unfinished">unfinished' in client.get("/runs/made/rows").text


@pytest.mark.parametrize(
    "address", ["", "/curve", "/rows", "/sections/verdict", "/experiments/2", "/experiments/2/part"]
)
def test_what_a_candidate_says_is_text(client: TestClient, address: str) -> None:
    page = client.get(f"/runs/made{address}").text
    assert ATTACK[:8] not in page.replace('<script src="/static/', "")
    assert "<img" not in page
    assert "&lt;script&gt;" in page


def test_sections_without_matter_are_empty(client: TestClient) -> None:
    for key in ("confirmation", "progress", "experiments", "nothing"):
        assert client.get(f"/runs/made/sections/{key}").status_code == 204


def test_test_figures_are_shown_once_the_test_is_open_and_not_before(
    client: TestClient, runs: Path, problem: Problem
) -> None:
    addresses = [
        "/",
        "/runs/made",
        "/runs/made/experiments/2",
        PAIR,
        *(f"/runs/made/sections/{key}" for key in SECTIONS),
    ]
    assert client.get("/runs/made/sections/test").status_code == 204
    before = "".join(client.get(address).text for address in addresses)
    append_test(runs / "made", problem, 1)
    opened = open_run(runs / "made").view.unsealed
    assert opened is not None
    figure = f"{opened.ensemble.scores[0].value:.4g}"
    assert figure not in before
    assert figure in client.get("/runs/made/sections/test").text
    assert figure in client.get(PAIR).text
    assert "not opened" in before
    assert "never opened" in before


def test_no_address_gives_artifacts_or_files(client: TestClient, runs: Path) -> None:
    run = open_run(runs / "made")
    artifact = run.view.experiments[0].proposed.source
    for address in (
        f"/runs/made/artifacts/{artifact}",
        "/runs/made/ledger.jsonl",
        "/runs/..%2fruns%2fmade",
        "/runs/made%00",
        "/static/..%2f_app.py",
        "/static/_app.py",
    ):
        assert client.get(address).status_code in (404, 405), address


@pytest.mark.parametrize("name", ["..", ".", "", "../runs/made", "made/../made", "made\0", "none"])
def test_only_a_folder_of_the_folder_itself_is_a_run(runs: Path, name: str) -> None:
    folder = RunFolder(runs / "made")
    (runs / "made" / "inner").mkdir()
    with pytest.raises(UserError, match="no run"):
        folder.get(name)


def test_a_run_that_is_not_there_is_named(client: TestClient) -> None:
    answer = client.get("/runs/none")
    assert answer.status_code == 404
    assert "no run &#39;none&#39;" in answer.text


def test_an_experiment_has_its_story_simulations_and_source(client: TestClient) -> None:
    page = client.get("/runs/made/experiments/4").text
    for words in ("because", "discard", "Held-out simulations", "candidate.py", "# last"):
        assert words in page
    assert 'href="/runs/made/experiments/3"' in page
    assert 'href="/runs/made/experiments/5"' not in page
    assert page.count('class="zoomable"') == 2
    failed = client.get("/runs/made/experiments/3").text
    assert 'class="zoomable"' not in failed
    assert client.get("/runs/made/experiments/5").status_code == 404


def test_a_part_of_a_simulation_is_drawn_again(client: TestClient) -> None:
    """With the times of its own samples, 4 s apart."""
    address = "/runs/made/experiments/4/overlays/1"
    whole, part = client.get(address).text, client.get(f"{address}?first=100&last=110").text
    lines = [re.findall(r'class="measured"><path d="M([^"]*)"', text)[0] for text in (whole, part)]
    assert [line.count("L") > 100 for line in lines] == [True, False]
    assert lines[1].count("L") == 10
    times = [float(t) for t in re.findall(r"text-anchor: middle[^>]*>([\d.]+)<", part)]
    assert 38 < min(times) <= max(times) < 44
    beyond = client.get(f"{address}?first=100000&last=200000")
    assert beyond.status_code == 200
    assert client.get("/runs/made/experiments/4/overlays/2").status_code == 404
    assert client.get("/runs/made/experiments/3/overlays/0").status_code == 404


def test_any_number_of_runs_and_experiments_is_compared(
    client: TestClient, runs: Path, problem: Problem
) -> None:
    for name, value in (("other", 0.25), ("third", 0.125)):
        make_run(runs / name, problem, (("only", value),))
    page = client.get("/compare?run=made&run=other&run=third").text
    assert page.count('data-stream="/runs/') == 3
    assert page.count('class="zoomable"') == 2
    assert all(value in page for value in ("0.5000", "0.2500", "0.1250"))
    assert "do not compare" not in page
    assert page.count('class="side"') == 3
    overlaid = page.split('id="overlays"')[1]
    assert re.findall(r'class="(measured|other|simulated)"', overlaid)[:4] == [
        "measured", "other", "other", "simulated",
    ]  # fmt: skip
    assert all(name in overlaid for name in ("made #02", "other #01", "third #01"))
    query = "e=made/1&e=made/4&e=other/1"
    page = client.get(f"/compare?{query}").text
    chosen = re.findall(r'value="(\w+/\d)" checked', page)
    assert sorted(chosen) == ["made/1", "made/4", "other/1"]
    assert 'data-refresh="/compare/part?run=made&amp;e=made%2F1' in page
    part = client.get(f"/compare/overlays/1?{query}&first=100&last=110").text
    (line,) = re.findall(r'class="measured"><path d="M([^"]*)"', part)
    assert (line.count("L"), part.count('class="other"')) == (10, 2)
    assert client.get(f"/compare/overlays/2?{query}").status_code == 404
    failed = client.get("/compare?e=made/3").text
    assert ("No chosen experiment has a score" in failed, "zoomable" in failed) == (True, False)
    for wrong in ("run=made&run=none", "e=made/9", "e=none/1", ""):
        assert client.get(f"/compare?{wrong}").status_code == 404, wrong


def test_linear_model_and_control_have_pages_where_the_run_has_them(
    client: TestClient, runs: Path
) -> None:
    assert client.get("/runs/made/linear").status_code == 404
    write_linear(runs / "made")
    for address, here in (("/runs/made", "Search"), ("/runs/made/linear", "Linear models"),
                          ("/runs/made/control", "Control")):  # fmt: skip
        page = client.get(address).text
        assert re.findall(r'href="(/runs/made[a-z/]*)"[^>]*>([A-Z][a-z ]+)</a>', page)[:4] == [
            ("/runs/made", "Search"),
            ("/runs/made/simulations", "Simulations"),
            ("/runs/made/linear", "Linear models"),
            ("/runs/made/control", "Control"),
        ]
        assert re.findall(r'aria-current="page">([^<]+)<', page) == [here]
    page = client.get("/runs/made/linear").text
    assert page.split('class="poles"')[1].split('class="zeros"')[0].count("<use") == 2
    assert ("&lt;script&gt;" in page, "<script>document" in page) == (True, False)
    assert client.get("/runs/made/sections/linear").status_code == 204
    assert client.get("/runs/made/certificate").status_code == 404
    (runs / "made" / "linear" / "linear.json").write_text("{}")
    assert "run asia linear again" in client.get("/runs/made/linear").text


def test_runs_of_other_problems_are_not_compared_without_a_word(
    client: TestClient, runs: Path, problem: Problem
) -> None:
    make_run(runs / "other", replace(problem, name="another"), (("only", 0.25),))
    assert "do not compare" in client.get("/compare?run=made&run=other").text


def test_a_run_without_its_artifacts_has_what_the_ledger_says(
    client: TestClient, runs: Path
) -> None:
    (runs / "made" / "artifacts").rename(runs / "made" / "elsewhere")
    for address in ("/runs/made", "/runs/made/experiments/2", PAIR):
        page = client.get(address)
        assert page.status_code == 200
        assert 'class="zoomable"' not in page.text


def test_a_run_without_its_records_says_so(client: TestClient, runs: Path) -> None:
    lock = runs / "made" / "problem.lock.toml"
    lock.write_text(lock.read_text().replace("simulated:two_tanks", "no_such:source"))
    assert "No simulations, because the records are missing" not in client.get("/runs/made").text
    assert client.get("/runs/made/experiments/2").status_code == 200
    assert "No simulations, because the records are missing" in client.get("/runs/made").text


@pytest.mark.parametrize(
    ("query", "numbers"),
    [
        ("", "4321"),
        ("order=oldest", "1234"),
        ("order=v", "2413"),
        ("order=v&after=2&most=2", "41"),
        ("order=made+up&kind=made+up", "4321"),
        ("kind=failed", "3"),
        ("kind=kept&order=oldest", "12"),
        ("words=LAST", "4"),
        ("words=script+title", "2"),
        ("words=%23+first", "1"),
        ("words=nowhere+to+be+found", ""),
    ],
)
def test_experiments_are_chosen_and_sorted(client: TestClient, query: str, numbers: str) -> None:
    found = re.findall(r'<li id="e(\d)"', client.get(f"/runs/made/rows?{query}").text)
    assert found == list(numbers)
    if "after" not in query:
        assert re.findall(r'<li id="e(\d)"', client.get(f"/runs/made?{query}").text) == found
    assert ("No experiment fits." in client.get(f"/runs/made/rows?{query}").text) == (not numbers)


def test_the_text_search_reads_sources_and_output(client: TestClient, runs: Path) -> None:
    store = Store(runs / "made" / "artifacts")
    source, output = store.put(b"order = 47\n"), store.put(b"the \x1b[31mpump\nsaturates\n")
    failure = Failure(Reason.CRASH, "", 1)
    with Chain(runs / "made" / "ledger.jsonl") as chain:
        chain.append(Proposed(5, None, "refine", "arx", "plain", "why", "lower", source, "5"))
        chain.append(Evaluated(5, "crash", failure, output, 1.0))
    advice = Reason.CRASH.advice
    for words, place in (
        ("ORDER 47", "source: <mark>order</mark> = 47"),
        ("saturates", "pump <mark>saturates</mark>"),
        ("arx why", "family: <mark>arx</mark>"),
        (advice, f"<mark>{advice.split()[0]}</mark>"),
    ):
        row = client.get("/runs/made/rows", params={"words": words}).text
        assert re.findall(r'<li id="e(\d)"', row) == ["5"], words
        assert place in row
        assert "\x1b" not in row
    assert advice[:20] in client.get("/runs/made/rows").text


def test_a_long_list_comes_in_pieces(client: TestClient) -> None:
    first = client.get("/runs/made/rows?most=3").text
    assert re.findall(r'<li id="e(\d)"', first) == ["4", "3", "2"]
    assert 'data-after="2"' in first
    rest = client.get("/runs/made/rows?after=2&most=99999999").text
    assert re.findall(r'<li id="e(\d)"', rest) == ["1"]
    assert "<button" not in rest


def test_a_note_reaches_the_search(client: TestClient, runs: Path) -> None:
    answer = client.post("/runs/made/steer", content="the pump saturates", headers=POST)
    assert answer.json()["words"].startswith("noted: recorded when the search continues")
    (note,) = (runs / "made" / "control").glob("steer-*.txt")
    assert note.read_text() == "the pump saturates"
    assert client.post("/runs/made/steer", content=" ", headers=POST).status_code == 409
    assert client.post("/runs/made/steer", content="x" * 30_000, headers=POST).status_code == 409


def test_a_note_for_people_is_in_the_ledger_and_on_the_pages(
    client: TestClient, runs: Path
) -> None:
    note = {"author": "Ada", "text": ATTACK, "experiment": "2", "tags": "odd again", "removed": ""}

    def send(**changes: str) -> tuple[int, str]:
        body = json.dumps({**note, **changes})
        answer = client.post("/runs/made/note", content=body, headers=POST)
        return answer.status_code, answer.json()["words"]

    assert send() == (200, "recorded in the ledger")
    assert send(experiment="0", tags="", text="for the paper") == (200, "recorded in the ledger")
    assert send(tags="", removed="odd", text="no longer")[0] == 200
    for bad, words in (
        ({"author": " "}, "the author has 1 to 80 characters"),
        ({"text": ""}, "a note or a reason has 1 to 4000 characters"),
        ({"tags": "<b>"}, "'<b>' is no tag"),
        ({"experiment": "7"}, "has no experiment 7"),
        ({"experiment": "x"}, "expected the fields author"),
        ({"removed": "odd"}, "there is no tag 'odd' to remove"),
    ):
        code, answer = send(**bad)
        assert (code, words in answer) == (409, True), answer
    run = open_run(runs / "made")
    assert [(one.author, one.experiment) for one in run.view.noted] == [
        ("Ada", 2), ("Ada", 0), ("Ada", 2),
    ]  # fmt: skip
    assert run.view.tags(2) == ("again",)
    row = client.get("/runs/made/rows?words=again").text
    assert re.findall(r'<li id="e(\d)"', row) == ["2"]
    assert '<span class="label">again</span>' in row
    part = client.get("/runs/made/sections/notes").text
    assert ("for the paper" in part, "onerror=" in part, "<img" in part) == (True, True, False)
    page = page_of(run)
    assert ("for the paper" in page, "<img" in page) == (True, False)


def test_a_running_search_is_paused_and_stopped(client: TestClient, runs: Path) -> None:
    folder = runs / "made" / "control"
    for what in ("pause", "stop"):
        answer = client.post(f"/runs/made/{what}", headers=POST)
        assert answer.status_code == 409
        assert f"there is nothing to {what}" in answer.json()["words"]
    with Chain(runs / "made" / "ledger.jsonl"):
        assert client.post("/runs/made/pause", headers=POST).status_code == 200
        assert (folder / "pause").exists()
        assert client.post("/runs/made/continue", headers=POST).status_code == 200
        assert not (folder / "pause").exists()
        assert client.post("/runs/made/stop", headers=POST).status_code == 200
        assert (folder / "stop").exists()
    assert client.post("/runs/made/anything", headers=POST).status_code == 409


def test_the_box_for_notes_is_off_where_the_agent_reads_none(
    client: TestClient, runs: Path
) -> None:
    assert "reads no notes" not in client.get("/runs/made").text
    started = open_run(runs / "made").view.started
    for agent, reads in (("random", False), ("bayes", False), ("expert", True), ("own", True)):
        assert reads_notes(replace(started, agent=agent)) is reads
        leading = replace(started, agent="leading", agent_settings={"then": agent})
        assert reads_notes(leading) is reads
    for deaf in ("random", ""):
        text = str(steering_panel("made", running=True, deaf=deaf))
        assert ("The agent 'random' reads no notes." in text) is bool(deaf)
        boxes = re.findall(r"<textarea[^>]*>|<button[^>]*submit[^>]*>", text)
        assert len(boxes) == 2
        assert all(("disabled" in box) is bool(deaf) for box in boxes)


def test_a_setting_that_decides_v_has_the_share_and_the_other_has_none() -> None:
    rng = np.random.default_rng(0)
    decides, other = np.repeat([0, 1, 2], 10), rng.integers(0, 3, 30)
    values = np.array([0.0, 1.0, 3.0])[decides] + 0.1 * rng.standard_normal(30)
    share, p = share_of_variance(decides, values)
    assert (share > 0.98, p) == (True, 0.001)
    shares = [share_of_variance(other, rng.standard_normal(30), k) for k in range(20)]
    # Without an effect the share is near 0 on the mean, and p is spread over 0 to 1.
    assert np.mean([one for one, _ in shares]) < 0.05
    assert 0.3 < np.mean([p for _, p in shares]) < 0.7
    assert share_of_variance(np.zeros(5), rng.standard_normal(5)) == (0.0, 1.0)


def make_recipes(
    directory: Path, problem: Problem, recipes: Sequence[tuple[Recipe, float]]
) -> Path:
    """A run whose candidates are recipes, each with its V."""
    make_run(directory, problem, ())
    store = Store(directory / "artifacts")
    with Chain(directory / "ledger.jsonl") as chain:
        for number, (recipe, value) in enumerate(recipes, 1):
            source = recipe.source("")
            append_experiment(chain, store, problem, number, "arx", value, 1.0, (), source)
    return directory


def test_importance_of_settings_needs_experiments_of_one_family(
    runs: Path, problem: Problem
) -> None:
    recipes: list[tuple[Recipe, float]] = []
    for number in range(1, 13):
        few = number % 2
        recipe = Recipe("arx", (("na", 2 if few else 8), ("nb", number)), "LeastSquares", ())
        recipes.append((recipe, 0.1 * number if few else 0.01 * number))
    directory = make_recipes(runs / "settings", problem, recipes)
    snapshot = FollowedRun(directory).snapshot()
    text = " ".join(re.sub("<[^>]+>", " ", importance_part(snapshot) or "").split())
    assert re.search(r"arx na 2 12 \d+ % 0\.0\d+", text), text
    assert re.search(r"arx nb 12 12 \d+ % 0\.[1-9]", text), text
    made = FollowedRun(runs / "made").snapshot()
    assert importance_part(made) is None


def test_too_few_experiments_for_the_importance_of_settings_are_counted(
    runs: Path, problem: Problem
) -> None:
    recipe = Recipe("arx", (("na", 2),), "LeastSquares", ())
    make_recipes(runs / "few", problem, [(recipe, 0.1)])
    part = importance_part(FollowedRun(runs / "few").snapshot())
    assert "Missing: arx 11 more." in (part or "")


def test_settings_that_differ_are_compared(
    client: TestClient, runs: Path, problem: Problem
) -> None:
    recipes = [Recipe("arx", (("na", na), ("nb", 4)), "LeastSquares", ()) for na in (2, 8)]
    make_recipes(runs / "other", problem, [(recipes[0], 0.1), (recipes[1], 0.08)])
    page = client.get("/compare?e=other/1&e=other/2&e=made/1").text
    start = r'<tr(?: class="same")?><th scope="row">'
    row = start + r"(\w[\w ]*)</th>(.*?)</tr>"
    found = {name: re.findall(r"<td>([^<]*)<", cells) for name, cells in re.findall(row, page)}
    assert found["na"] == ["2", "8", ""]
    assert found["training method"] == ["LeastSquares", "LeastSquares", "own code"]
    page = client.get("/compare?e=other/1&e=other/2").text
    assert re.findall(r'<tr class="same"><th scope="row">([\w ]+)<', page) == [
        "family", "training method", "nb",
    ]  # fmt: skip
    assert 'id="settings"' not in client.get("/compare?e=other/1").text


def test_values_that_differ_a_little_read_differently(
    client: TestClient, runs: Path, problem: Problem
) -> None:
    make_run(runs / "near", problem, (("one", 0.12341), ("two", 0.12343), ("three", 0.2)))
    rows = client.get("/runs/near/rows").text
    assert re.findall(r'class="value">(0\.\d+)<', rows) == ["0.20000", "0.12343", "0.12341"]
    page = client.get("/compare?e=near/1&e=near/2").text
    assert {"0.12343", "0.12341"} <= set(re.findall(r"<td>(0\.\d+)<", page))


def test_the_gallery_has_the_simulation_of_each_scored_experiment(client: TestClient) -> None:
    page = client.get("/runs/made/simulations").text
    titles = r'<p><a href="/runs/made/experiments/(\d)"'
    assert re.findall(titles, page) == ["2", "4", "1"]
    assert "1 to 3 of 3" in page
    later = client.get("/runs/made/simulations?order=oldest&after=1").text
    assert (re.findall(titles, later), "‹ previous" in later) == (["2", "4"], True)
    none = client.get("/runs/made/simulations?kind=failed").text
    assert "No chosen experiment has a score." in none


def test_the_timeline_has_a_bar_for_each_experiment(client: TestClient) -> None:
    part = client.get("/runs/made/sections/timeline").text
    bars = re.findall(r'class="bar (\w+) experiment-(\d)"', part)
    assert sorted(bars, key=lambda bar: bar[1]) == [
        ("kept", "1"), ("kept", "2"), ("failed", "3"), ("other", "4"),
    ]  # fmt: skip


def test_the_timeline_has_the_date_and_time_of_its_begin_and_end(
    client: TestClient, runs: Path
) -> None:
    lines = FollowedRun(runs / "made").snapshot().run.lines
    times = [one.time for one in lines if isinstance(one.event, Proposed | Evaluated)]
    part = re.sub(r"<[^>]*>", "", client.get("/runs/made/sections/timeline").text)
    first, last = (f"{one[:10]} {one[11:19]}" for one in (times[0], times[-1]))
    assert f"From {first} to {last} UTC." in part


def test_costs_of_commands_are_axes_of_the_trade_off_picture(
    client: TestClient, runs: Path
) -> None:
    directory = runs / "made"
    norm = {"kind": "H-infinity norm"}
    for name, model, bounds in (("", "refit", (2.0, 3.5)), ("-1", "experiment 1", (1.25,))):
        statements = [{**norm, "bound": bound} for bound in bounds]
        content = {"model": model, "statements": [*statements, {"kind": "stability"}]}
        (directory / f"certificate{name}.json").write_text(json.dumps(content))
        responses = [{"iae": 10 * bound} for bound in bounds]
        (directory / f"control{name}").mkdir()
        content = {"model": model, "responses": responses}
        (directory / f"control{name}" / "control.json").write_text(json.dumps(content))
    (directory / "certificate-4.json").write_text("{}")
    (directory / "certificate-3.json").write_text(json.dumps({"model": "stack", "statements": []}))
    subject = FollowedRun(directory).snapshot().subject
    assert subject.costs == {
        "proven bound of the gain": {1: 1.25, 2: 3.5},
        "cost of the closed loop (IAE)": {1: 12.5, 2: 35.0},
    }
    page = client.get("/runs/made/sections/tradeoff").text
    assert "proven bound of the gain" in page
    assert "cost of the closed loop (IAE)" in page
    compared = client.get("/compare/part?run=made&e=made/1&e=made/4").text
    assert ("12.5" in compared, "proven bound of the gain" in compared) == (True, True)
