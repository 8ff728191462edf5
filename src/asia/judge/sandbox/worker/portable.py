"""Bytes of a fitted model that name no place of this machine, so that a run can be published.

A model that holds a function of a library, such as a closure, is pickled with its code, and code
names the file that it was read from.
"""

import os
import pickletools
import re
import struct
import sys
from collections.abc import Iterable

# Alike on most machines, and too short to tell from other words.
_GENERAL = frozenset(("/", "/usr", "/usr/local", "/tmp", "/lib", "/lib64", "/bin"))
_STRINGS = frozenset(("SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8"))


class PlaceError(Exception):
    """Error for a path of this machine that cannot be left out."""


def places_here(packages: Iterable[str] = ()) -> tuple[str, ...]:
    """Return the folders that only this process uses, each with a trailing slash.

    Args:
        packages: folders of packages that have a place of their own
    """
    found = [os.getcwd(), os.environ.get("HOME", ""), sys.prefix, sys.base_prefix, *sys.path]
    found += [os.path.dirname(place) for place in packages]
    real = {os.path.realpath(place) for place in found if os.path.isabs(place)}
    known = {os.path.normpath(place) for place in found if os.path.isabs(place)} | real
    return tuple(f"{place}/" for place in sorted(known - _GENERAL))


def portable(pickled: bytes, places: tuple[str, ...]) -> bytes:
    """Remove these paths from the strings of a pickle: `/home/me/lib/scipy/odr.py` becomes
    `scipy/odr.py`. Raises PlaceError where one occurs in bytes, which must not change."""
    if not any(place.encode() in pickled for place in places):
        return pickled
    known = "|".join(map(re.escape, sorted(places, key=len, reverse=True)))
    pattern = re.compile(rf"(?<![\w./-])(?:{known})")
    answer = bytearray()
    rest = [(code.name, argument, place) for code, argument, place in pickletools.genops(pickled)]
    ends = [*(place for _, _, place in rest[1:]), len(pickled)]
    for (name, argument, start), end in zip(rest, ends, strict=True):
        if name == "FRAME":  # its length would no longer be right, and nothing needs it
            continue
        if name in _STRINGS and isinstance(argument, str) and pattern.search(argument):
            text = pattern.sub("", argument).encode("utf-8", "surrogatepass")
            answer += b"\x8d" + struct.pack("<Q", len(text)) + text  # BINUNICODE8
            continue
        if isinstance(argument, bytes | bytearray) and pattern.search(argument.decode("latin-1")):
            raise PlaceError
        answer += pickled[start:end]
    return bytes(answer)
