"""Client of an OpenAI-compatible server: caps, retries and error messages."""

import email.utils
import hashlib
import json
import time
import urllib.request
from collections.abc import Callable, Mapping
from typing import Any, NoReturn, TypeGuard
from urllib.parse import urlsplit

import httpx2
import openai

from asia._text import one_line
from asia.agents.llm.reply import Answer, json_object, read_answer
from asia.agents.llm.settings import LlmSettings
from asia.agents.view import AgentStoppedError, DivergedError, InterruptedWaitError, Journal
from asia.errors import UserError
from asia.ledger.events import Exchanged, Usage

_NEVER_SENT = ("ConnectError", "ConnectTimeout", "PoolTimeout", "UnsupportedProtocol", "ProxyError")


class Cassette(httpx2.BaseTransport):
    """Transport that answers recorded requests from the record and records all others.

    All requests of the client pass here; in a replay none is sent. Bodies are kept, headers never.
    Answers with an error are recorded and not served again: a resumed search asks anew, and a
    replay needs only the answers that its agent used.

    Args:
        inner: transport of unrecorded requests; None in a replay
        admit: called with a request's body before it is sent; it may raise
        usage_of: reads a response's usage
        secret: removed from all that is kept
    """

    def __init__(
        self,
        journal: Journal,
        inner: httpx2.BaseTransport | None,
        admit: Callable[[bytes], None],
        usage_of: Callable[[bytes], Usage | None],
        secret: str = "",
    ) -> None:
        self._journal, self._inner, self._admit = journal, inner, admit
        self._usage_of = usage_of
        self._secret = secret.encode() if len(secret) >= 8 else b""
        self._experiment = 0
        self._recorded: list[Exchanged] = []

    def rewind(self) -> None:
        """Start a proposal: recorded answers for this experiment are served first."""
        self._experiment = self._journal.experiments + 1
        self._recorded = [
            e
            for e in self._journal.exchanges
            if e.experiment == self._experiment and _answered(e.status)
        ]

    def handle_request(self, request: httpx2.Request) -> httpx2.Response:
        """Return the answer, with its body read."""
        body = self._kept(request.read())
        path = request.url.path
        served = self._serve(path, body)
        if served is not None:
            return _response(200, served)
        if self._inner is None:
            raise DivergedError(self._difference(body))
        self._admit(body)
        try:
            answer = self._inner.handle_request(request)
            content = self._kept(answer.read())
        except httpx2.TransportError as error:
            self._record(path, body, json.dumps({"error": type(error).__name__}).encode(), 0)
            raise
        answer.close()
        self._record(path, body, content, answer.status_code)
        return _response(answer.status_code, content, answer.headers.get("retry-after"))

    def close(self) -> None:
        """Close the connections."""
        if self._inner is not None:
            self._inner.close()

    def _serve(self, path: str, body: bytes) -> bytes | None:
        """Return the next recorded answer to the same request.

        Answers before it belong to requests that are not repeated, because a note of the user came
        between.
        """
        wanted = request_key(path, body)
        for place, exchange in enumerate(self._recorded):
            if request_key(exchange.path, self._journal.get(exchange.request)) == wanted:
                del self._recorded[: place + 1]
                return self._journal.get(exchange.response)
        return None

    def _record(self, path: str, body: bytes, content: bytes, status: int) -> None:
        usage = self._usage_of(content) if _answered(status) else None
        put = self._journal.put
        self._journal.record(
            Exchanged(self._experiment, path, put(body), put(content), status, usage)
        )

    def _kept(self, data: bytes) -> bytes:
        return data.replace(self._secret, b"[key]") if self._secret else data

    def _difference(self, body: bytes) -> str:
        """Describe the first difference between the request and the recorded one."""
        if not self._recorded:
            return f"experiment {self._experiment}: a request more than the record holds"
        there = self._journal.get(self._recorded[0].request).decode("utf-8", "replace")
        here = body.decode("utf-8", "replace")
        pairs = enumerate(zip(there, here, strict=False))
        at = next((i for i, (a, b) in pairs if a != b), min(len(there), len(here)))
        return (
            f"experiment {self._experiment}: the request differs from the one on record at "
            f"character {at}: {here[at : at + 60]!r} instead of {there[at : at + 60]!r}"
        )


def request_key(path: str, body: bytes) -> str:
    """sha256 of method, path and body, its JSON in canonical form."""
    try:
        text = json.dumps(json.loads(body), sort_keys=True, separators=(",", ":"))
    except (ValueError, RecursionError):
        text = body.decode("utf-8", "replace")
    return hashlib.sha256(f"POST {path}\n{text}".encode("utf-8", "surrogatepass")).hexdigest()


