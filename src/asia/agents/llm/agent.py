"""A language model behind an OpenAI-compatible server proposes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from asia._plugins import is_installed
from asia.agents.llm.menu import (
    CHOICE,
    Offer,
    menu,
    menu_lines,
    menu_problem,
    menu_schema,
    menu_search,
)
from asia.agents.llm.prompt import (
    NO_CANDIDATE,
    Task,
    anonymous,
    bounded,
    problem_text,
    quoted,
    search_text,
    task_of,
)
from asia.agents.llm.reply import NO_CHOICE, Answer, MalformedReplyError, read_choice, read_reply
from asia.agents.llm.settings import LlmSettings
from asia.agents.view import AgentView, Journal, Proposal
from asia.errors import InternalError, UserError

if TYPE_CHECKING:
    from asia.agents.llm.client import ChatClient, Message
    from asia.agents.llm.local import LocalServer
    from asia.ledger.events import StopReason


class LlmAgent:
    """Agent that asks a language model for candidates with a bounded summary of problem and search.

    The model may repair the form of its answer, and, in experiments of their own, failed
    candidates. The agent is a function of the view and of the answers in its journal: a paid answer
    is never requested again.

    Args:
        network: False answers from the journal only, and raises DivergedError where it has no
            answer
        server: the model's server, to be closed with the agent; None for one that others run

    Raises:
        UserError: without the extra `llm` or without a key
    """

    name = "llm"
    proposes_ahead = True

    def __init__(
        self, settings: LlmSettings, *, network: bool = True, server: LocalServer | None = None
    ) -> None:
        if not is_installed("openai"):
            raise UserError(
                "the agent llm needs the package openai: pip install '.[llm]' in a clone of ASIA"
            )
        self.settings = settings
        self._network = network
        self._key = settings.api_key() if network else "none"
        self._client: ChatClient | None = None
        self._server = server

    def recorded(self) -> dict[str, str]:
        """Return the settings that shape the search: no key, no caps."""
        return self.settings.record()

    def attach(self, journal: Journal) -> None:
        """Attach the journal of requests and answers."""
        from asia.agents.llm.client import ChatClient

        self._client = ChatClient(self.settings, journal, self._key, network=self._network)

    def stopped(self, reason: StopReason) -> None:
        """Nothing ends before `leaving`."""

    def leaving(self) -> None:
        """Close the model's server, if it is ours."""
        if self._server is not None:
            self._server.close()

    def propose(self, view: AgentView) -> Proposal | None:
        """The model's candidate; None when the menu is empty and nothing else is allowed.

        An answer that cannot be used after `repairs` corrections is proposed as it is, and fails as
        an experiment.
        """
        if self._client is None:
            raise InternalError("the agent llm was asked before it had a journal")
        hidden, proposals = self.settings.anonymous, self.settings.proposals
        seen = anonymous(view) if hidden else view
        offers = menu(seen) if proposals != "free" else ()
        if proposals == "menu" and not offers:
            return None
        task = task_of(seen, self.settings.repairs)
        if proposals == "menu":
            texts, schema = (
                (menu_problem(seen.facts), menu_search(seen, offers)),
                menu_schema(offers),
            )
        else:
            texts = problem_text(seen.facts), search_text(seen, task, hide_baseline=hidden)
            schema = None
        if proposals == "both" and offers:
            listed = (
                f"# Menu\nInstead of a candidate of your own you may choose one of these. {CHOICE}"
            )
            texts = texts[0], f"{texts[1]}\n\n{listed}\n{menu_lines(offers)}"
        messages: list[Message] = [
            {"role": "system", "content": texts[0]},
            {"role": "user", "content": texts[1]},
        ]
        self._client.begin()
        proposal, wrong = None, ""
        for _ in range(self.settings.repairs + 1):
            answer = self._client.ask(messages, schema)
            try:
                proposal, wrong = self._read(answer, seen, task, offers)
                if not wrong and view.is_known(proposal.source):
                    wrong = "this candidate was evaluated before (comments and layout do not count)"
            except MalformedReplyError as error:
                wrong = str(error)
            if not wrong:
                break
            form = "with a choice from the menu" if schema else "with the complete candidate.py"
            request = (
                f"Your answer cannot be used, and no experiment was spent: {quoted(wrong, 300)}. "
                f"Answer again in the form asked for, {form}."
            )
            messages += [
                {"role": "assistant", "content": bounded(answer.text, 40_000) or "(nothing)"},
                {"role": "user", "content": request},
            ]
        if proposal is not None:
            return proposal
        return Proposal(
            source="# The answer held no candidate.py.\n",
            family=NO_CANDIDATE,
            title="answer without a candidate",
            hypothesis="None: the model's answers could not be used.",
            expected=f"A failure: {wrong}",
        )

    def _read(
        self, answer: Answer, view: AgentView, task: Task, offers: tuple[Offer, ...]
    ) -> tuple[Proposal, str]:
        """Return the proposal of an answer, and the error of its source, "" for none. Raises
        MalformedReplyError for an answer without a candidate."""
        choice = read_choice(answer.text) if offers else None
        if choice is not None:
            if not 1 <= choice.number <= len(offers):
                raise MalformedReplyError(f"the menu has no candidate {choice.number}")
            return offers[choice.number - 1].chosen(choice), ""
        if self.settings.proposals == "menu":
            raise MalformedReplyError(NO_CHOICE)
        reply = read_reply(answer.text, answer.cut)
        parent = task.parent
        if task.kind != "repair" and reply.parent in {trial.number for trial in view.trials}:
            parent = reply.parent
        family = reply.family if reply.family != NO_CANDIDATE else "custom"
        said = reply.title, reply.hypothesis, reply.expected
        return Proposal(reply.source, family, *said, parent), reply.problem
