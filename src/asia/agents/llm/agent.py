"""A language model behind an OpenAI-compatible server proposes."""

from __future__ import annotations

import importlib.util
from typing import TYPE_CHECKING

from asia.agents.llm.prompt import (
    NO_CANDIDATE,
    anonymous,
    bounded,
    problem_text,
    quoted,
    search_text,
    task_of,
)
from asia.agents.llm.reply import MalformedReplyError, Reply, read_reply
from asia.agents.llm.settings import LlmSettings
from asia.agents.view import AgentView, Journal, Proposal
from asia.errors import InternalError, UserError

if TYPE_CHECKING:
    from asia.agents.llm.client import ChatClient, Message


class LlmAgent:
    """Agent that asks a language model for candidates with a bounded summary of problem and search.

    The model may repair the form of its answer, and, in experiments of their own, failed
    candidates. The agent is a function of the view and of the answers in its journal: a paid answer
    is never requested again.

    Args:
        network: False answers from the journal only, and raises DivergedError where it has no
            answer

    Raises:
        UserError: without the extra `llm` or without a key
    """

    name = "llm"
    proposes_ahead = True

    def __init__(self, settings: LlmSettings, *, network: bool = True) -> None:
        if importlib.util.find_spec("openai") is None:
            raise UserError(
                "the agent llm needs the package openai: pip install '.[llm]' in a clone of ASIA"
            )
        self.settings = settings
        self._network = network
        self._key = settings.api_key() if network else "none"
        self._client: ChatClient | None = None

    def recorded(self) -> dict[str, str]:
        """Return the settings that shape the search: no key, no caps."""
        return self.settings.record()

    def attach(self, journal: Journal) -> None:
        """Attach the journal of requests and answers."""
        from asia.agents.llm.client import ChatClient

        self._client = ChatClient(self.settings, journal, self._key, network=self._network)

    def propose(self, view: AgentView) -> Proposal:
        """The model's candidate. One whose form cannot be mended in `repairs` turns is proposed as
        it is, and fails as an experiment."""
        if self._client is None:
            raise InternalError("the agent llm was asked before it had a journal")
        hidden = self.settings.anonymous
        seen = anonymous(view) if hidden else view
        task = task_of(seen, self.settings.repairs)
        messages: list[Message] = [
            {"role": "system", "content": problem_text(seen.facts)},
            {"role": "user", "content": search_text(seen, task, hide_baseline=hidden)},
        ]
        reply, wrong = self._last_reply(self._client, messages, seen)
        if reply is None:
            return Proposal(
                source="# The answer held no candidate.py.\n",
                family=NO_CANDIDATE,
                title="answer without a candidate",
                hypothesis="None: the model's answers could not be used.",
                expected=f"A failure: {wrong}",
            )
        parent = task.parent
        if task.kind != "repair" and reply.parent in {trial.number for trial in seen.trials}:
            parent = reply.parent
        family = reply.family if reply.family != NO_CANDIDATE else "custom"
        return Proposal(reply.source, family, reply.title, reply.hypothesis, reply.expected, parent)

    def _last_reply(
        self, client: ChatClient, messages: list[Message], view: AgentView
    ) -> tuple[Reply | None, str]:
        """Return the last answer with a source, and the error of the last answer of all."""
        client.begin()
        reply: Reply | None = None
        wrong = ""
        for _ in range(self.settings.repairs + 1):
            answer = client.ask(messages)
            try:
                reply = read_reply(answer.text, answer.cut)
                wrong = reply.problem
                if not wrong and view.is_known(reply.source):
                    wrong = "this candidate was evaluated before (comments and layout do not count)"
            except MalformedReplyError as error:
                wrong = str(error)
            if not wrong:
                break
            request = (
                f"Your answer cannot be used, and no experiment was spent: {quoted(wrong, 300)}. "
                "Answer again in the form asked for, with the complete candidate.py."
            )
            messages += [
                {"role": "assistant", "content": bounded(answer.text, 40_000) or "(nothing)"},
                {"role": "user", "content": request},
            ]
        return reply, wrong
