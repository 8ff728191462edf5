"""Columns of time as seconds: exactly one way to write time must fit a column and all evidence."""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import date, datetime, time, timedelta
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from asia._text import suggestion
from asia.data.intake.sheet import Cells, FileTable, Wanted, find_column, require_column, split_unit
from asia.data.intake.text import number, to_numbers
from asia.data.trajectory import Array
from asia.errors import UserError

_DAY = 86400
_SECOND = 10**9
"""Ticks in a second: stamps are compared in whole nanoseconds."""
_Ticks = NDArray[np.int64]

# Words for units of time and for the order of dates and clocks.


@dataclass(frozen=True)
class _Unit:
    factor: float
    name: str
    words: str
    ranges: tuple[tuple[float, float], ...] = ()
    """Values that numbers without a unit have in this one: times since 1970, days of Excel and of
    MATLAB."""


_YEARS = 6.3e8, 2.9e9
"""Seconds from 1970 to 1990 and to 2061."""
_UNITS = (
    _Unit(1.0, "seconds", "s sec secs second sek sekunde sekunden", ((-np.inf, 1e10),)),
    _Unit(1e-3, "milliseconds", "ms msec msecs millis millisec millisecond millisekunde "
          "millisekunden", ((1e3 * _YEARS[0], 1e3 * _YEARS[1]),)),
    _Unit(1e-6, "microseconds", "us µs usec usecs µsec micros microsec microsecond mikrosekunde "
          "mikrosekunden", ((1e6 * _YEARS[0], 1e6 * _YEARS[1]),)),
    _Unit(1e-9, "nanoseconds", "ns nsec nanos nanosecond nanosekunde nanosekunden",
          ((1e9 * _YEARS[0], 1e9 * _YEARS[1]),)),
    _Unit(60.0, "minutes", "min mins minute minuten"),
    _Unit(3600.0, "hours", "h hr hrs hour std stunde stunden"),
    _Unit(86400.0, "days", "d day tag tage", ((20_000, 80_000), (700_000, 800_000))),
    _Unit(604800.0, "weeks", "week woche wochen"),
)  # fmt: skip
# In lower case the micro sign and the Greek letter are one character.
_WORDS = {
    word.casefold(): unit for unit in _UNITS for word in (*unit.words.split(), unit.name)
}  # fmt: skip
_ORDERS = ("day-first", "month-first", "year-first")
_FORMS = (*_ORDERS, "h:m", "m:s", "12-hour", "24-hour", "YYYYMMDD", "HHMMSS", "HHMM")
_NO_UNITS = ("", "utc", "gmt", "unix", "epoch", "posix", "local", "ts", "cet", "mez", "excel")
"""Words beside the name of a column of numbers that say nothing about its unit."""


def check_time_unit(given: str | None) -> frozenset[str]:
    """Units and forms that `--time-unit` names. Raises UserError for an unknown word."""
    forms = {form.casefold(): form for form in _FORMS}
    found: set[str] = set()
    for word in re.split(r"[\s,]+", given.strip()) if given else ():
        unit = _WORDS.get(word.casefold())
        if unit is None and word.casefold() not in forms:
            raise UserError(
                f"--time-unit is '{word}', expected ns, us, ms, s, min, h or d, or for dates and "
                f"clocks {', '.join(_FORMS)}{suggestion(word, _every_word())}"
            )
        found.add(forms[word.casefold()] if unit is None else unit.name)
    return frozenset(found)


def _every_word() -> list[str]:
    return [word for unit in _UNITS for word in (unit.name, *unit.words.split())] + list(_FORMS)


def _hints(label: str, unit: str) -> frozenset[str]:
    """Order of dates and clocks that a header says, such as `Time (hh:mm)` or `TT.MM.JJJJ`."""
    text = f"{label} {unit}".casefold().replace("t", "d").replace("j", "y")
    shapes = {
        "day-first": r"\bdd?[-/. ]mm?[-/. ]y", "month-first": r"\bmm?[-/. ]dd?[-/. ]y",
        "year-first": r"\by+[-/. ]mm?[-/. ]d", "h:m": r"\bhh?:mm?\b|uhrzeid|dime of day",
        "m:s": r"(?<!:)\bmm?:ss?\b",
    }  # fmt: skip
    return frozenset(tag for tag, shape in shapes.items() if re.search(shape, text))


# Columns that hold time, found by name or content.


