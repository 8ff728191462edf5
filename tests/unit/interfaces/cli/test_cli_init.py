import sys
from pathlib import Path

import pytest

from asia.errors import UserError
from asia.interfaces.cli import spread
from asia.problem.load import load_problem

from .conftest import Asia

SIGNALS = ("--inputs", "u", "--outputs", "y", "--sampling-time", "0.5")


@pytest.fixture
def data(problem: Path, tmp_path: Path) -> tuple[str, str]:
    """Two records beside the future problem."""
    for name in ("train", "test"):
        (problem / f"{name}.csv").rename(tmp_path / f"{name}.csv")
    return "train.csv", "test.csv"


def test_words_after_a_list_option_belong_to_it() -> None:
    words = ["init", "new", "--train", "a.csv", "b.csv", "--inputs", "u", "--sampling-time", "1"]
    assert spread(words) == [
        *("init", "new", "--train", "a.csv", "--train", "b.csv"),
        *("--inputs", "u", "--sampling-time", "1"),
    ]
    joined = ["init", "new", "--train=a.csv", "b.csv", "--inputs=u", "--no-seal", "c"]
    assert spread(joined) == [
        *("init", "new", "--train=a.csv", "--train", "b.csv"),
        *("--inputs=u", "--no-seal", "c"),
    ]
    assert spread(["show", "--train", "a", "b"]) == ["show", "--train", "a", "b"]


def test_a_second_value_after_an_option_is_refused() -> None:
    with pytest.raises(UserError, match=r"'b=2' belongs to no option: .* write --at a=1,b=2"):
        spread(["linear", "run", "--at", "a=1", "b=2"])
    for words in (["linear", "--at", "a=1", "--at", "b=2"], ["linear", "--at", "a=1", "run"]):
        assert spread(words) == words
    # An option that takes several words has them.
    named = ["validate", "run", "--columns", "u=a", "--columns", "y=b"]
    assert spread(["validate", "run", "--columns", "u=a", "y=b"]) == named


def test_several_records_and_back(data: tuple[str, str], asia: Asia) -> None:
    done = asia("init", "new", "--train", *data, "--no-seal", *SIGNALS)
    assert done.code == 0, done.err
    assert "no test data. --seal holds out the last 20 % of each record" in done.out
    assert "asia check new" in done.out
    loaded = load_problem("new")
    assert loaded.name == "new"
    assert [len(t) for t in loaded.train] == [240, 120]
    assert loaded.sampling_time == 0.5
    checked = asia("check", "new", "--no-draw")
    assert checked.code == 0, checked.err
    assert "record train: 240 samples" in checked.out
    assert "test: none" in checked.out


def test_several_records_after_an_equals_sign(data: tuple[str, str], asia: Asia) -> None:
    done = asia("init", "new", f"--train={data[0]}", data[1], "--no-seal", *SIGNALS)
    assert done.code == 0, done.err
    assert [len(t) for t in load_problem("new").train] == [240, 120]


def test_named_test_is_sealed(data: tuple[str, str], asia: Asia) -> None:
    done = asia("init", "new", "--train", data[0], "--test", data[1], *SIGNALS)
    assert done.code == 0, done.err
    assert "no test data" not in done.out
    assert "test (120 samples, 110 scored)" in asia("check", "new", "--no-draw").out


def test_last_fifth_is_sealed(data: tuple[str, str], asia: Asia, tmp_path: Path) -> None:
    done = asia("init", "new", "--train", data[0], "--seal", "--keys", "keys", *SIGNALS)
    assert done.code == 0, done.err
    assert "the last 20 % of each record" in done.out
    assert f"the test rows are also in {data[0]}, unencrypted" in done.out
    assert "removed" not in done.out
    rows = (tmp_path / data[0]).read_text().splitlines()[1:]
    kept = (tmp_path / "new" / "train_train.csv").read_text().splitlines()[1:]
    numbers = [[float(cell) for cell in row.split(",")] for row in rows]
    assert [[float(cell) for cell in row.split(",")] for row in kept] == numbers[:192]
    assert repr(numbers[200][0]).encode() not in (tmp_path / "new" / "test.sealed").read_bytes()
    assert len(load_problem("new").train[0]) == 192


