import pytest

from asia.agents.llm.reply import MalformedReplyError, read_reply

GOOD = "def fit(trajectories, context):\n    return None\n"


def test_the_form_that_was_asked_for() -> None:
    reply = read_reply(
        "HYPOTHESIS: the valve\n  sticks\nEXPECTED: V below 0.1\nFAMILY: Grey-Box\n"
        f"TITLE: stiction\nPARENT: #3\n```python\n{GOOD}```\n"
    )
    assert reply.source == GOOD
    assert (reply.hypothesis, reply.expected) == ("the valve sticks", "V below 0.1")
    assert (reply.family, reply.title, reply.parent) == ("grey-box", "stiction", 3)
    assert reply.problem == ""


@pytest.mark.parametrize(
    "text",
    [
        f"**Hypothesis:** a\n**Family**: b\n~~~py\n{GOOD}~~~",
        f"### HYPOTHESIS: a\n- Family = `b`\n````\n{GOOD}````\nDone!",
        f"<think>\n```python\nx(\n```\n</think>HYPOTHESIS: a\nfamily: b\n```python\n{GOOD}```",
        "hypothesis: a\nfamily: b\n\nInstall:\n```sh\nls\n```\n"
        f"```python\n{GOOD}```\n```text\nbye\n```",
    ],
)
def test_other_forms(text: str) -> None:
    reply = read_reply(text)
    assert (reply.source, reply.hypothesis, reply.family) == (GOOD, "a", "b")


def test_a_fence_inside_a_longer_one_belongs_to_the_source() -> None:
    source = f'"""Text:\n```\nx\n```\n"""\n{GOOD}'
    assert read_reply(f"````python\n{source}````").source == source


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("", "no fenced python block"),
        ("I would rather not.", "no fenced python block"),
        (f"```python\n{GOOD}", "no closing fence"),
    ],
)
def test_malformed_replies_are_refused(text: str, wrong: str) -> None:
    with pytest.raises(MalformedReplyError, match=wrong):
        read_reply(text)


def test_an_answer_that_was_cut_is_not_taken() -> None:
    with pytest.raises(MalformedReplyError, match="be shorter"):
        read_reply(f"```python\n{GOOD}```", cut=True)


def test_a_source_that_cannot_be_a_candidate_is_reported() -> None:
    assert "line 1" in read_reply("```python\ndef fit(:\n```").problem
    assert "no top-level function fit" in read_reply("```python\nx = 1\n```").problem


def test_words_are_bounded_and_on_one_line() -> None:
    reply = read_reply(f"TITLE: {'x' * 500}\x1b[31m\nFAMILY: {'y' * 500}\n```\n{GOOD}```")
    assert len(reply.title) <= 60
    assert len(reply.family) <= 30
    assert "\x1b" not in reply.title
    assert reply.hypothesis == "not said"
