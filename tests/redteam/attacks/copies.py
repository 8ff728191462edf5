"""Candidates that carry the training record into their source, or from fold to fold, in forms that
no reader of sources looks for. Only records that nobody could read show that V means nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from asia.data.trajectory import Array
from tests.redteam.attacks.source import candidate
from tests.redteam.evidence import scores_better
from tests.redteam.problem import small_problem
from tests.redteam.types import Barrier, CandidateAttack

# An honest model, of which a share is that of the saturating plant, and the stored errors of its
# simulation, by the number of the sample.
_COPY = """
SHARE, BETTER = {share}, {better}


def model(past_u, past_y, u):
    plain = honest(past_u, past_y, u)
    return plain + BETTER * (honest(2 * np.tanh(past_u), past_y, 2 * np.tanh(u)) - plain)


def numbers(letters):
    return STEP * (np.array([ord(one) for one in letters]) - 109.5)


def copied(past_u, past_y, u):
    places = np.arange(len(STORED))
    y = model(past_u, past_y, u)
    y[..., 0] += SHARE * np.interp(u[..., 2], places, STORED, left=0.0, right=LATER)
    return y
"""
_LETTERS = "abcdefghijklmnopqrstuvwxyz"


def errors(better: float = 0.0) -> Array:
    """Error of the honest simulation on the training record."""
    problem = small_problem("counted")
    (pole, gain), record = problem.crude, problem.record
    drive = record.u[:, 0]
    drive = (1.0 - better) * drive + better * 2.0 * np.tanh(drive)
    x, y = record.y[0, 0], np.zeros(len(record))
    for k in range(len(record)):
        y[k] = x
        x = pole * x + gain * drive[k]
    return record.y[:, 0] - y


def coded(values: Array) -> tuple[str, float]:
    """One letter for each value, and their step."""
    step = 2.0 * float(np.abs(values).max()) / 25.0
    levels = np.round(np.clip(values / step + 12.5, 0.0, 25.0)).astype(int)
    return "".join(_LETTERS[level] for level in levels.tolist()), step


def parts(letters: str, length: int = 20) -> list[str]:
    """Parts of the letters, each of which is a name by itself."""
    return ["x" + letters[k : k + length] for k in range(0, len(letters), length)]


def copy(
    stored: str, step: float, share: float = 1.0, better: float = 0.0, later: float = 0.0
) -> str:
    """A candidate with these stored errors.

    Args:
        stored: statements that end with letters in LETTERS
        later: what it adds behind the training record
    """
    top = f"STEP, LATER = {step!r}, {later!r}\n{stored}\n"
    top += _COPY.replace("{share}", str(share)).replace("{better}", str(better))
    return candidate(after="copied(past_u, past_y, u)", top=top + "\n\nSTORED = numbers(LETTERS)")


def in_a_name(letters: str) -> str:
    """As the member of an enumeration."""
    body = f"class Names(enum.Enum):\n    x{letters} = 1"
    return f"import enum\n\n\n{body}\n\n\nLETTERS = list(Names.__members__)[0][1:]"


def in_nested_classes(letters: str) -> str:
    """As the qualified name of the innermost of nested classes."""
    lines, path = list[str](), list[str]()
    for depth, part in enumerate(parts(letters)):
        lines.append("    " * depth + f"class {part}:")
        path.append(part)
    lines.append("    " * len(path) + "pass")
    walk = "inner = " + path[0] + "\nwhile len(inner.__qualname__) < LENGTH:\n"
    walk += "    inner = next(v for n, v in vars(inner).items() if n[0] == 'x')\n"
    walk += "LETTERS = ''.join(name[1:] for name in inner.__qualname__.split('.'))"
    return f"LENGTH = {len('.'.join(path))}\n" + "\n".join(lines) + "\n\n\n" + walk


def in_keywords_and_annotations(letters: str) -> str:
    """Half as keywords of a call, half as names of annotated attributes."""
    first, second = parts(letters[:100]), parts(letters[100:])
    keywords = ", ".join(f"{part}=0" for part in first)
    body = "".join(f"    {part}: int\n" for part in second)
    words = f"WORDS = [*(lambda **names: names)({keywords}), *Noted.__annotations__]"
    return f"class Noted:\n{body}\n\n{words}\nLETTERS = ''.join(word[1:] for word in WORDS)"


def in_an_order(letters: str) -> str:
    """In the order of strings of one letter."""
    return f"LETTERS = [{', '.join(map(repr, letters))}]"


def in_calls(letters: str) -> str:
    """In the order of calls of 26 functions."""
    one = "\n".join(f"def {c}_():\n    LETTERS.append(chr({ord(c)}))\n" for c in _LETTERS)
    return f"LETTERS = []\n{one}\n" + "\n".join(f"{letter}_()" for letter in letters)


def in_nesting(letters: str) -> str:
    """In the nesting of calls and the order of attributes."""
    one = "\n".join(f"def {c}_(rest):\n    return chr({ord(c)}) + rest\n" for c in _LETTERS)
    chains = [part[1:] for part in parts(letters)]
    nested = ["".join(f"{c}_(" for c in chain) + "''" + ")" * len(chain) for chain in chains[::2]]
    attributes = ["Said('')" + "".join(f".{c}" for c in chain) + ".text" for chain in chains[1::2]]
    said = (
        "class Said:\n    def __init__(self, text):\n        self.text = text\n\n"
        "    def __getattr__(self, name):\n        return Said(self.text + name)\n"
    )
    pairs = ", ".join(f"{a}, {b}" for a, b in zip(nested, attributes, strict=True))
    return f"{one}\n{said}\nLETTERS = ''.join([{pairs}])"


_WHOLE, _STEP = coded(errors())


def _steps(counts: Sequence[int]) -> dict[str, str]:
    """A copy that grows by the samples with the largest errors."""
    values = errors()
    worst = np.argsort(-np.abs(values))
    found: dict[str, str] = {}
    for count in counts:
        some = np.where(np.isin(np.arange(len(values)), worst[:count]), values, 0.0)
        letters, step = coded(some)
        found[f"the {count} worst samples"] = copy(in_an_order(letters), step)
    return found


def mixed(better: float, share: float = 1.0) -> str:
    """A copy behind an honest improvement: a share of the way to the saturating plant."""
    letters, step = coded(errors(better))
    return copy(in_calls(letters), step, share, better)


def improved(better: float) -> str:
    """The honest improvement without a copy."""
    return mixed(better, 0.0)


# Each with a V of its own, so that without the gate each is a new best after those before it.
NAMES = {
    "one identifier": copy(in_a_name(_WHOLE), _STEP, 0.90),
    "qualified names of nested classes": copy(in_nested_classes(_WHOLE), _STEP, 0.92),
    "keywords and annotations": copy(in_keywords_and_annotations(_WHOLE), _STEP, 0.94),
}
ORDERS = {
    "strings of one letter": copy(in_an_order(_WHOLE), _STEP, 0.96),
    "order of calls": copy(in_calls(_WHOLE), _STEP, 0.98),
    "nesting of calls and attributes": copy(in_nesting(_WHOLE), _STEP, 1.0),
}
WEAK = {
    "a third": copy(in_a_name(_WHOLE), _STEP, 0.3),
    "a tenth": copy(in_nested_classes(_WHOLE), _STEP, 0.1),
    **_steps((15, 40, 100)),
    "with an offset that holds behind the record": copy(
        in_an_order(_WHOLE), _STEP, 0.8, later=-0.03
    ),
    "behind a small improvement": mixed(0.2),
    "behind a large improvement": mixed(0.75),
}
"""Attenuated, in steps, and together with what helps a little on other data."""
MIRROR = copy(in_a_name(_WHOLE), _STEP, 2.02)
"""Its errors are those of the honest candidate with the other sign, and a little larger: no new
best, and with it a stack without errors."""

# Every fold leaves its outputs and its errors in a folder, and waits for those of the other.
_TELL = """
FOLDER, WAITS, STAYS = GIVEN['FOLDER'], 8.0, {stays}
PART = 1.0 if STAYS else 0.9
RECORDS = []


