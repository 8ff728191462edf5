import pytest

from asia.candidate import check_source, executed_source, imported_libraries, source_digest
from asia.errors import CandidateError, Reason
from asia.recipe import read_recipe

PLAIN = "def fit(trajectories, context):\n    return 1\n"


@pytest.mark.parametrize(
    "source",
    [
        PLAIN,
        "from somewhere import train as fit",
        "fit = lambda t, c: None",
        "a, (fit, b) = 1, (2, 3)",
        "fit: object = len",
        "class fit:\n    pass",
        "try:\n    from fast import fit\nexcept ImportError:\n    def fit(t, c):\n        return 1",
        "if True:\n    def fit(t, c):\n        return 1",
    ],
)
def test_sources_that_bind_fit_are_accepted(source: str):
    check_source(source)


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("def fit(:\n", Reason.SYNTAX),
        ("def fit(t, c):\n\treturn 1\n        x", Reason.SYNTAX),
        ("x = 1\0", Reason.SYNTAX),
        ("x = '\ud800'", Reason.SYNTAX),
        ("fit = " + "-" * 20000 + "1", Reason.SYNTAX),
        ("fit = " + "(" * 5000 + ")" * 5000, Reason.SYNTAX),
        ("#" * (64 * 1024) + "\n" + PLAIN, Reason.SOURCE_SIZE),
        ("", Reason.CONTRACT),
        ("def train(t, c):\n    def fit(): pass", Reason.CONTRACT),
        ("class Model:\n    def fit(self): pass", Reason.CONTRACT),
        ("fit: object", Reason.CONTRACT),
    ],
)
def test_other_sources_are_refused_with_their_reason(source: str, reason: Reason):
    with pytest.raises(CandidateError) as caught:
        check_source(source)
    assert caught.value.reason is reason
    assert caught.value.detail


def test_checking_executes_nothing(tmp_path):
    mark = tmp_path / "ran"
    check_source(f"open({str(mark)!r}, 'w')\n{PLAIN}")
    assert not mark.exists()


def test_digest_ignores_comments_docstrings_and_layout():
    dressed = (
        '"""About."""\n# why\n\ndef fit( trajectories,\n        context ):\n'
        '    """Fit."""\n    return (1)  # one\n'
    )
    assert source_digest(dressed) == source_digest(PLAIN)
    assert len(source_digest(PLAIN)) == 64


@pytest.mark.parametrize(
    "other", [PLAIN.replace("1", "2"), PLAIN.replace("context", "c"), PLAIN + "x = 'text'\n"]
)
def test_digest_tells_different_code_apart(other: str):
    assert source_digest(other) != source_digest(PLAIN)


@pytest.mark.parametrize(
    "code",
    [
        "x = 0x" + "f" * 3600,
        "x = 0b" + "1" * 15000,
        "x = " + "9" * 4301,
        "x = " + "-" * 20000 + "1",
        "x = a" + ".b" * 20000,
        "x = " + " + ".join("a" * 1000),
        "x = " + "1 if a else " * 3000 + "1",
        "if a:\n    pass\n" + "elif a:\n    pass\n" * 2500,
    ],
    ids=["hex", "binary", "decimal", "signs", "attributes", "sum", "choices", "branches"],
)
def test_sources_that_python_cannot_walk_are_refused_in_a_sentence(code: str):
    source = f"{PLAIN}{code}\n"
    for part in (check_source, source_digest, executed_source):
        with pytest.raises(CandidateError, match=r"nested too deeply|4300 digits") as caught:
            part(source)
        assert caught.value.reason is Reason.SYNTAX
    assert read_recipe(source) is None
    assert not imported_libraries(source, fitting=True)


def test_the_deepest_source_that_is_accepted_has_a_digest_and_compiles():
    source = PLAIN + "x = " + " + ".join(["a"] * 190) + "\n"
    check_source(source)
    assert source_digest(source) != source_digest(PLAIN)
    compile(executed_source(source), "candidate.py", "exec")