def may_have_cost(exchange: Exchanged, content: bytes) -> bool:
    """Return whether the server may have counted tokens for it: answered, or sent and never
    answered."""
    if exchange.status != 0:
        return _answered(exchange.status)
    try:
        kind: Any = json.loads(content).get("error")
    except (ValueError, RecursionError, AttributeError):
        return True
    return kind not in _NEVER_SENT


def _answered(status: int) -> bool:
    return 200 <= status < 300


def _response(status: int, content: bytes, retry_after: str | None = None) -> httpx2.Response:
    headers = {"content-type": "application/json"}
    if retry_after is not None:
        headers["retry-after"] = retry_after
    return httpx2.Response(status, headers=headers, content=content)


Message = dict[str, str]

_BUSY = frozenset({408, 409, 425, 429, 500, 502, 503, 504, 520, 522, 524, 529})


class ChatClient:
    """Client with one request at a time, recorded in the journal.

    Args:
        network: False answers from the record only
    """

    def __init__(
        self, settings: LlmSettings, journal: Journal, key: str, *, network: bool = True
    ) -> None:
        self._settings, self._journal, self._key = settings, journal, key
        self._cassette = Cassette(
            journal,
            _network(settings.url) if network else None,
            self._admit,
            self._usage,
            secret=key,
        )
        self._client = openai.OpenAI(
            api_key=key,
            base_url=settings.url,
            max_retries=0,
            timeout=settings.timeout_seconds,
            http_client=openai.DefaultHttpxClient(transport=self._cassette),
        )

    def begin(self) -> None:
        """Start a new proposal: paid answers come first."""
        self._cassette.rewind()

    def ask(self, messages: list[Message], schema: Mapping[str, Any] | None = None) -> Answer:
        """Ask the model.

        A busy server is asked again after the time it requests, within bounds.

        Args:
            schema: JSON schema of the answer; None for text

        Raises:
            AgentStoppedError: when a cap would be exceeded or the server stays unavailable
            UserError: when the server refuses the request
            InterruptedWaitError: when the user has a note or a request meanwhile
        """
        waited, attempt = 0.0, 0
        fields = dict(self._settings.parameters)
        if schema is not None:
            form = {"name": "choice", "schema": schema}
            fields["response_format"] = {"type": "json_schema", "json_schema": form}
        while True:
            try:
                create: Any = self._client.chat.completions.with_raw_response.create
                raw = create(model=self._settings.model, messages=messages, extra_body=fields)
                return read_answer(raw.http_response.content)
            except openai.APIStatusError as error:
                what = f"status {error.status_code}: {self._said(error)}"
                if error.status_code not in _BUSY or error.code == "insufficient_quota":
                    self._refused(error)
                wait = _asked_wait(error.response.headers.get("retry-after"))
            except openai.APIConnectionError as error:
                if not isinstance(error.__cause__, httpx2.HTTPError):
                    raise (error.__cause__ or error) from None
                what = f"no answer ({type(error.__cause__).__name__})"
                wait = None
                if isinstance(error.__cause__, httpx2.ConnectError) and not self._answered:
                    self._give_up(what)
            attempt += 1
            wait = min(2.0**attempt, 60.0) if wait is None else wait
            if attempt > self._settings.retries or waited + wait > self._settings.retry_seconds:
                self._give_up(f"{what}, after {attempt} attempts")
            waited += wait
            end = time.monotonic() + wait
            while (left := end - time.monotonic()) > 0:
                if self._journal.interrupted():
                    raise InterruptedWaitError
                time.sleep(min(left, 0.1))

    @property
    def _answered(self) -> bool:
        """Whether the server ever did."""
        return any(200 <= e.status < 300 for e in self._journal.exchanges)

    def _admit(self, body: bytes) -> None:
        """Raise AgentStoppedError unless the worst-case cost of the request fits the remaining
        caps."""
        s = self._settings
        tokens, cost, rate = self._spent()
        prompt, reply = self._worst(body, rate)
        if s.max_tokens_total is not None and tokens + prompt + reply > s.max_tokens_total:
            raise AgentStoppedError(
                "tokens",
                f"{tokens} tokens are spent; the next request may take {prompt + reply}, and "
                f"{s.max_tokens_total} are allowed",
            )
        dearest = self._price(prompt, reply) or 0.0
        if s.max_cost is not None and cost + dearest > s.max_cost:
            raise AgentStoppedError(
                "cost",
                f"{cost:.4f} USD are spent; the next request may take {dearest:.4f}, and "
                f"{s.max_cost:g} are allowed",
            )

    def _spent(self) -> tuple[int, float, float]:
        """Tokens and USD so far, a request whose usage is not known at its worst; and the most
        input tokens for a byte of a request, with a margin."""
        exchanges = self._journal.exchanges
        sizes = [len(self._journal.get(e.request)) for e in exchanges]
        reported = [
            e.usage.input_tokens / size
            for e, size in zip(exchanges, sizes, strict=True)
            if e.usage is not None
        ]
        # A token is a byte or more; then the server's own counts tell.
        rate = 1.25 * max(reported) if reported else 1.0
        tokens, cost = 0, 0.0
        for e in exchanges:
            if e.usage is not None:
                used = (e.usage.input_tokens, e.usage.output_tokens)
            elif may_have_cost(e, self._journal.get(e.response)):
                used = self._worst(self._journal.get(e.request), rate)
            else:
                continue
            tokens += sum(used)
            cost += self._price(*used) or 0.0
        return tokens, cost, rate

    def _worst(self, body: bytes, rate: float) -> tuple[int, int]:
        return int(len(body) * rate) + 1, self._settings.max_reply_tokens

    def _price(self, prompt: int, reply: int) -> float | None:
        """Cached input tokens count in full: an upper bound."""
        s = self._settings
        if s.price_input is None or s.price_output is None:
            return None
        return (prompt * s.price_input + reply * s.price_output) / 1e6

    def _usage(self, content: bytes) -> Usage | None:
        usage = json_object(json_object(content).get("usage"))
        prompt, reply = usage.get("prompt_tokens"), usage.get("completion_tokens")
        if not _is_count(prompt) or not _is_count(reply):
            return None
        cached = json_object(usage.get("prompt_tokens_details")).get("cached_tokens")
        cost = self._price(prompt, reply)
        return Usage(prompt, reply, cached if _is_count(cached) else 0, cost, turns=1)

    def _refused(self, error: openai.APIStatusError) -> NoReturn:
        said = self._said(error)
        s = self._settings
        if error.code == "insufficient_quota":
            raise AgentStoppedError(
                "agent", f"the account at the server has no credit left: {said}"
            )
        if error.status_code in (401, 403):
            raise UserError(
                f"{s.shown_url} refuses the key ({error.status_code}): check {s.api_key_env}; it "
                f"said: {said}"
            )
        if error.status_code == 404:
            raise UserError(
                f"{s.shown_url} does not know the model '{s.model}' or the path: check --model and "
                f"--base-url, which ends in /v1 for most servers; it said: {said}"
            )
        if "context" in f"{error.type} {error.code}":
            raise UserError(
                f"the request is longer than the context of the model: give its server a longer "
                f"one, or use --proposals menu, whose requests are short; {s.shown_url} said: "
                f"{said}"
            )
        known = {
            "temperature": "--temperature", "top_p": "--top-p", "seed": "--llm-seed",
            "max_tokens": "--max-reply-tokens", "max_completion_tokens": "--max-reply-tokens",
            "response_format": "--proposals",
        }  # fmt: skip
        advice = "Change the options of the language model, and choose another --name"
        if error.param in known:
            advice = (
                f"The model does not take this value of {error.param}: change or leave out "
                f"{known[error.param]}, and choose another --name"
            )
        raise UserError(
            f"{s.shown_url} refuses the request ({error.status_code}): {said}. {advice}"
        )

    def _give_up(self, what: str) -> NoReturn:
        """Raise UserError for a server that never answered; AgentStoppedError for one that did and
        may recover."""
        if not self._answered:
            raise UserError(
                f"cannot reach the model at {self._settings.shown_url}: {what}; check --base-url "
                "and that the server runs, then give the same command again"
            )
        raise AgentStoppedError("agent", f"the server of the model does not answer: {what}")

    def _said(self, error: openai.APIStatusError) -> str:
        body = json_object(error.body)
        message = body.get("message")
        text = message if isinstance(message, str) else error.message
        return one_line(text.replace(self._key, "[key]"), 300)


def _network(url: str) -> httpx2.BaseTransport:
    """Through the environment's proxy where it names one for this host. A connection ends with its
    request: the next one is an evaluation away."""
    parts = urlsplit(url)
    proxies = urllib.request.getproxies()
    proxy = proxies.get(parts.scheme) or proxies.get("all")
    host = parts.hostname or ""
    here = host in ("127.0.0.1", "::1", "localhost")
    direct = not proxy or here or bool(urllib.request.proxy_bypass(host))
    limits = httpx2.Limits(max_keepalive_connections=0)
    return httpx2.HTTPTransport(proxy=None if direct else proxy, limits=limits)


def _asked_wait(header: str | None) -> float | None:
    """Seconds of a Retry-After header: a number or a date."""
    if header is None:
        return None
    try:
        return max(0.0, float(header))
    except ValueError:
        pass
    try:
        return max(0.0, email.utils.parsedate_to_datetime(header).timestamp() - time.time())
    except ValueError:
        return None


def _is_count(value: Any) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= 10**12
