"""Options of `asia run --agent llm`."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from asia.agents import LlmAgent

PANEL = "Language model (--agent llm)"
CAPS = "Language models and coding agents (--agent llm, command:NAME)"

Model = Annotated[
    str | None,
    typer.Option("--model", help="Name of the model, as its server calls it.",
                 rich_help_panel=CAPS),
]  # fmt: skip
BaseUrl = Annotated[
    str | None,
    typer.Option("--base-url", envvar="OPENAI_BASE_URL", rich_help_panel=PANEL,
                 help="OpenAI-compatible server, such as http://localhost:8000/v1; default "
                 "OpenAI's."),
]  # fmt: skip
Temperature = Annotated[
    float | None,
    typer.Option("--temperature", min=0.0, rich_help_panel=PANEL,
                 help="Sent as it is; left out by default."),
]  # fmt: skip
TopP = Annotated[
    float | None,
    typer.Option("--top-p", min=0.0, max=1.0, rich_help_panel=PANEL,
                 help="Sent as it is; left out by default."),
]  # fmt: skip
Seed = Annotated[
    int | None,
    typer.Option("--llm-seed", rich_help_panel=PANEL,
                 help="Seed for the server, which may heed it; left out by default."),
]  # fmt: skip
ExtraBody = Annotated[
    str | None,
    typer.Option("--extra-body", metavar="JSON", rich_help_panel=PANEL,
                 help='More fields of the request, such as \'{"top_k": 20}\'.'),
]  # fmt: skip
ApiKeyEnv = Annotated[
    str,
    typer.Option("--api-key-env", metavar="NAME", rich_help_panel=PANEL,
                 help="Environment variable that holds the key; local servers need none."),
]  # fmt: skip
MaxTokens = Annotated[
    int | None,
    typer.Option("--max-tokens", min=1, rich_help_panel=CAPS,
                 help="Stop before input and output tokens exceed this in all; no limit by "
                 "default."),
]  # fmt: skip
MaxReplyTokens = Annotated[
    int | None,
    typer.Option("--max-reply-tokens", min=1, rich_help_panel=PANEL,
                 help="Limit of one reply, thoughts included; default 16384."),
]  # fmt: skip
MaxCost = Annotated[
    float | None,
    typer.Option("--max-cost", metavar="USD", rich_help_panel=CAPS,
                 help="Stop before the cost exceeds this; llm needs --prices."),
]  # fmt: skip
Prices = Annotated[
    str | None,
    typer.Option("--prices", metavar="IN,OUT", rich_help_panel=PANEL,
                 help="USD for a million input and output tokens, such as 0.5,2."),
]  # fmt: skip
Anonymous = Annotated[
    bool,
    typer.Option("--anonymous", rich_help_panel=PANEL,
                 help="Hide names, units, description and equations: what is prior knowledge "
                 "worth?"),
]  # fmt: skip

KEY_VARIABLE = "OPENAI_API_KEY"


def llm_agent(
    *,
    model: str | None,
    base_url: str | None,
    temperature: float | None,
    top_p: float | None,
    seed: int | None,
    extra_body: str | None,
    api_key_env: str,
    max_tokens: int | None,
    max_reply_tokens: int | None,
    max_cost: float | None,
    prices: str | None,
    anonymous: bool,
) -> LlmAgent:
    """The agent with these options. Raises UserError for those that make no sense."""
    from asia.agents import LlmAgent, LlmSettings

    price_input, price_output = _prices(prices)
    return LlmAgent(
        LlmSettings(
            model=model or "",
            base_url=base_url,
            temperature=temperature,
            top_p=top_p,
            seed=seed,
            extra_body=_object(extra_body),
            api_key_env=api_key_env,
            max_tokens_total=max_tokens,
            max_cost=max_cost,
            price_input=price_input,
            price_output=price_output,
            max_reply_tokens=max_reply_tokens or LlmSettings.max_reply_tokens,
            anonymous=anonymous,
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
