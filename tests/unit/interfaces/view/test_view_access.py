"""Permission to read pages and to steer a search."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from asia.interfaces.view.app import kept_token, token_path

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
