"""Published benchmark files, made up in their layout."""

from __future__ import annotations

import os
import zipfile
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

from asia.data import Signal, Trajectory
from asia.data.sources import Channels, Subset
from asia.data.sources.official import LAYOUTS, OfficialBenchmark, PublishedFile
from asia.errors import UserError
from asia.problem.folds import make_folds
from asia.problem.load import load_problem
from asia.testing import check_source
from tests.official_data import WRITERS

SHAPES = {
    "cascaded_tanks": (1, 1, 4.0),
    "ced": (2, 2, 0.02),
    "emps": (1, 1, 0.001),
    "silverbox": (8, 3, 1 / 610.35),
    "wiener_hammerstein": (1, 1, 1 / 51_200),
    "fine_steering_mirror": (18, 9, 1 / 6_400),
    "parallel_wiener_hammerstein": (100, 5, 1 / 78_125),
    "f16": (8, 6, 1 / 400),
}


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder for made-up files, which no digest refuses."""
    monkeypatch.setenv("ASIA_DATA_DIR", str(tmp_path))
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr(PublishedFile, "is_digest", lambda self, found: True)
    tanks = replace(LAYOUTS["cascaded_tanks"], digests={})
    monkeypatch.setitem(LAYOUTS, "cascaded_tanks", tanks)
    return tmp_path / "nonlinear_benchmarks"


def channels(name: str) -> Channels:
    width = 3 if name == "fine_steering_mirror" else 1
    signals = tuple(Signal(f"s{k}") for k in range(width))
    return Channels(signals, signals, SHAPES[name][2])


def records(name: str, subset: Subset) -> tuple[Trajectory, ...]:
    source = OfficialBenchmark(f"benchmark:{name}")
    return source.records(subset, channels(name)).trajectories


@pytest.mark.parametrize("name", list(LAYOUTS))
def test_every_benchmark_is_a_source(name: str, files: Path) -> None:
    WRITERS[name](files.parent)
    check_source(lambda: OfficialBenchmark(f"benchmark:{name}"), channels(name))
    train, test, _ = SHAPES[name]
    assert (len(records(name, "train")), len(records(name, "test"))) == (train, test)


def test_the_first_400_samples_of_the_drives_train(files: Path) -> None:
    WRITERS["ced"](files.parent)
    found = loadmat(files / "CED" / "DATAUNIF.MAT")
    train, test = records("ced", "train"), records("ced", "test")
    assert [t.name for t in train] == ["low", "high"]
    for k, (first, last) in enumerate(zip(train, test, strict=True), 1):
        assert np.array_equal(np.concatenate([first.y, last.y]), found[f"z1{k}"])
        assert (len(first), len(last)) == (400, 100)
    folds = make_folds(train, load_problem("ced").protocol)
    spans = [[(b.start, b.stop) for b in fold.held_out] for fold in folds]
    assert spans == [[(300, 350)] * 2, [(350, 400)] * 2]
    assert [len(fold.train[0]) for fold in folds] == [290, 340]


def test_the_silverbox_is_cut_in_the_gaps_between_realisations(files: Path) -> None:
    WRITERS["silverbox"](files.parent)
    whole = loadmat(files / "Silverbox" / "SilverboxFiles" / "SNLS80mV.mat")
    train, test = records("silverbox", "train"), records("silverbox", "test")
    u = whole["V1"][0]
    assert np.array_equal(np.concatenate([t.u[:, 0] for t in train]), u[40_650:105_712])
    borders = 40_650 + np.cumsum([len(t) for t in train])[:-1]
    after = 40_986 + 8_692 * np.arange(1, 8)
    assert (borders < after).all()
    assert (borders >= after - 500).all()
    assert [len(t) for t in test] == [21_688, 40_475, 32_000]
    assert [t.name for t in test] == ["multisine", "arrow_full", "arrow_no_extrapolation"]
    assert np.array_equal(test[0].u[:, 0], u[105_712:127_400])
    assert np.array_equal(test[2].y, test[1].y[:32_000])


def test_the_split_of_wiener_and_hammerstein(files: Path) -> None:
    WRITERS["wiener_hammerstein"](files.parent)
    whole = loadmat(files / "WienerHammerBenchMark" / "WienerHammerBenchMark.mat")["uBenchMark"]
    (train,), (test,) = (records("wiener_hammerstein", s) for s in ("train", "test"))
    assert np.array_equal(train.u, whole[5_200:105_200])
    assert np.array_equal(test.u, whole[105_200:184_000])


@pytest.mark.parametrize("name", ["parallel_wiener_hammerstein", "fine_steering_mirror"])
def test_periods_follow_each_other(name: str, files: Path) -> None:
    WRITERS[name](files.parent)
    for record in (*records(name, "train"), *records(name, "test")):
        half = len(record) // 2
        assert np.array_equal(record.u[:half], record.u[half:])
        assert not np.array_equal(record.u[0::2], record.u[1::2])
        spread = record.y.std(axis=0)
        assert np.all(np.abs(record.y[:half] - record.y[half:]) < 0.2 * spread)


def test_records_of_the_parallel_circuit_have_their_own_phase_and_amplitude(files: Path) -> None:
    WRITERS["parallel_wiener_hammerstein"](files.parent)
    found = loadmat(files / "ParWH" / "ParWHFiles" / "ParWHData.mat")
    byname = {t.name: t for t in records("parallel_wiener_hammerstein", "train")}
    assert np.array_equal(byname["phase03_amplitude5"].y[:64, 0], found["yEst"][:, 0, 2, 4])
    assert np.array_equal(byname["phase03_amplitude5"].y[64:, 0], found["yEst"][:, 1, 2, 4])


def test_levels_in_between_are_the_test_of_the_aircraft(files: Path) -> None:
    WRITERS["f16"](files.parent)
    train, test = records("f16", "train"), records("f16", "test")
    assert [t.name for t in test][:3] == [f"FullMSine_Level{k}" for k in (2, 4, 6)]
    assert {t.name[-1] for t in train} == set("1357")


@pytest.mark.parametrize("name", list(LAYOUTS))
def test_folds_hold_out_whole_realisations(name: str, files: Path) -> None:
    """Realisations with the same excitation, at other amplitudes or in the other period, are held
    out together."""
    WRITERS[name](files.parent)
    problem = load_problem(name)
    folds = make_folds(problem.train, problem.protocol)
    if problem.protocol.folds.kind == "leave_one_group_out":
        for fold in folds:
            held = {b.name.split("_")[0] for b in fold.held_out}
            assert not {b.name for b in fold.held_out} & {t.name for t in fold.train}
            if name == "parallel_wiener_hammerstein":
                assert not held & {t.name.split("_")[0] for t in fold.train}
    share = sum(len(t) for t in folds[0].train) / sum(len(t) for t in problem.train)
    assert share > 0.45


def test_other_bytes_are_refused(files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    WRITERS["silverbox"](files.parent)
    monkeypatch.undo()
    monkeypatch.setenv("ASIA_DATA_DIR", str(files.parent))
    with pytest.raises(UserError, match="not the published file"):
        records("silverbox", "train")


def test_a_file_without_a_known_digest_is_taken_with_a_word(files: Path) -> None:
    WRITERS["ced"](files.parent)
    source = OfficialBenchmark("benchmark:ced")
    (warning,) = source.records("train", channels("ced")).warnings
    assert "no published digest" in warning
    WRITERS["silverbox"](files.parent)
    silverbox = OfficialBenchmark("benchmark:silverbox")
    assert silverbox.records("train", channels("silverbox")).warnings == ()


def test_a_pointer_of_git_lfs_is_named(files: Path) -> None:
    WRITERS["fine_steering_mirror"](files.parent)
    path = files / "FineSteeringMirror" / "u_200mV_train.npy"
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n")
    with pytest.raises(UserError, match="pointer of git-lfs"):
        records("fine_steering_mirror", "train")


def test_a_missing_file_says_where_to_put_it(files: Path) -> None:
    with pytest.raises(UserError, match=r"\$ASIA_DATA_DIR/nonlinear_benchmarks/CED/DATAUNIF.MAT"):
        records("ced", "train")


def test_a_file_of_another_layout_is_refused(files: Path) -> None:
    from scipy.io import savemat

    WRITERS["wiener_hammerstein"](files.parent)
    path = files / "WienerHammerBenchMark" / "WienerHammerBenchMark.mat"
    savemat(path, {"uBenchMark": np.ones(10), "yBenchMark": np.ones(10), "fs": 1.0})
    with pytest.raises(UserError, match="not laid out as wiener_hammerstein"):
        records("wiener_hammerstein", "train")
    savemat(path, {"u": np.ones(10)})
    with pytest.raises(UserError, match="not laid out as wiener_hammerstein"):
        records("wiener_hammerstein", "train")


def test_a_download_is_kept_only_with_its_digest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import hashlib

    from asia.data.sources.official import check_files

    served = tmp_path / "served.npy"
    served.write_bytes(b"numbers")
    digest = hashlib.sha256(b"numbers").hexdigest()
    right = PublishedFile("a.npy", digest, served.as_uri())
    assert check_files("made_up", tmp_path / "cache", [right], "its page") == ()
    assert (tmp_path / "cache" / "a.npy").read_bytes() == b"numbers"
    wrong = PublishedFile("b.npy", "0" * 64, served.as_uri())
    with pytest.raises(UserError, match="holds other bytes"):
        check_files("made_up", tmp_path / "cache", [wrong], "its page")
    assert [p.name for p in (tmp_path / "cache").iterdir()] == ["a.npy"]


def test_a_file_in_an_archive_is_downloaded_and_its_records_are_checked(
    files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tanks = LAYOUTS["cascaded_tanks"]
    made, archive = files.parent / "made", files.parent / "served.zip"
    WRITERS["cascaded_tanks"](made)
    source = next(made.rglob("dataBenchmark.mat"))
    with zipfile.ZipFile(archive, "w") as stream:
        stream.write(source, tanks.train[0].path)
    served = (replace(tanks.train[0], url=archive.as_uri()),)
    monkeypatch.setitem(LAYOUTS, "cascaded_tanks", replace(tanks, train=served))
    (record,) = records("cascaded_tanks", "train")
    assert np.array_equal(record.u, loadmat(source)["uEst"])
    checked = replace(LAYOUTS["cascaded_tanks"], digests={"train": "0" * 64})
    monkeypatch.setitem(LAYOUTS, "cascaded_tanks", checked)
    with pytest.raises(UserError, match="are not the published ones"):
        records("cascaded_tanks", "train")
    archive.write_bytes(b"no archive")
    next((files.parent / "home").rglob("dataBenchmark.mat")).unlink()
    with pytest.raises(UserError, match="the download failed"):
        records("cascaded_tanks", "train")


@pytest.mark.data
@pytest.mark.skipif(not os.environ.get("ASIA_DATA_DIR"), reason="ASIA_DATA_DIR is not set")
@pytest.mark.parametrize(
    "source", ["benchmark:cascaded_tanks", "nonlinear_benchmarks:Cascaded_Tanks"]
)
def test_the_published_tanks_are_known(source: str) -> None:
    for subset in ("train", "test"):
        found = OfficialBenchmark(source).records(subset, channels("cascaded_tanks"))
        assert [len(t) for t in found.trajectories] == [1024]
        assert found.warnings == ()


@pytest.mark.parametrize("name", list(LAYOUTS))
def test_each_figure_names_test_records(name: str, files: Path) -> None:
    WRITERS[name](files.parent)
    rule = load_problem(name).protocol.test
    names = [t.name for t in records(name, "test")]
    matched = [
        [n for n in names if any(fnmatchcase(n, p) for p in f.records)] for f in rule.figures
    ]
    assert all(matched)
    assert sorted(n for own in matched for n in own) == (sorted(names) if rule.figures else [])
