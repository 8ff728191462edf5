"""Notes of `asia steer` that the expert follows: `try FAMILY` and `avoid FAMILY`."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from asia.agents.library.registry import all_families
from asia.agents.view import AgentView

READS = "the expert reads 'try FAMILY' and 'avoid FAMILY', with a family of asia models"


@dataclass(frozen=True)
class Wish:
    """Family that a note asks for, or speaks against."""

    note: int
    """Number of the note, from 1."""
    name: str
    """The family."""
    avoid: bool
    """Whether it is not to be tried."""

    @property
    def text(self) -> str:
        """`try narx`."""
        return f"{'avoid' if self.avoid else 'try'} {self.name}"

    @property
    def mark(self) -> str:
        """Sentence for the hypothesis of the experiment that follows it."""
        return f"Note {self.note} is followed: {self.text}."

    def is_followed(self, view: AgentView) -> bool:
        """Return whether an experiment says that it followed this note."""
        return any(self.mark in one.hypothesis for one in view.proposed)


def read_notes(notes: Sequence[str]) -> tuple[tuple[Wish, ...], tuple[str, ...]]:
    """The wishes of all notes, and one line for each note that has none."""
    known = {row.name for row in all_families()}
    wishes: list[Wish] = []
    answers: list[str] = []
    for number, note in enumerate(notes, 1):
        verb, *names = note.replace(",", " ").split() or [""]
        if verb in ("try", "avoid") and names and known.issuperset(names):
            wishes += [Wish(number, name, verb == "avoid") for name in names]
        else:
            answers.append(f"note {number} is not understood: {READS}")
    return tuple(wishes), tuple(answers)


def avoided(wishes: Iterable[Wish]) -> set[str]:
    """Families that notes speak against; a later note overrides."""
    last = {wish.name: wish.avoid for wish in wishes}
    return {name for name, avoid in last.items() if avoid}
