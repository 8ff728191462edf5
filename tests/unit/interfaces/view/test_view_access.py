"""Permission to read pages and to steer a search."""

from __future__ import annotations

import json
import os
import signal
import stat
import time
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from asia.interfaces.view.app import kept_token, token_path
from asia.ledger.chain import Chain
from asia.ledger.run import open_run

from .conftest import TOKEN

ADDRESSES = ("/", "/events", "/runs/made", "/runs/made/curve", "/runs/made/rows", "/static/view.js")


@pytest.mark.parametrize("address", ADDRESSES)
def test_nothing_is_shown_without_the_token(stranger: TestClient, address: str) -> None:
    answer = stranger.get(address)
    assert answer.status_code == 401
    assert "open the address that asia view printed" in answer.text
    assert stranger.get(address, params={"token": "another"}).status_code == 401
    stranger.cookies.set("asia-view-8731", "another")
    assert stranger.get(address).status_code == 401


def test_the_token_leaves_the_address_for_a_cookie(stranger: TestClient) -> None:
    answer = stranger.get(f"/runs/made?token={TOKEN}&x=1%262")
    assert answer.headers["location"] == "/runs/made?x=1%262"
    cookie = answer.headers["set-cookie"].lower()
    assert "httponly" in cookie
    assert "samesite=strict" in cookie
    assert stranger.get("/runs/made").status_code == 200


def test_an_address_with_the_token_leads_to_no_other_host(stranger: TestClient) -> None:
    answer = stranger.get(f"http://127.0.0.1:8731//other.example/?token={TOKEN}")
    assert answer.headers["location"].startswith("/other.example")


@pytest.mark.parametrize("host", ["asia.example", "asia.example:8731", "127.0.0.1:9999", ""])
def test_another_host_is_refused_with_the_token_too(client: TestClient, host: str) -> None:
    """A name of another host may be made to mean this machine."""
    assert client.get("/", headers={"host": host}).status_code == 421
    assert client.get("/", headers={"host": "localhost:8731"}).status_code == 200


def post_start(client: TestClient, **fields: object) -> Any:
    """Ask for a search; the page sends all fields as text."""
    given = {"problem": "two_tanks_sim", "agent": "expert", "experiments": 1, "seed": 0, **fields}
    headers = {"x-asia-token": TOKEN, "origin": "http://127.0.0.1:8731"}
    return client.post("/runs", content=json.dumps(given), headers=headers)


def test_a_start_needs_the_token_in_its_header_and_the_own_origin(
    client: TestClient, runs: Path
) -> None:
    body = json.dumps({"problem": "two_tanks_sim", "agent": "expert", "experiments": 1, "seed": 0})
    foreign = {"x-asia-token": TOKEN, "origin": "http://other.example"}
    far = {"x-asia-token": TOKEN, "host": "asia.example:8731"}
    for headers, status in (({}, 403), (foreign, 403), (far, 421)):
        assert client.post("/runs", content=body, headers=headers).status_code == status
    assert [path.name for path in runs.iterdir()] == ["made"]


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"problem": "/etc"}, "one of the listed problems"),
        ({"agent": "command:sh"}, "an agent (expert, random, bayes)"),
        ({"experiments": 0}, "at least 1 experiment"),
        ({"seed": "x"}, "a seed of at least 0"),
        ({"name": "../elsewhere"}, "'../elsewhere' is no name of a run"),
    ],
)
def test_a_start_that_asia_run_refuses_is_refused_with_a_reason(
    client: TestClient, runs: Path, fields: dict[str, object], words: str
) -> None:
    answer = post_start(client, **fields)
    assert (answer.status_code, words in answer.json()["words"]) == (409, True), answer.text
    assert [path.name for path in runs.iterdir()] == ["made"]


def test_a_start_on_a_run_that_is_running_is_refused(client: TestClient, runs: Path) -> None:
    with Chain(runs / "made" / "ledger.jsonl"):
        answer = post_start(client, name="made")
    assert (answer.status_code, "is running" in answer.json()["words"]) == (409, True)


@pytest.mark.slow
def test_a_search_starts_from_the_page_as_a_process_of_its_own(
    client: TestClient, runs: Path
) -> None:
    answer = post_start(client, experiments=50, name="from-the-page")
    assert (answer.status_code, answer.json()["address"]) == (200, "/runs/from-the-page")
    run = open_run(runs / "from-the-page")
    assert (run.state, run.view.budget, run.view.started.agent) == ("running", 50, "expert")
    assert post_start(client, name="from-the-page").status_code == 409
    other = post_start(client, name="made").json()["words"]
    assert other.startswith("the search did not start: ")
    words = str(runs.resolve()).encode()
    commands = Path("/proc").glob("[0-9]*/cmdline")
    (pid,) = (
        int(path.parent.name)
        for path in commands
        if b"from-the-page\0" in (line := path.read_bytes()) and words in line
    )
    os.kill(pid, signal.SIGTERM)
    while open_run(run.directory).state == "running":
        time.sleep(0.1)


@pytest.mark.parametrize("what", ["steer", "pause", "continue", "stop"])
def test_a_word_to_the_search_needs_the_token_in_its_header(
    client: TestClient, runs: Path, what: str
) -> None:
    """The cookie, which a browser sends by itself, is not enough."""
    address = f"/runs/made/{what}"
    assert client.post(address, content="try a delay").status_code == 403
    assert client.post(address, headers={"x-asia-token": "another"}).status_code == 403
    foreign = {"x-asia-token": TOKEN, "origin": "http://other.example"}
    assert client.post(address, headers=foreign).status_code == 403
    assert not (runs / "made" / "control").exists()


def test_every_answer_forbids_content_from_elsewhere(client: TestClient) -> None:
    for address in (*ADDRESSES[2:], "/runs/none", "/nowhere"):
        headers = client.get(address).headers
        policy = headers["content-security-policy"]
        assert policy.startswith("default-src 'none'; script-src 'self'; style-src 'self';")
        assert "http" not in policy
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["referrer-policy"] == "no-referrer"
        assert headers["cache-control"] == "no-store"


def test_the_token_is_kept_for_its_owner_alone(tmp_path: Path) -> None:
    first = kept_token(tmp_path)
    assert len(first) > 40
    assert kept_token(tmp_path) == first
    assert not any(tmp_path.iterdir())
    assert stat.S_IMODE(token_path(tmp_path).stat().st_mode) == 0o600
    other = tmp_path / "other"
    other.mkdir()
    assert kept_token(other) != first


def test_a_token_in_the_folder_of_runs_is_not_adopted(tmp_path: Path) -> None:
    (tmp_path / ".view-token").write_text("a" * 43)
    assert kept_token(tmp_path) != "a" * 43


def test_a_token_that_others_may_write_or_that_is_a_link_is_not_adopted(tmp_path: Path) -> None:
    first = kept_token(tmp_path)
    token_path(tmp_path).chmod(0o666)
    second = kept_token(tmp_path)
    assert second != first
    (tmp_path / "planted").write_text("a" * 43)
    token_path(tmp_path).unlink()
    token_path(tmp_path).symlink_to(tmp_path / "planted")
    assert kept_token(tmp_path) not in (first, second, "a" * 43)
    assert (tmp_path / "planted").read_text() == "a" * 43


def test_a_token_that_cannot_be_kept_is_a_new_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "file"))
    assert len(kept_token(tmp_path)) > 40
    assert kept_token(tmp_path) != kept_token(tmp_path)
