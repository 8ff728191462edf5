"""Check of the similarity of samples to the training records."""

from __future__ import annotations

import numpy as np

from asia.scoring._validity import Region
from asia.scoring.dossier.check import Check, CheckCurve, Verdict
from asia.scoring.dossier.records import SimulatedBlocks, percent

_DOUBT, _FAIL = 0.1, 0.5
_NO_PAST = 0


def check_region(found: SimulatedBlocks, region: Region) -> Check:
    """The share of samples outside the region of validity; the edge is at 1."""
    distances = [region.distance(b.u[:_NO_PAST], b.u, b.y_hat) for b in found.blocks]
    every = np.concatenate(distances)
    share = float(np.mean(every > 1.0))
    first = next((k for k, d in enumerate(distances) if (d > 1.0).any()), None)
    curves = (CheckCurve("distance", np.arange(len(every), dtype=np.float64), every),)
    words = f"{percent(share)} of the samples are outside the region of the training records"
    if first is not None and share > _DOUBT:
        block = found.blocks[first]
        begin = block.start + int(np.argmax(distances[first] > 1.0))
        words += f", first at {begin * found.sampling_time:.4g} s"
    verdict = Verdict.FAIL if share > _FAIL else Verdict.DOUBT if share > _DOUBT else Verdict.PASS
    return Check("region of validity", verdict, words, None, share / 2.0, curves,
                 ("sample", "distance over that of the edge [-]"))  # fmt: skip
