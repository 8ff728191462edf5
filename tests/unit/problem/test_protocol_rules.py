"""Windows, groups of records and the table of the test: what fits together and what does not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from asia.errors import UserError
from asia.problem.check import check_problem
from asia.problem.load import load_lock, load_problem
from asia.problem.lock import lock_differences, lock_text, protocol_digest
from asia.problem.problem import Seal
from asia.problem.protocol import FoldRule, Group, OutputGroup

Record = Callable[[int, int], str]

HEAD = 'sampling_time = 0.1\ninputs = ["u"]\noutputs = ["y"]\n'
DATA = '[data]\ntrain = ["slow_1.csv", "slow_2.csv", "fast_1.csv"]\n'
GROUPS = '[data.groups]\nslow = ["slow_*"]\nfast = ["fast_1"]\n'
PROTOCOL = (
    '[protocol]\nkind = "windows"\nhorizon = 20\nfolds = { kind = "leave_one_group_out" }\n'
    'past_inputs = 0\npast_outputs = 1\nmetric = "mae"\n'
)
TEST = (
    '[protocol.test]\nmetrics = ["mae", "mee"]\nhorizons = [5, 20]\n'
    '[protocol.test.groups]\nlevel = ["y"]\n'
)
WINDOWS = HEAD + DATA + GROUPS + PROTOCOL + TEST


@pytest.fixture
def write(tmp_path: Path, record: Record) -> Callable[[str], Path]:
    """Writes problem.toml beside three records of 61, 50 and 41 samples."""

    def written(toml: str) -> Path:
        for seed, (name, samples) in enumerate((("slow_1", 61), ("slow_2", 50), ("fast_1", 41))):
            (tmp_path / f"{name}.csv").write_text(record(samples, seed))
        (tmp_path / "problem.toml").write_text(toml)
        return tmp_path

    return written


def test_groups_and_table_are_understood(write: Callable[[str], Path]) -> None:
    rule = load_problem(write(WINDOWS)).protocol
    assert (rule.kind, rule.horizon, rule.metric) == ("windows", 20, "mae")
    assert rule.folds.count == 2
    assert rule.folds.groups == (Group("slow", ("slow_1", "slow_2")), Group("fast", ("fast_1",)))
    assert rule.test.groups == (OutputGroup("level", ("y",)),)
    assert rule.test.horizons == (5, 20)


def test_a_rotation_is_written_by_its_angles(write: Callable[[str], Path]) -> None:
    toml = WINDOWS.replace('level = ["y"]', 'R = { roll_pitch_yaw = ["y", "y", "y"] }')
    group = load_problem(write(toml)).protocol.test.groups[0]
    assert group == OutputGroup("R", ("y", "y", "y"), "geodesic")


def test_the_lock_restores_windows_and_groups(write: Callable[[str], Path], tmp_path: Path) -> None:
    turned = 'b = { roll_pitch_yaw = ["y", "y", "y"] }'
    toml = WINDOWS.replace('level = ["y"]', f'a = ["y"]\n{turned}\nc = ["y"]')
    problem = load_problem(
        write(toml.replace("past_inputs", 'early_stopping = "validation"\npast_inputs'))
    )
    path = tmp_path / "problem.lock.toml"
    path.write_text(lock_text(problem, Seal(None)), encoding="utf-8")
    again = load_lock(path)
    assert again.protocol == problem.protocol
    assert again.protocol.early_stopping == "validation"
    assert lock_text(again, Seal(None)) == path.read_text("utf-8")
    assert lock_differences(again, Seal(None), path) == ()


def test_a_changed_group_is_a_difference(write: Callable[[str], Path], tmp_path: Path) -> None:
    path = tmp_path / "problem.lock.toml"
    problem = load_problem(write(WINDOWS))
    path.write_text(lock_text(problem, Seal(None)), encoding="utf-8")
    moved = WINDOWS.replace('["slow_*"]', '["slow_1"]').replace(
        '["fast_1"]', '["fast_1", "slow_2"]'
    )
    found = {str(d) for d in lock_differences(load_problem(write(moved)), Seal(None), path)}
    assert "data.groups.slow was ['slow_1', 'slow_2'], is ['slow_1']" in found
    assert "protocol changed" in found
    path.write_text(path.read_text("utf-8").replace("horizon = 20", "horizon = 19"), "utf-8")
    with pytest.raises(UserError, match=r"horizons names 20, but a window has 19"):
        load_lock(path)


def test_the_digest_of_an_old_protocol_stays(write: Callable[[str], Path]) -> None:
    """Locks written before windows existed still open."""
    plain = load_problem(write(HEAD + '[data]\ntrain = ["slow_1.csv"]\n'))
    assert protocol_digest(plain) == (
        "39666791668a3c0b7053ea087644cc96e3c2c7173c2ac3eb9f9edb1494646e0e"
    )


def test_forward_folds_with_a_gap_are_locked_and_said(
    write: Callable[[str], Path], tmp_path: Path
) -> None:
    folds = 'folds = { kind = "forward", count = 2, gap = 4 }'
    small = f"[protocol]\n{folds}\npast_inputs = 1\npast_outputs = 1\n"
    problem = load_problem(write(f'{HEAD}[data]\ntrain = ["slow_1.csv"]\n{small}'))
    assert problem.protocol.folds == FoldRule("forward", 2, gap=4)
    text = "\n".join(check_problem(problem, Seal(None)).lines())
    assert "fold 1: holds out slow_1 22-41; trains on 16 samples" in text
    path = tmp_path / "problem.lock.toml"
    path.write_text(lock_text(problem, Seal(None)), encoding="utf-8")
    assert load_lock(path).protocol == problem.protocol
    with pytest.raises(UserError, match="2 folds with a past window of 1 and a gap of 40"):
        load_problem(write(f'{HEAD}[data]\ntrain = ["slow_1.csv"]\n{small}'.replace("4 }", "40 }")))


def test_check_lists_held_out_samples(write: Callable[[str], Path]) -> None:
    problem = load_problem(write(WINDOWS))
    text = "\n".join(check_problem(problem, Seal("ab" * 32, ("t",), (62,))).lines())
    for line in (
        "fold 1, slow: holds out 6 windows of slow_1, slow_2; trains on 41 samples",
        "fold 2, fast: holds out 2 windows of fast_1; trains on 111 samples",
        "windows of 20 samples are simulated",
        "test: t (62 samples, 4 windows); 4 windows; mean Euclidean error of level (y)",
    ):
        assert line in text
    assert "early stopping" not in text
    open_fold = WINDOWS.replace("past_inputs", 'early_stopping = "validation"\npast_inputs')
    text = "\n".join(check_problem(load_problem(write(open_fold)), Seal(None)).lines())
    assert "V is not leak-free" in text


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (("horizon = 20\n", ""), "needs protocol.horizon"),
        (
            ('kind = "windows"', 'kind = "simulation"'),
            'protocol.horizon belongs to kind = "windows"',
        ),
        (("horizon = 20", "horizon = 0"), "protocol.horizon is 0, expected at least 1"),
        (
            ("horizon = 20", "horizon = 41"),
            "record 'fast_1' has 41 samples, but a past window of 1",
        ),
        (('_out" }', '_out", count = 2 }'), "protocol.folds.count belongs to contiguous folds"),
        (('folds = { kind = "leave_one_group_out" }\n', ""), "[data.groups] belongs to leave_one"),
        (('_out" }', '_out", gap = 5 }'), "protocol.folds.gap belongs to folds within a record"),
        ((GROUPS, ""), "needs two groups of records or more, [data.groups] has 0"),
        (('fast = ["fast_1"]\n', ""), "needs two groups of records or more, [data.groups] has 1"),
        (('["fast_1"]', '["fats_1"]'), "called 'fats_1'; did you mean 'fast_1'?"),
        (('["fast_1"]', "[]"), "[data.groups] fast is empty"),
        (('["fast_1"]', '["fast_1", "slow_1"]'), "'slow_1' is in groups slow and fast"),
        (('["slow_*"]', '["slow_1"]'), "training record 'slow_2' is in no group"),
        (('metrics = ["mae", "mee"]', 'metrics = ["mae"]'), 'add "mee" to protocol.test.metrics'),
        (('metrics = ["mae", "mee"]', 'metrics = ["mee"]'), 'names "mee" alone'),
        (('level = ["y"]', ""), "say which outputs belong together"),
        (
            ('level = ["y"]', 'level = ["z"]'),
            "[protocol.test.groups] level: there is no output 'z'",
        ),
        (('level = ["y"]', "level = []"), "protocol.test.groups.level"),
        (('level = ["y"]', 'level = { roll_pitch_yaw = ["y"] }'), "protocol.test.groups.level"),
        (("[5, 20]", "[5, 21]"), "protocol.test.horizons names 21, but a window has 20"),
        (("[5, 20]", "[0]"), "protocol.test.horizons[0] is 0, expected at least 1"),
        (("horizons = [5, 20]", "skip = 3"), "every sample of a window counts"),
    ],
)
def test_inconsistent_data_are_refused_in_one_sentence(
    write: Callable[[str], Path], change: tuple[str, str], expected: str
) -> None:
    toml = WINDOWS.replace(*change)
    assert toml != WINDOWS
    with pytest.raises(UserError) as caught:
        load_problem(write(toml))
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_table_needs_windows(write: Callable[[str], Path]) -> None:
    with pytest.raises(UserError, match="the error at each step of a window"):
        load_problem(write(HEAD + '[data]\ntrain = ["slow_1.csv"]\n' + TEST))


def test_contiguous_folds_of_windows_need_long_records(write: Callable[[str], Path]) -> None:
    toml = HEAD + '[data]\ntrain = ["slow_1.csv"]\n'
    toml += '[protocol]\nkind = "windows"\nhorizon = 20\npast_inputs = 1\npast_outputs = 1\n'
    assert load_problem(write(toml)).protocol.horizon == 20
    longer = toml.replace("horizon = 20", "horizon = 30")
    with pytest.raises(UserError, match=r"a horizon of 30 need at least 63: use fewer folds"):
        load_problem(write(longer))
