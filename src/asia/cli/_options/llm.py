"""Options of language models: `asia run --agent llm`, and what coding agents share with it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from asia.agents import LlmAgent

KEY_VARIABLE = "OPENAI_API_KEY"
_shared = partial(
    typer.Option, rich_help_panel="Language models and coding agents (--agent llm, command:NAME)"
)
_own = partial(typer.Option, rich_help_panel="Language model (--agent llm)")


@dataclass(frozen=True)
class ModelOptions:
    """Model and its limits, for language models and coding agents."""

    model: Annotated[str | None, _shared(help="Name of the model, as its server calls it.")] = None
    max_tokens: Annotated[
        int | None,
        _shared(
            min=1,
            help=("Stop before input plus output tokens exceed this; no limit by default."),
        ),
    ] = None
    max_cost: Annotated[
        float | None,
        _shared(metavar="USD", help="Stop before the cost exceeds this; llm needs --prices."),
    ] = None


@dataclass(frozen=True)
class LlmOptions:
    """Server, sampling and limits of a language model."""

    base_url: Annotated[
        str | None,
        _own(
            envvar="OPENAI_BASE_URL",
            help="OpenAI-compatible server, such as http://localhost:8000/v1; default OpenAI's.",
        ),
    ] = None
    temperature: Annotated[
        float | None, _own(min=0.0, help="Passed to the server; not sent by default.")
    ] = None
    top_p: Annotated[
        float | None, _own(min=0.0, max=1.0, help="Passed to the server; not sent by default.")
    ] = None
    llm_seed: Annotated[
        int | None, _own(help="Seed for the server, which may ignore it; not sent by default.")
    ] = None
    extra_body: Annotated[
        str | None,
        _own(metavar="JSON", help="More fields of the request, such as '{\"top_k\": 20}'."),
    ] = None
    api_key_env: Annotated[
        str,
        _own(
            metavar="NAME", help="Environment variable that holds the key; local servers need none."
        ),
    ] = KEY_VARIABLE
    max_reply_tokens: Annotated[
        int | None, _own(min=1, help="Limit of one reply, with its reasoning; default 16384.")
    ] = None
    prices: Annotated[
        str | None,
        _own(metavar="IN,OUT", help="USD for a million input and output tokens, such as 0.5,2."),
    ] = None
    anonymous: Annotated[
        bool,
        _own(
            "--anonymous",
            help=(
                "Hide names, units, description and equations, to measure the value of prior "
                "knowledge."
            ),
        ),
    ] = False

    def agent(self, caps: ModelOptions) -> LlmAgent:
        """Make the agent. Raises UserError for invalid options."""
        from asia.agents import LlmAgent, LlmSettings

        price_input, price_output = _prices(self.prices)
        return LlmAgent(
            LlmSettings(
                model=caps.model or "",
                base_url=self.base_url,
                temperature=self.temperature,
                top_p=self.top_p,
                seed=self.llm_seed,
                extra_body=_object(self.extra_body),
                api_key_env=self.api_key_env,
                max_tokens_total=caps.max_tokens,
                max_cost=caps.max_cost,
                price_input=price_input,
                price_output=price_output,
                max_reply_tokens=self.max_reply_tokens or LlmSettings.max_reply_tokens,
                anonymous=self.anonymous,
            )
        )


def _prices(text: str | None) -> tuple[float | None, float | None]:
    from asia.errors import UserError

    if text is None:
        return None, None
    try:
        price_input, price_output = (float(part) for part in text.split(","))
    except ValueError:
        raise UserError(
            f"--prices {text}: expected two numbers, USD for a million input and output tokens, "
            "such as 0.5,2"
        ) from None
    return price_input, price_output


def _object(text: str | None) -> dict[str, Any]:
    from asia.errors import UserError

    if text is None:
        return {}
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        value = None
    if not isinstance(value, dict):
        raise UserError(f"--extra-body {text}: expected a JSON object, such as '{{\"top_k\": 20}}'")
    return value