_CLOCKS = (
    "t", "time", "timestamp", "time stamp", "time_stamp", "datetime", "date time", "date/time",
    "date_time", "uhrzeit", "zeit", "zeitstempel", "zeitpunkt", "temps", "elapsed", "elapsed time",
    "elapsed_time", "clock", "tmstamp", "x_value",
)  # fmt: skip
_DATES = ("date", "datum", "day", "tag")
_NUMBERED = ("index", "__index_level_0__")
_LIKE_TIME = re.compile(
    r"(?i)(?<![a-z])(time|times|timestamp|datetime|date|datum|\w*zeit|zeitstempel|elapsed|clock|"
    r"stamp)(?![a-z])"
)
_ENDING = re.compile(
    r"(?i)^(?P<name>.+?)(?:\s*/\s*|\s+in\s+|\s*[_,.]\s*|\s+)(?P<unit>[a-zµμ]+)\.?$"
)
_CAMEL = re.compile(r"^(?P<name>[a-z]+|[A-Z][a-z]+)(?P<unit>[A-Z][a-z]*)$")


def _name_and_units(label: str) -> tuple[str, list[str]]:
    """Split `time_ms [ms]` into the name and every unit that stands beside it."""
    bare, bracketed = split_unit(label)
    ended = _ENDING.match(bare) or _CAMEL.match(bare)
    if ended is not None and ended["unit"].casefold() in _WORDS:
        return ended["name"].strip(), [bracketed, ended["unit"]]
    if (len(bare) > 3 and bare.casefold() in _WORDS) or bare.casefold() in ("ms", "us", "µs"):
        return bare, [bracketed, bare]
    return bare, [bracketed]


def may_be_time(label: str) -> bool:
    """Return whether the name of a column suggests dates or times."""
    name = _name_and_units(label)[0].casefold()
    return name in (*_CLOCKS, *_DATES, *_NUMBERED) or bool(_LIKE_TIME.search(label))


def time_column(sheet: FileTable, wanted: Wanted) -> str | None:
    """Return the name of the column with the sample times; None without one. Raises UserError when
    the named column is missing or ambiguous."""
    if wanted.time == "none":
        return None
    if wanted.time is not None:
        require_column(sheet, wanted.time)
        return find_column(list(sheet.columns), wanted.time)
    taken = {find_column(list(sheet.columns), n) for n in wanted.names}
    free = [n for n in sheet.columns if n not in taken and not _is_count(n, sheet)]
    for name in sheet.repeated:
        if name not in wanted.names and _name_and_units(name)[0].casefold() in (*_CLOCKS, *_DATES):
            raise UserError(f"{sheet.where}: {sheet.repeated_text(name)}")
    named = {_name_and_units(name)[0].casefold(): name for name in reversed(free)}
    for candidate in (*_CLOCKS, *_DATES, *_NUMBERED):
        if candidate in named:
            return named[candidate]
    units = [n for n in free if len(_name_and_units(n)[1]) > 1 or _LIKE_TIME.search(n)]
    rising = (n for n in units if _rises(sheet.columns[n].cells))
    return next(chain(rising, (n for n in free if _holds_stamps(sheet, n))), None)


def _rises(cells: Cells) -> bool:
    """Return whether all steps of a column of numbers are above 0, but for a few new starts."""
    values = np.array([np.nan if (v := number(c)) is None else v for c in cells.tolist()[:5000]])
    steps = np.diff(values[np.isfinite(values)])
    return steps.size > 1 and bool((steps > 0).mean() > 0.9)


def _is_count(name: str, sheet: FileTable) -> bool:
    """Return whether an index only numbers the rows."""
    cells = sheet.columns[name].cells
    if name.casefold() not in _NUMBERED or len(cells) < 2:
        return False
    try:
        return bool((np.diff(cells.astype(np.float64)) == 1.0).all())
    except (TypeError, ValueError):
        return False


def _holds_stamps(sheet: FileTable, name: str) -> bool:
    """Return whether the first cells of a column are different dates or times of the day."""
    cells = sheet.columns[name].cells
    if cells.dtype.kind in "Mfiu":
        return cells.dtype.kind == "M"
    filled = [text for text in _texts(cells[:50]) if text]
    if len(set(filled)) < 2 or number(filled[0]) is not None:
        return False
    return any(p.matches(filled) for p in _TEXTS if p.expression)


# Cells as texts, and the columns that belong to a column of time.


