"""Facts and cautions of the build report's sections, made from tables of its numbers."""

from typing import Any

from twin.report.html import Caution, Fact, number, pick

Row = tuple[str, str, str, str]
"""Path of a number in the report, its name, its format, and its meaning."""
Limit = tuple[str, float, str, str]
"""Path of a number in the report, the limit of its magnitude, and the caution and its cure above the limit."""


def facts_of(report: dict[str, Any], *rows: Row) -> list[Fact]:
    """A fact for each row; its value is "not measured" if the report lacks the number."""
    return [Fact(name, number(pick(report, path), form), meaning) for path, name, form, meaning in rows]


def cautions_above(report: dict[str, Any], *limits: Limit) -> list[Caution]:
    """Cautions about the numbers whose magnitude exceeds their limit.

    The caution in a `Limit` is a format string for the magnitude and the limit.
    """
    found = [(as_number(pick(report, path)), limit, what, cure) for path, limit, what, cure in limits]
    return [
        Caution(what.format(abs(x), limit), cure) for x, limit, what, cure in found if x is not None and abs(x) > limit
    ]


def as_number(value: Any) -> float | None:
    """The value if it is a number, else None."""
    return value if isinstance(value, int | float) and not isinstance(value, bool) else None
