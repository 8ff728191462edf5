"""Controllers that the expert tries: a ladder of designs, a learned residual on the best one, then
longer searches, fewer or more moves, and a design on one model alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from asia.agents.view import AgentView, Proposal, Trial

_TEMPLATE = '''"""{summary}"""

from asia.models import controllers


def design(models, context):
    return {call}
'''


@dataclass(frozen=True)
class Design:
    """Design of the library with its settings."""

    kind: str
    """Function of `asia.models.controllers`."""
    settings: tuple[tuple[str, int | bool], ...] = ()
    nominal: bool = False
    """Whether it is designed on the model of all records alone."""
    residual: tuple[tuple[str, int], ...] | None = None
    """Settings of a learned residual; None without one."""

    @property
    def family(self) -> str:
        """Name of the kind in the ledger."""
        scheduled = ("scheduled", True) in self.settings
        name = "scheduled pid" if scheduled else self.kind
        return name if self.residual is None else f"{name} with residual"

    @property
    def source(self) -> str:
        """Candidate."""

        def named(pairs: tuple[tuple[str, int | bool], ...]) -> str:
            return "".join(f", {k}={v}" for k, v in pairs)

        models = "models[:1]" if self.nominal else "models"
        call = f"controllers.{self.kind}({models}, context{named(self.settings)})"
        if self.residual is not None:
            call = f"controllers.with_residual({call}, context{named(self.residual)})"
        return _TEMPLATE.format(summary=f"{self.family[:1].upper()}{self.family[1:]}.", call=call)

    def with_settings(self, **changes: int | bool) -> Design:
        """Return the design with settings changed."""
        return replace(self, settings=tuple({**dict(self.settings), **changes}.items()))


@dataclass(frozen=True)
class _Card:
    design: Design
    title: str
    use: str


_LADDER = (
    _Card(Design("pid"), "PID", "PID loops are simple, and optimised together they are often near "
          "the best that the limits allow"),
    _Card(Design("lqr"), "LQR with observer", "an observer of states and disturbances filters the "
          "noise better than a derivative"),
    _Card(Design("pid", (("scheduled", True),)), "gain-scheduled PID", "a plant that changes with "
          "its set point needs gains that do"),
    _Card(Design("mpc"), "predictive control", "a plan within the limits uses inputs that saturate "
          "better than clipping"),
)  # fmt: skip
_LONGER = {"generations": 60, "population": 48}


def propose_controller(view: AgentView) -> Proposal | None:
    """Propose the next design of the ladder, then the first untried change of the best ones."""
    for card in _LADDER:
        if not view.is_known(card.design.source):
            return Proposal(
                source=card.design.source,
                family=card.design.family,
                title=card.title,
                hypothesis=f"{card.title}: {card.use}.",
                expected="A first V of this kind of controller, to compare it with the others.",
            )
    known = list(_known(view))
    moves = [(trial, *move) for trial, design in known for move in _moves(design)]
    # A learned residual on the best controller that can have one comes first.
    first = [move for move in moves if move[1].residual == ()][:1]
    for trial, changed, title, hypothesis in (*first, *moves):
        if not view.is_known(changed.source):
            return Proposal(
                source=changed.source,
                family=changed.family,
                title=title,
                hypothesis=hypothesis,
                expected=f"A lower V than #{trial.number:02d}.",
                parent=trial.number,
            )
    return None


def _known(view: AgentView) -> Iterator[tuple[Trial, Design]]:
    """Scored trials of the library, best first, with their designs."""
    made = [card.design for card in _LADDER]
    for _ in range(3):
        made += [changed for one in made for changed, _, _ in _moves(one)]
    designs = {one.source: one for one in reversed(made)}
    for trial in view.ranked:
        if trial.source in designs:
            yield trial, designs[trial.source]


def _moves(design: Design) -> Iterator[tuple[Design, str, str]]:
    """Changes of a design, with a title and a hypothesis."""
    # A predictive controller is too slow to be simulated while a residual is learned.
    if design.residual is None and design.kind != "mpc":
        yield (
            replace(design, residual=()),
            f"{design.family} with a learned residual",
            "A small network on top of the model-based controller learns what its structure "
            "cannot do.",
        )
    if design.residual == ():
        wider = (("hidden", 6), *_LONGER.items())
        yield (
            replace(design, residual=wider),
            f"{design.family}, wider",
            "More neurons and a longer search find more of what a residual can gain.",
        )
    if not design.nominal:
        yield (
            replace(design, nominal=True),
            f"{design.family}, on the model of all records",
            "The worst of several models asks for more caution than the plant.",
        )
    if ("generations", _LONGER["generations"]) not in design.settings:
        yield (
            design.with_settings(**_LONGER),
            f"{design.family}, longer search",
            "The optimisation ended before its minimum.",
        )
    if design.kind == "mpc" and not dict(design.settings).get("moves"):
        yield (
            design.with_settings(moves=40),
            "predictive control, longer plan",
            "A plan of twice the length sees the end of a slow response.",
        )