def _texts(cells: Cells) -> list[str]:
    """Cells as texts, dates in ISO form; "" where one is missing."""
    if cells.dtype.kind == "M":
        days = cells == cells.astype("datetime64[D]")
        whole = bool((days | np.isnat(cells)).all())
        return ["" if np.isnat(c) else str(c)[:10] if whole else str(c) for c in cells]
    values: list[object] = cells.tolist()
    midnight = all(
        isinstance(v, date) and (not isinstance(v, datetime) or v.time() == time())
        for v in values
        if v is not None
    )
    return [_text(v, midnight=midnight) for v in values]


def _text(value: object, *, midnight: bool) -> str:
    if isinstance(value, float):
        return "" if value != value else f"{value:.0f}" if value.is_integer() else repr(value)
    if isinstance(value, datetime):
        return value.isoformat(" ")[:10] if midnight else value.isoformat(" ")
    if isinstance(value, timedelta):
        whole, part = divmod(value / timedelta(microseconds=1), 1e6)
        minutes, seconds = divmod(int(whole), 60)
        return f"{minutes // 60}:{minutes % 60:02d}:{seconds:02d}.{int(part):06d}"
    if isinstance(value, date | time):
        return value.isoformat()
    return "" if value is None else str(value).strip()


@dataclass(frozen=True)
class _Column:
    """A column of time with all that belongs to it."""

    name: str
    where: str
    first_line: int
    texts: Sequence[str]
    """Cells, with the date and the half of the day from columns beside it where there are any."""
    numbers: Array | None
    """The cells, where they are numbers."""
    dates: Sequence[str] = ()
    """Cells of a column with dates beside a column of numbers."""


def _gathered(sheet: FileTable, name: str) -> _Column:
    """Join the column with those of the date and of AM or PM beside it, in whatever order."""
    where, first_line = f"{sheet.where}, column '{name}'", sheet.first_line
    cells = sheet.columns[name].cells
    texts = _texts(cells)
    filled = [text for text in texts if text][:50]
    if not filled:
        raise UserError(f"{where}: no time stamp at all")
    is_number = cells.dtype.kind in "fiu" or sum(number(t) is not None for t in filled) * 2 > len(
        filled
    )
    is_clock = not is_number and any(p.matches(filled) for p in _TEXTS if not p.is_dated)
    others = [n for n in sheet.columns if n != name and len(sheet.columns[n].cells) == len(cells)]
    if is_clock or is_number:
        dates = _companion(sheet, others, _DATES, lambda t: any(
            p.matches(t) for p in _TEXTS if p.is_dated and not p.has_clock(t)), numbers=is_number,
        )  # fmt: skip
        numbers = to_numbers(cells, where, first_line) if is_number else None
        if numbers is not None and (not dates or (numbers % 1 > 0).any()):
            return _Column(name, where, first_line, texts, numbers)
        if dates:
            days = _texts(sheet.columns[dates].cells)
            if is_number:
                return _Column(name, where, first_line, texts, numbers, days)
            name = f"{dates} and {name}"
            texts = [f"{d} {t}" if d and t else "" for d, t in zip(days, texts, strict=True)]
    elif not any(p.has_clock(filled) for p in _TEXTS if p.is_dated):
        clock = _companion(
            sheet, others, _CLOCKS,
            lambda t: any(p.matches(t) for p in _TEXTS if p.expression and not p.is_dated),
        )  # fmt: skip
        if clock and len(set(filled)) < len(filled):
            return _gathered(sheet, clock)
    half = _companion(sheet, others, (), lambda t: all(re.fullmatch(_HALF, c) for c in t))
    if half and not is_number:
        halves = _texts(sheet.columns[half].cells)
        texts = [f"{t} {h}" if t else "" for t, h in zip(texts, halves, strict=True)]
    return _Column(name, where, first_line, texts, None)


def _companion(
    sheet: FileTable,
    others: Sequence[str],
    names: Sequence[str],
    fits: Callable[[Sequence[str]], bool],
    *,
    numbers: bool = False,
) -> str | None:
    """The column beside a column of time whose cells fit, one with such a name before any other;
    the order of the columns plays no part.

    Args:
        numbers: whether only a column with such a name counts
    """
    found: list[tuple[bool, str]] = []
    for other in others:
        is_named = split_unit(other)[0].casefold() in names
        cells = sheet.columns[other].cells
        if (cells.dtype.kind == "f" or numbers) and not is_named:
            continue
        texts = [text for text in _texts(cells) if text]
        if texts and (fits(texts[:50]) or (is_named and _compact(texts[:50]))):
            found.append((not is_named, other))
    return min(found)[1] if found else None