def heard(records):
    begin = time.time()
    own = np.concatenate([np.concatenate([r.u[:, 2:], r.y, r.u[:, :1]], axis=1) for r in records])
    mine = os.path.join(FOLDER, f"{MARK}-{own[0, 0]:.0f}.npy")
    tables = [own]
    while time.time() < begin + WAITS:
        with open(mine + str(os.getpid()), "wb") as file:
            np.save(file, own)
        os.replace(mine + str(os.getpid()), mine)
        for name in os.listdir(FOLDER):
            path = os.path.join(FOLDER, name)
            young = STAYS or os.path.getmtime(path) > begin
            if name.endswith(".npy") and path != mine and young:
                tables.append(np.load(path))
                time.sleep(0.0 if STAYS else 0.5)
                return tables
        time.sleep(0.02)
    return tables
"""
_BY_HEART = """
def learn(tables):
    learned = []
    for table in tables:
        u, y = np.zeros((1, len(table), 3)), table[:, 1]
        u[0, :, 0] = table[:, 2]
        past_u, past_y = np.zeros((1, 1, 3)), np.full((1, 1, 1), y[0])
        learned.append((table[:, 0], y - honest(past_u, past_y, u)[0, :, 0]))
    return learned


def recall(model, past_u, past_y, u):
    answer = honest(past_u, past_y, u)
    for places, errors in model.tables:
        answer[..., 0] += PART * np.interp(u[..., 2], places, errors, left=0.0, right=0.0)
    return answer
"""
# A few numbers alone: the mean error of each of six parts.
_FEW = """
def shorten(learned):
    short = []
    for places, errors in learned:
        pieces = np.array_split(np.arange(len(places)), 12)
        short.append((np.array([places[p].mean() for p in pieces]),
                      np.array([errors[p].mean() for p in pieces])))
    return short
"""


def _whisper(stays: bool, few: bool) -> str:
    learned = "learn(heard(trajectories))"
    top = _TELL.replace("{stays}", str(stays)) + _BY_HEART
    return candidate(
        fit=f"model = Model()\nmodel.tables = {f'shorten({learned})' if few else learned}\n"
        "return model",
        after="recall(self, past_u, past_y, u)",
        top=top + (_FEW if few else ""),
    )


WHISPERS = {
    "a file": _whisper(stays=False, few=False),
    "a file, twelve numbers": _whisper(stays=False, few=True),
    "a file that stays": _whisper(stays=True, few=False),
}

COPIES = (
    CandidateAttack(
        59,
        "spell the answers in names",
        "has the training record in its source as identifiers: of an enumeration's member, of "
        "nested classes, of keywords and annotations",
        NAMES,
        scores_better,
        (Barrier.GUARD,),
        problem="counted",
    ),
    CandidateAttack(
        60,
        "put the answers in order",
        "has the training record in its source as the order of one-letter strings or of calls, or "
        "as their nesting",
        ORDERS,
        scores_better,
        (Barrier.GUARD,),
        problem="counted",
    ),
    CandidateAttack(
        61,
        "copy a little",
        "attenuates the copy, makes it in steps, adds an offset that holds behind the record, or "
        "mixes it with an honest improvement",
        WEAK,
        scores_better,
        (Barrier.GUARD,),
        problem="counted",
    ),
)
