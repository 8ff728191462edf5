"""Settings of a language model."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

from annotated_types import Ge, Le
from pydantic import TypeAdapter

from asia._plugins import is_installed
from asia.errors import UserError

Proposals = Literal["free", "menu", "both"]
DEFAULT_URL = "https://api.openai.com/v1"
_OURS = frozenset({
    "model", "messages", "stream", "n", "max_tokens", "max_completion_tokens", "temperature",
    "top_p", "seed",
})  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class RequestSettings:
    """Settings of every request to a language model. The command line shows the texts."""

    proposals: Annotated[
        Proposals, "The model writes candidates (free), chooses from a menu, or does both."
    ] = "free"
    temperature: Annotated[float | None, Ge(0.0), "Passed to the server; not sent by default."] = (
        None
    )
    top_p: Annotated[
        float | None, Ge(0.0), Le(1.0), "Passed to the server; not sent by default."
    ] = None
    api_key_env: Annotated[
        str, "Environment variable that holds the key; local servers need none."
    ] = "OPENAI_API_KEY"
    max_reply_tokens: Annotated[int, Ge(1), "Limit of one reply, with its reasoning."] = 16_384
    anonymous: Annotated[
        bool,
        "Hide names, units, description and equations, to measure the value of prior knowledge.",
    ] = False


@dataclass(frozen=True)
class LlmSettings(RequestSettings):
    """Settings of a language model, and caps for the whole search.

    Args:
        base_url: of an OpenAI-compatible server, None for OpenAI's
        seed, extra_body: sent with every request, unless None
        max_tokens_total: input and output tokens
        max_cost: USD
        prices: USD per million tokens, None when unknown
        repairs: attempts to correct the form of a reply, and experiments in a row to correct a
            failed candidate
        retries, retry_seconds: number of attempts and total waiting time when the server is
            busy
        local: weights, sampler and version of a server that ASIA started; {} for another one

    Raises:
        UserError: for settings that do not fit together
    """

    model: str
    base_url: str | None = None
    seed: int | None = None
    extra_body: Mapping[str, Any] = field(default_factory=dict[str, Any])
    max_tokens_total: int | None = None
    max_cost: float | None = None
    price_input: float | None = None
    price_output: float | None = None
    repairs: int = 2
    retries: int = 6
    retry_seconds: float = 300.0
    timeout_seconds: float = 600.0
    local: Mapping[str, Any] = field(default_factory=dict[str, Any])

    def __post_init__(self) -> None:
        if not self.model:
            raise UserError("the agent llm needs a model: give its name with --model")
        if not self.shown_url:
            # An invalid address may still contain a key: do not repeat it.
            raise UserError(
                "the base URL is not valid: expected http:// or https:// and a host, such as "
                "http://localhost:8000/v1"
            )
        if (self.price_input is None) != (self.price_output is None):
            raise UserError("prices: give both, for input and for output tokens")
        if self.max_cost is not None and self.price_input is None:
            raise UserError("a limit of cost needs prices: give --prices INPUT,OUTPUT in USD")
        for what, value in (("tokens", self.max_tokens_total), ("cost", self.max_cost)):
            if value is not None and not value > 0:
                raise UserError(f"a limit of {what} must be more than 0")
        if self.max_reply_tokens < 1 or self.repairs < 0:
            raise UserError("a reply needs at least 1 token, and repairs at least 0")
        if self.anonymous and self.proposals != "free":
            raise UserError("--anonymous needs --proposals free: a menu tells the kind of system")
        ours = sorted(_OURS & self.extra_body.keys())
        if ours:
            raise UserError(f"extra body: '{ours[0]}' has its own option, or is fixed")
        try:
            json.dumps(dict(self.extra_body), allow_nan=False)
        except (TypeError, ValueError, RecursionError):
            raise UserError("extra body: expected a JSON object") from None

    @property
    def url(self) -> str:
        """Base URL of the server."""
        return self.base_url or DEFAULT_URL

    @property
    def shown_url(self) -> str:
        """Address to be shown and kept: without user, password and query, which may be secrets; ""
        for an invalid address."""
        try:
            parts = urlsplit(self.url)
            # A server of our own has another port each time.
            port = f":{parts.port}" if parts.port and not self.local else ""
        except ValueError:
            return ""
        host = parts.hostname or ""
        shown = f"[{host}]" if ":" in host else host
        known = parts.scheme in ("http", "https") and host
        return f"{parts.scheme}://{shown}{port}{parts.path}" if known else ""

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters of a request besides model and messages.

        Servers of OpenAI's make accept the limit of a reply by its new name only, many others by
        its old one.
        """
        host = urlsplit(self.url).hostname or ""
        modern = host.endswith(("openai.com", "azure.com"))
        given = {"temperature": self.temperature, "top_p": self.top_p, "seed": self.seed}
        return {
            "max_completion_tokens" if modern else "max_tokens": self.max_reply_tokens,
            **{name: value for name, value in given.items() if value is not None},
            **self.extra_body,
        }

    def api_key(self) -> str:
        """The key, from the environment; servers other than OpenAI's may need none. Raises
        UserError when it is missing."""
        key = os.environ.get(self.api_key_env, "").strip()
        if not key and self.base_url is None:
            raise UserError(
                f"{self.api_key_env} is not set: export it, or give the --base-url of a server "
                "that needs no key"
            )
        return key or "none"

    def record(self) -> dict[str, str]:
        """Return the settings that shape the search, for the ledger: no key, no limit that may be
        raised."""
        given = {
            "temperature": self.temperature,
            "top_p": self.top_p,
            "seed": self.seed,
            "max_reply_tokens": self.max_reply_tokens,
            "repairs": self.repairs,
            "anonymous": self.anonymous,
            "extra_body": dict(self.extra_body),
            # Absent in ledgers of free proposals and of other servers.
            "proposals": None if self.proposals == "free" else self.proposals,
            "local": dict(self.local) or None,
        }
        return {
            "model": self.model,
            "base_url": self.shown_url,
            **{k: json.dumps(v, sort_keys=True) for k, v in given.items() if v is not None},
        }

    @classmethod
    def from_record(cls, record: Mapping[str, str]) -> LlmSettings:
        """The settings of `record`. Raises UserError when it is not one."""
        try:
            given = {
                k: v if k in ("model", "base_url") else json.loads(v) for k, v in record.items()
            }
            if given.keys() - {f.name for f in fields(cls)}:
                raise ValueError
            return TypeAdapter(cls).validate_json(json.dumps(given), strict=True)
        except (ValueError, RecursionError):
            raise UserError(
                "the ledger does not contain the settings of its language model"
            ) from None


def first_model(base_url: str, api_key_env: str) -> str:
    """The name of the first model that an OpenAI-compatible server lists. Raises UserError without
    the extra `llm`, for a server that cannot be reached, and for one that lists none."""
    if not is_installed("openai"):
        raise UserError(
            "asking a server needs the package openai: pip install '.[llm]' in a clone of ASIA"
        )
    import openai

    settings = LlmSettings("any", base_url, api_key_env=api_key_env)
    client = openai.OpenAI(
        api_key=settings.api_key(), base_url=settings.url, max_retries=0, timeout=20.0
    )
    try:
        names = [model.id for model in client.models.list().data]
    except openai.APIError as error:
        raise UserError(
            f"{settings.shown_url} does not list its models ({type(error).__name__}): check "
            "--base-url, which ends in /v1 for most servers, or name the model with --model"
        ) from None
    finally:
        client.close()
    if not names:
        raise UserError(f"{settings.shown_url} lists no model: name one with --model")
    return names[0]