def _compact(texts: Sequence[str]) -> bool:
    return all(re.fullmatch(r"(?:19|20)\d{6}", text) for text in texts)


# Patterns: each reads a whole column, or does not fit it.


_HALF = r"(?i:[ap]\.?\s?m\.?)"
_MONTHS = {
    "jan": 1, "feb": 2, "mar": 3, "mär": 3, "mrz": 3, "apr": 4, "may": 5, "mai": 5, "jun": 6,
    "jul": 7, "aug": 8, "sep": 9, "oct": 10, "okt": 10, "nov": 11, "dec": 12, "dez": 12,
}  # fmt: skip
_ZONES = {
    "z": 0, "utc": 0, "gmt": 0, "cet": 1, "mez": 1, "bst": 1, "cest": 2, "mesz": 2, "est": -5,
    "edt": -4, "cst": -6, "cdt": -5, "mst": -7, "mdt": -6, "pst": -8, "pdt": -7,
}  # fmt: skip
_ZONE = rf"(?:\s*(?P<z>[+-]\d\d(?::?\d\d)?|{'|'.join(sorted(_ZONES, key=len, reverse=True))}))?"
_YEAR, _SHORT, _M, _D = r"(?P<Y>(?:19|20)\d\d)", r"(?P<Y>\d\d)", r"(?P<M>\d\d?)", r"(?P<D>\d\d?)"
_EITHER = r"(?P<Y>(?:19|20)\d\d|\d\d)"
_B = r"(?P<b>[a-zä]{3})[a-zäö]*\.?"
_CLOCK = (
    r"(?P<H>\d\d?)(?P<c>[:.h])(?P<m>\d\d?)(?:(?P=c)(?P<S>\d\d?)(?:[.,:](?P<f>\d{1,9})\d*)?)?"
    rf"(?:\s*(?P<p>{_HALF}))?{_ZONE}"
)
_TIGHT = r"(?P<H>\d\d)(?:(?P<m>\d\d)(?:(?P<S>\d\d)(?:[.,]?(?P<f>\d{1,9}))?)?)?" + _ZONE
_ELAPSED = (
    r"(?:(?P<d>\d+)(?: days? |\.))?(?P<H>\d{1,4}):(?P<m>\d\d?)"
    rf"(?::(?P<S>\d\d?)(?:[.,:](?P<f>\d{{1,9}})\d*)?)?(?:\s*(?P<p>{_HALF}))?{_ZONE}"
)
_WEEKDAY = r"(?:(?:mo|tu|we|th|fr|sa|su|di|mi|do|so)[a-z]*[.,]?\s+)?"
_JOIN = r"(?:\s*[T ,;_-]\s*)"


@dataclass(frozen=True)
class _Pattern:
    """One way to write time."""

    name: str
    """As it is printed; for a unit of numbers, the unit."""
    tags: frozenset[str]
    """Words of `--time-unit` that choose it."""
    read: Callable[["_Pattern", _Column], Array | None]
    """Seconds after the first stamp, NaN where one is missing; None where a cell does not fit."""
    expression: str = ""
    period: int = 0
    """Seconds after which the clock begins anew; 0 with a date."""
    unit: _Unit | None = None

    @property
    def is_dated(self) -> bool:
        """Whether it contains a date."""
        return "(?P<Y>" in self.expression

    def match(self, text: str) -> re.Match[str] | None:
        """The parts of a stamp."""
        return re.compile(self.expression, re.IGNORECASE).fullmatch(text)

    def matches(self, texts: Sequence[str]) -> bool:
        """Return whether it has the form of all these stamps."""
        return bool(self.expression) and all(self.match(text) for text in texts)

    def has_clock(self, texts: Sequence[str]) -> bool:
        """Return whether the dates have a time of the day."""
        found = [self.match(text) for text in texts]
        return any(one is not None and one.groupdict().get("H") for one in found)


