"""The folder a driver works in: links in it lead nowhere."""

from pathlib import Path

import pytest

from asia._files import write_file
from asia.errors import UserError
from asia.interfaces.workspace.workspace import write_folder
from asia.problem.load import load_problem
from tests.unit.search.toy import write_problem


@pytest.mark.parametrize("link", [".best.py.new", "best.py"])
def test_texts_do_not_go_through_a_link(tmp_path: Path, link: str) -> None:
    outside, folder = tmp_path / "outside", tmp_path / "workspace"
    outside.write_text("mine")
    folder.mkdir()
    (folder / link).symlink_to(outside)
    write_file(folder, "best.py", "written by the agent", mode=0o444)
    assert outside.read_text() == "mine"
    assert (folder / "best.py").read_text() == "written by the agent"
    assert not (folder / "best.py").is_symlink()
    assert (folder / "best.py").stat().st_mode & 0o777 == 0o444


@pytest.mark.parametrize("name", ["data", ".asia"])
def test_folders_do_not_go_through_a_link(tmp_path: Path, name: str) -> None:
    outside, folder = tmp_path / "outside", tmp_path / "workspace"
    outside.mkdir()
    folder.mkdir()
    (folder / name).symlink_to(outside)
    write_folder(folder, load_problem(write_problem(tmp_path / "toy")), 3)
    assert list(outside.iterdir()) == []
    assert list((folder / name).iterdir())


def test_records_do_not_go_through_a_link(tmp_path: Path) -> None:
    outside, folder = tmp_path / "outside", tmp_path / "workspace"
    outside.write_text("mine")
    loaded = load_problem(write_problem(tmp_path / "toy"))
    write_folder(folder, loaded, 3)
    record = next((folder / "data").glob("*.csv"))
    record.unlink()
    record.symlink_to(outside)
    write_folder(folder, loaded, 3)
    assert outside.read_text() == "mine"
    assert record.read_text().startswith("time,")


def test_a_folder_in_the_way_is_moved_aside(tmp_path: Path) -> None:
    (tmp_path / "results.tsv" / "full").mkdir(parents=True)
    write_file(tmp_path, "results.tsv", "here")
    assert (tmp_path / "results.tsv").read_text() == "here"


def test_a_workspace_that_is_a_link_is_refused(tmp_path: Path) -> None:
    (tmp_path / "outside").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "outside")
    with pytest.raises(UserError, match="no link"):
        write_file(tmp_path / "link", "PROGRAM.md", "words")
    assert list((tmp_path / "outside").iterdir()) == []
