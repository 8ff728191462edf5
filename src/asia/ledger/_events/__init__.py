"""Events that a search records: one dataclass an event, every field is JSON."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, TypeAdapter

from asia.ledger._events.ablation import Ablated, AblationFit, LeftOut
from asia.ledger._events.agent import (
    Exchanged,
    SessionEnded,
    SessionStarted,
    Streamed,
    Usage,
)
from asia.ledger._events.confirmation import (
    Confirmed,
    ConfirmedCandidate,
    ConfirmedPair,
    Repeated,
)
from asia.ledger._events.final import RefitCheck, RefitStart, Stack, StackMember, Use
from asia.ledger._events.search import (
    RESUMABLE,
    Again,
    Evaluated,
    Extended,
    FoldEvidence,
    HandedOver,
    HandOverReason,
    Landed,
    Leg,
    Phase,
    Proposed,
    Refitted,
    Resumed,
    Retest,
    RungScored,
    Started,
    Status,
    Steered,
    Stopped,
    StopReason,
)
from asia.ledger._events.test import (
    GuardLooked,
    GuardScore,
    TestBands,
    TestedModel,
    Unsealed,
    Unsealing,
)
from asia.ledger._events.validation import RecordedCheck, Validated

__all__ = [
    "RESUMABLE",
    "Ablated",
    "AblationFit",
    "Again",
    "Confirmed",
    "ConfirmedCandidate",
    "ConfirmedPair",
    "Evaluated",
    "Event",
    "Exchanged",
    "Extended",
    "FoldEvidence",
    "GuardLooked",
    "GuardScore",
    "HandOverReason",
    "HandedOver",
    "Landed",
    "LeftOut",
    "Leg",
    "Phase",
    "Proposed",
    "RecordedCheck",
    "RefitCheck",
    "RefitStart",
    "Refitted",
    "Repeated",
    "Resumed",
    "Retest",
    "RungScored",
    "SessionEnded",
    "SessionStarted",
    "Stack",
    "StackMember",
    "Started",
    "Status",
    "Steered",
    "StopReason",
    "Stopped",
    "Streamed",
    "TestBands",
    "TestedModel",
    "Unsealed",
    "Unsealing",
    "Usage",
    "Use",
    "Validated",
    "adapter",
]

Event = (
    Started | RungScored | Proposed | Evaluated | Landed | HandedOver | Extended | Stopped | Resumed
    | Steered | Exchanged | Streamed | SessionStarted | SessionEnded | Refitted | GuardLooked
    | Unsealing | Unsealed | Repeated | Confirmed | AblationFit | Ablated | Validated
)  # fmt: skip

adapter: TypeAdapter[Event] = TypeAdapter(Annotated[Event, Field(discriminator="event")])