def _read_numbers(pattern: _Pattern, column: _Column) -> Array | None:
    """Numbers in one unit. Digits beyond double precision count."""
    numbers, unit = column.numbers, pattern.unit
    if numbers is None or unit is None:
        return None
    first = numbers[np.isfinite(numbers)][0]
    if abs(first) >= 2.0**53 and all(re.fullmatch(r"-?\d*", text) for text in column.texts):
        base = int(next(filter(None, column.texts)))
        return unit.factor * np.array([int(t) - base if t else np.nan for t in column.texts])
    return (numbers - first) * unit.factor


def _read_texts(pattern: _Pattern, column: _Column) -> Array | None:
    """Dates and clocks."""
    compiled = re.compile(pattern.expression, re.IGNORECASE)
    texts = column.texts
    width = 6 if "HHMMSS" in pattern.tags else 4 if "HHMM" in pattern.tags else 0
    is_number = column.numbers is not None
    if (is_number and not width and "YYYYMMDD" not in pattern.tags) or (
        width and not (is_number and column.dates)
    ):
        return None
    if width:
        pairs = zip(column.dates, texts, strict=True)
        texts = [f"{day} {text:0>{width}}" if day and text else "" for day, text in pairs]
    found: list[re.Match[str]] = []
    for text in texts:
        match = compiled.fullmatch(text) if text else None
        if match is not None:
            found.append(match)
        elif text:
            return None
    groups = compiled.groupindex

    def whole(key: str, default: int = 0) -> _Ticks:
        if key not in groups:
            return np.full(len(found), default, np.int64)
        return np.array([int(m[key] or default) for m in found], np.int64)

    hour, minute, second = whole("H"), whole("m"), whole("S")
    if (minute > (59 if "H" in groups else 999)).any() or (second > 59).any():
        return None
    days = whole("d")
    if pattern.is_dated:
        dated = _days(found, groups, whole)
        # 24:00 ends a day.
        if dated is None or (hour > 24).any() or ((hour == 24) & (minute + second > 0)).any():
            return None
        days = dated
    halves = {m["p"].casefold()[0] if m["p"] else "" for m in found} if "p" in groups else {""}
    if halves != {""} or "12-hour" in pattern.tags:
        if ("" in halves and halves != {""}) or not ((hour >= 1) & (hour <= 12)).all():
            return None
        hour = hour % 12
        if halves != {""}:
            if "12-hour" in pattern.tags:
                return None
            hour += [12 * (m["p"].casefold()[0] == "p") for m in found]
    ticks = (((days * 24 + hour) * 60 + minute) * 60 + second) * _SECOND
    if "f" in groups:
        ticks += [int((m["f"] or "0").ljust(9, "0")) for m in found]
    if "z" in groups:
        ticks -= np.array([_offset(m["z"]) for m in found], np.int64) * _SECOND
    if pattern.period and (pattern.is_dated or int(ticks.max()) < pattern.period * _SECOND):
        ticks = _unwrapped(ticks, pattern.period * _SECOND)
    seconds = np.full(len(texts), np.nan)
    seconds[[bool(text) for text in texts]] = (ticks - ticks[0]) * 1e-9
    return seconds


def _unwrapped(ticks: _Ticks, period: int) -> _Ticks:
    """Stamps of a clock that begins anew, each within half a period of the one before."""
    steps = np.diff(ticks)
    return np.cumsum([0, *(steps - period * np.rint(steps / period).astype(np.int64))])


def _days(
    found: Sequence[re.Match[str]], groups: object, whole: Callable[..., _Ticks]
) -> _Ticks | None:
    """Days since 1970; None where one is no day of the calendar."""
    names = {key for match in found[:1] for key in match.groupdict()}
    year = whole("Y")
    year = np.where(year < 70, year + 2000, np.where(year < 100, year + 1900, year))
    if "j" in names:
        start = (year - 1970).astype("datetime64[Y]").astype("datetime64[D]").astype(np.int64)
        return start + whole("j") - 1
    if "b" in names:
        months = [_MONTHS.get(match["b"].casefold(), 0) for match in found]
        month = np.array(months, np.int64)
    else:
        month = whole("M")
    day = whole("D")
    if ((month < 1) | (month > 12) | (day < 1)).any():
        return None
    count = (year - 1970) * 12 + month - 1
    start = count.astype("datetime64[M]").astype("datetime64[D]").astype(np.int64)
    after = (count + 1).astype("datetime64[M]").astype("datetime64[D]").astype(np.int64)
    return None if (start + day > after).any() else start + day - 1