def test_a_test_file_is_moved_into_the_store(
    data: tuple[str, str], asia: Asia, tmp_path: Path
) -> None:
    words = ("init", "new", "--train", data[0], "--test", data[1], "--seal", *SIGNALS)
    inside = asia(*words, "--keys", "new/keys")
    assert inside.code == 2
    assert "in the problem's directory" in inside.err
    assert (tmp_path / data[1]).exists()
    shown = asia(*words, "--keys", str(Path(sys.prefix) / "keys"))
    assert shown.code == 2
    assert "which every candidate can read" in shown.err
    assert (tmp_path / data[1]).exists()
    done = asia(*words, "--keys", "keys")
    assert done.code == 0, done.err
    assert f"set ASIA_KEYS={tmp_path / 'keys'}" in done.out
    assert f"removed  {tmp_path / data[1]}" in done.out
    assert "may keep copies of these files" in done.out
    (key,) = (tmp_path / "keys").iterdir()
    assert f"key      {key}" in done.out
    assert not (tmp_path / data[1]).exists()
    checked = asia("check", "new", "--no-draw").out
    assert "test (120 samples, 110 scored)" in checked
    assert "test kept: encrypted" in checked


def test_a_test_file_that_stays_plain_is_told(data: tuple[str, str], asia: Asia) -> None:
    done = asia("init", "new", "--train", data[0], "--test", data[1], *SIGNALS)
    assert "the test files are not encrypted" in done.out
    assert "test kept: in plain files" in asia("check", "new", "--no-draw").out


@pytest.mark.parametrize("value", ["0", "-60", "nan", "inf"])
def test_bad_sampling_time_is_refused_first(problem: Path, asia: Asia, value: str) -> None:
    signals = ("--inputs", "u", "--outputs", "y", "--sampling-time", value)
    done = asia("init", "new", "--train", "missing.csv", "--no-seal", *signals)
    assert done.code == 2
    assert done.err == f"asia: --sampling-time is {value}: expected a number of seconds above 0\n"


def test_help_of_sampling_time_states_no_wrong_range(asia: Asia) -> None:
    text = asia("init", "--help").out
    assert "x>=0" not in text
    assert "above 0" in text


def test_nothing_is_overwritten(data: tuple[str, str], asia: Asia, problem: Path) -> None:
    before = (problem / "problem.toml").read_text()
    done = asia("init", "toy", "--train", data[0], *SIGNALS)
    assert done.code == 2
    assert "nothing is overwritten" in done.err
    assert (problem / "problem.toml").read_text() == before


def test_wrong_column_writes_nothing(data: tuple[str, str], asia: Asia, tmp_path: Path) -> None:
    done = asia("init", "new", "--train", data[0], *SIGNALS[:3], "level", *SIGNALS[4:])
    assert done.code == 2
    assert done.err.startswith("asia: ")
    assert "'level'" in done.err
    assert not (tmp_path / "new").exists()


def test_an_ugly_log_becomes_a_clean_problem(
    asia: Asia, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    lines = [f"{k / 10:.1f};{(k * 7 % 11) / 2};{(k * 3 % 17) / 4}" for k in range(300)]
    text = "\n".join(["Zeit [s];Pumpe [V];Stand [m]", *lines[:140], *lines[150:]])
    (tmp_path / "log.txt").write_text(text.replace(".", ","), encoding="utf-16")
    words = ("init", "new", "--train", "log.txt", "--inputs", "Pumpe", "--outputs", "Stand")
    done = asia(*words, "--no-seal")
    assert done.code == 0, done.err
    assert "2 training and 0 test records, sampled every 0.1 s" in done.out
    assert "1 gap in time" in done.out
    loaded = load_problem("new")
    assert [(t.name, len(t)) for t in loaded.train] == [("log_1", 140), ("log_2", 150)]
    assert [s.label for s in (*loaded.inputs, *loaded.outputs)] == ["Pumpe [V]", "Stand [m]"]
    assert (
        "# made by asia init from log.txt, sha256 " in (tmp_path / "new/problem.toml").read_text()
    )
    sealed = asia("init", "other", *words[2:], "--seal", "--keys", "keys")
    assert sealed.code == 0, sealed.err
    assert [len(t) for t in load_problem("other").train] == [112, 120]
    (tmp_path / "bad.csv").write_text("t,u,y\n0,1,2\n0,1,2\n")
    refused = asia("init", "bad", "--train", "bad.csv", "--inputs", "u", "--outputs", "y")
    assert refused.code == 2
    assert "the time stamp repeats" in refused.err


def test_a_clean_log_stays_where_it_is(
    asia: Asia, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    lines = [f"{k / 10:.1f},{k % 7},{k % 11}" for k in range(100)]
    (tmp_path / "log.csv").write_text("\n".join(["t,u,y", *lines]))
    words = ("init", "new", "--train", "log.csv", "--inputs", "u", "--outputs", "y", "--no-seal")
    assert asia(*words).code == 0
    assert sorted(p.name for p in (tmp_path / "new").iterdir()) == [
        "description.md",
        "problem.toml",
    ]
    assert load_problem("new").sampling_time == 0.1
