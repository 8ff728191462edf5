"""List of the models of a server."""

from __future__ import annotations

import importlib.util

from asia.agents.llm.settings import LlmSettings
from asia.errors import UserError

_SECONDS = 20.0


def first_model(base_url: str, api_key_env: str) -> str:
    """The name of the first model that an OpenAI-compatible server lists.

    Raises:
        UserError: without the extra `llm`, for a server that cannot be reached, and for one
            that lists none
    """
    if importlib.util.find_spec("openai") is None:
        raise UserError(
            "asking a server needs the package openai: pip install '.[llm]' in a clone of ASIA"
        )
    import openai

    settings = LlmSettings("any", base_url, api_key_env=api_key_env)
    client = openai.OpenAI(
        api_key=settings.api_key(), base_url=settings.url, max_retries=0, timeout=_SECONDS
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