def _offset(zone: str | None) -> int:
    """Seconds from UTC to a time zone."""
    if not zone:
        return 0
    if zone.casefold() in _ZONES:
        return 3600 * _ZONES[zone.casefold()]
    digits = zone[1:].replace(":", "").ljust(4, "0")
    size = 3600 * int(digits[:2]) + 60 * int(digits[2:])
    return -size if zone[0] == "-" else size


def _dated(order: str, day: str) -> Iterator[_Pattern]:
    name = order.replace("-", " ")
    for form, period in (("24-hour", 0), ("12-hour", _DAY // 2)):
        yield _Pattern(
            name + (", 12-hour clock" if period else ""), frozenset((order, form)), _read_texts,
            rf"{_WEEKDAY}{day}(?:{_JOIN}{_CLOCK})?", period,
        )  # fmt: skip


_TEXTS: tuple[_Pattern, ...] = (
    *_dated("year-first", rf"{_YEAR}(?P<s>[-/.]){_M}(?P=s){_D}"),
    *_dated("day-first", rf"{_D}(?P<s>[-/.]){_M}(?P=s)\s?{_EITHER}"),
    # Dates with points have the day first.
    *_dated("month-first", rf"{_M}(?P<s>[-/]){_D}(?P=s){_EITHER}"),
    *_dated("year-first", rf"{_SHORT}(?P<s>[-/.]){_M}(?P=s){_D}"),
    *_dated("day-first", rf"{_D}[-. /]*{_B}[-, /]*{_EITHER}"),
    *_dated("month-first", rf"{_B}[-. /]+{_D},?[-. /]+{_EITHER}"),
    _Pattern("month first", frozenset(("month-first", "24-hour")), _read_texts,
             rf"{_WEEKDAY}{_B} +{_D} +{_CLOCK} +{_EITHER}"),
    _Pattern("year and day of the year", frozenset(("year-first",)), _read_texts,
             rf"{_YEAR}-(?P<j>\d\d\d)(?:{_JOIN}{_CLOCK})?"),
    _Pattern("digits YYYYMMDD", frozenset(("YYYYMMDD", "24-hour")), _read_texts,
             rf"{_YEAR}(?P<M>\d\d)(?P<D>\d\d)(?:{_JOIN}{_CLOCK})?"),
    _Pattern("digits YYYYMMDDhhmmss", frozenset(("YYYYMMDD", "24-hour")), _read_texts,
             rf"{_YEAR}(?P<M>\d\d)(?P<D>\d\d)(?:[T ]?{_TIGHT})?"),
    *(
        _Pattern(f"digits {form} beside a date", frozenset((order, form)), _read_texts,
                 rf"{day} (?P<H>\d\d)(?P<m>\d\d){second}")
        for form, second in (("HHMMSS", r"(?P<S>\d\d)"), ("HHMM", ""))
        for order, day in (
            ("year-first", rf"{_YEAR}(?P<s>[-/.]?)(?P<M>\d\d)(?P=s)(?P<D>\d\d)"),
            ("day-first", rf"{_D}(?P<s>[-/.]){_M}(?P=s){_EITHER}"),
            ("month-first", rf"{_M}(?P<s>[-/]){_D}(?P=s){_EITHER}"),
        )
    ),
    _Pattern("clock h:m", frozenset(("h:m", "24-hour")), _read_texts, _ELAPSED, _DAY),
    _Pattern("clock h:m, 12-hour clock", frozenset(("h:m", "12-hour")), _read_texts, _ELAPSED,
             _DAY // 2),
    _Pattern("clock m:s", frozenset(("m:s",)), _read_texts,
             r"(?P<m>\d{1,3}):(?P<S>\d\d)(?:[.,](?P<f>\d{1,9})\d*)?", 3600),
)  # fmt: skip
_PATTERNS: tuple[_Pattern, ...] = (
    *(_Pattern(u.name, frozenset((u.name,)), _read_numbers, unit=u) for u in _UNITS),
    *_TEXTS,
)


# The choice of the one pattern that fits.


@dataclass(frozen=True)
class Timeline:
    """Sample times of a file, and how they were read."""

    seconds: Array
    """Seconds after the first stamp, NaN where one is missing."""
    text: str
    """Column and pattern, with the evidence for it."""


@dataclass(frozen=True)
class _Fit:
    """A pattern that fits a whole column."""

    pattern: _Pattern
    seconds: Array

    @property
    def step(self) -> float:
        """Median step in seconds."""
        known = self.seconds[np.isfinite(self.seconds)]
        return float(np.median(np.diff(known))) if len(known) > 1 else 0.0

    @property
    def breaks(self) -> frozenset[int]:
        """Rows after which the next stamp is not one step later."""
        known = self.seconds[np.isfinite(self.seconds)]
        steps, size = np.diff(known) * np.sign(self.step or 1.0), abs(self.step)
        return frozenset(np.flatnonzero((steps < 0.5 * size) | (steps > 1.5 * size)).tolist())

    def same(self, other: "_Fit") -> bool:
        """Return whether both give the same records."""
        return self.breaks == other.breaks and abs(self.step - other.step) <= 1e-3 * abs(self.step)


def read_times(sheet: FileTable, name: str, wanted: Wanted) -> Timeline:
    """Read the sample times of a column, to the nanosecond.

    Raises:
        UserError: where no pattern fits the column, or several do and the evidence does not
            decide between them
    """
    cells = sheet.columns[name].cells
    asked = check_time_unit(wanted.time_unit)
    if cells.dtype.kind == "M" and not asked:
        stamps = cells.astype("datetime64[ns]")
        known = stamps[~np.isnat(stamps)]
        if not known.size:
            raise UserError(f"{sheet.where}, column '{name}': no time stamp at all")
        seconds = (stamps - known[0]).astype(np.float64) * 1e-9
        seconds[np.isnat(stamps)] = np.nan
        return Timeline(np.round(seconds, 9), f"column {name} (dates)")
    column = _gathered(sheet, name)
    stated = asked or _stated(sheet, name, column)
    fits = _fits(column, stated)
    if not fits and asked:
        raise UserError(
            f"{column.where}: the stamps are not {' '.join(sorted(asked))}, as --time-unit says"
        )
    if not fits:
        raise _unlike(column)
    left = _decided(fits, sheet, name, column)
    if len(left) > 1:
        first, second = left[:2]
        raise UserError(
            f"{column.where}: '{next(filter(None, column.texts))}' and the others can be read "
            f"as {first.pattern.name} (sampled every {first.step:g} s) or as {second.pattern.name} "
            f"(every {second.step:g} s): give --time-unit {_option(first, second)} or --time-unit "
            f"{_option(second, first)} (time_unit in [data])"
        )
    chosen = left[0]
    seconds = np.round(chosen.seconds, 9)
    label = column.name if chosen.pattern.unit is None else split_unit(name)[0]
    return Timeline(seconds, f"column {label} ({_described(chosen, fits, column, stated)})")


def _option(one: _Fit, other: _Fit) -> str:
    own = one.pattern.tags - other.pattern.tags
    return next((form for form in _FORMS if form in own), "".join(own))


def _described(chosen: _Fit, fits: Sequence[_Fit], column: _Column, stated: frozenset[str]) -> str:
    """The chosen pattern in words."""
    pattern, unit = chosen.pattern, chosen.pattern.unit
    if unit is not None:
        if stated:
            return unit.name
        first = (
            abs(float(column.numbers[np.isfinite(column.numbers)][0]))
            if column.numbers is not None
            else 0.0
        )
        if _YEARS[0] < first * unit.factor < _YEARS[1]:
            return f"{unit.name} since 1970"
        return f"no unit, {unit.name} assumed; --time-unit decides"
    example = next(filter(None, column.texts))
    ruled_out = [f.pattern.name for f in fits if not f.same(chosen)]
    more = f"; {ruled_out[0]} would break the steps" if ruled_out else ""
    return f"{pattern.name}, such as {example}{more}"


def _stated(sheet: FileTable, name: str, column: _Column) -> frozenset[str]:
    """Unit or form that the header or the unit row gives. Raises UserError for a unit that is not
    known, and for two units."""
    row = sheet.columns[name].unit
    words = [word.strip(" .") for word in (row, *_name_and_units(name)[1])]
    if column.numbers is None:
        return _hints(name, row)
    units = {_WORDS[w.casefold()].name for w in words if w.casefold() in _WORDS}
    if len(units) > 1:
        raise UserError(
            f"{column.where}: the header gives two units, {' and '.join(sorted(units))}: correct "
            "it, or give --time-unit (time_unit in [data])"
        )
    strange = [w for w in words if w.casefold() not in (*_WORDS, *_NO_UNITS)]
    hints = _hints(name, row)
    if strange and not units and not hints:
        near = suggestion(strange[0], [w for w in _every_word() if w not in _FORMS])
        raise UserError(
            f"{column.where}: '{strange[0]}' is no unit of time: correct the header, or give "
            f"--time-unit s, ms, us, ns, min, h or d (time_unit in [data]){near}"
        )
    return frozenset(units)


def _fits(column: _Column, stated: frozenset[str]) -> list[_Fit]:
    """Patterns that fit the whole column and what is stated."""
    fits: list[_Fit] = []
    for pattern in _PATTERNS:
        if not _agrees(pattern, stated):
            continue
        if pattern.unit and not stated and not _is_possible(pattern.unit, column.numbers):
            continue
        seconds = pattern.read(pattern, column)
        if seconds is not None:
            fits.append(_Fit(pattern, seconds))
    return fits


def _agrees(pattern: _Pattern, stated: frozenset[str]) -> bool:
    """Return whether a pattern contradicts nothing that is stated."""
    if pattern.unit is not None:
        return not stated or pattern.unit.name in stated
    groups = (_ORDERS, ("h:m", "m:s"), ("12-hour", "24-hour"), ("YYYYMMDD", "HHMMSS", "HHMM"))
    for group in groups:
        named = stated & set(group)
        if named and pattern.tags & set(group) and not named & pattern.tags:
            return False
    return not stated or stated <= set(_FORMS)


def _is_possible(unit: _Unit, numbers: Array | None) -> bool:
    if numbers is None:
        return False
    known = numbers[np.isfinite(numbers)]
    return any(low < known.min() and known.max() < high for low, high in unit.ranges)


def _decided(fits: Sequence[_Fit], sheet: FileTable, name: str, column: _Column) -> list[_Fit]:
    """Fits that are left by the evidence, one of each that give the same records."""
    left: list[_Fit] = []
    for fit in fits:
        if not any(fit.same(other) for other in left):
            left.append(fit)
    # A pattern that breaks the steps where another one does not is wrong.
    left = [f for f in left if not any(other.breaks < f.breaks for other in left)]
    is_dated = re.search(r"(?i)date|stamp|datum|excel", split_unit(name)[0])
    if len(left) > 1 and is_dated:
        left = [f for f in left if f.pattern.name != "seconds"]
    elif (
        len(left) > 1
        and column.numbers is not None
        and (even := [f for f in left if _is_natural(abs(f.step))])
    ):
        left = even
    if len(left) > 1:
        steps = [step for other in sheet.columns if other != name and (step := _step(sheet, other))]
        left = [f for f in left if any(abs(f.step - s) <= 0.01 * abs(s) for s in steps)] or left
    return left


def _step(sheet: FileTable, name: str) -> float | None:
    """Step of another column of time of the same file; None where it is none, or ambiguous."""
    if not may_be_time(name):
        return None
    try:
        column = _gathered(sheet, name)
        fits = _fits(column, _stated(sheet, name, column))
    except UserError:
        return None
    if any(f.pattern.name == "seconds" and f.pattern.unit for f in fits) and not _stated(
        sheet, name, column
    ):
        return None
    alike = all(f.same(fits[0]) for f in fits)
    return fits[0].step if fits and alike and fits[0].step > 0 else None


def _is_natural(step: float) -> bool:
    """Return whether a step, or its rate, is one that people set."""
    if step <= 0:
        return False
    minutes = (1, 2, 3, 4, 5, 6, 10, 12, 15, 20, 30, 60, 120, 180, 240, 360, 480, 720, 1440, 10080)
    named = any(abs(step - 60 * m) < 5e-4 * step for m in minutes)
    return named or _is_round(step) or _is_round(1.0 / step)


def _is_round(value: float) -> bool:
    return abs(float(f"{value:.2g}") - value) < 5e-4 * value


def _unlike(column: _Column) -> UserError:
    """The error that names the first stamp unlike those before it."""
    rows = [k for k, text in enumerate(column.texts) if text]

    def fitting(pattern: _Pattern) -> int:
        for place, k in enumerate(rows):
            if (
                pattern.read(pattern, replace(column, texts=[column.texts[k]], numbers=None))
                is None
            ):
                return place
        return len(rows)

    place = min(max(map(fitting, _TEXTS)), len(rows) - 1)
    k = rows[place]
    return UserError(
        f"{column.where}, line {column.first_line + k}: '{column.texts[k]}' is not a time stamp "
        "like the others: write 2026-01-31T12:00:00.250"
    )
