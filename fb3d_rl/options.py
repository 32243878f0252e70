"""Options that describe themselves: frozen dataclasses whose fields carry a help text, a unit and a range.

A field that :func:`option` makes is a key of the configuration, one that :func:`group` makes a group of keys; other
fields are set by code. Checks, the typed schema that Hydra reads, ``--help`` and docs/configuration.md follow from the
fields. A field of type ``Literal`` has its choices from there, one whose choices can grow from a registry.
"""

from __future__ import annotations

import math
import types
from collections.abc import Collection, Iterator
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass, make_dataclass
from functools import lru_cache, partial
from typing import Any, Literal, Optional, TypeVar, Union, get_args, get_origin, get_type_hints

from fb3d_rl.errors import UserError

Options = TypeVar("Options")
_KEY = "option"


@dataclass(frozen=True)
class About:
    """Description of a field.

    Attributes:
        help: one sentence.
        unit: unit of the number.
        within: range of the number as an interval, such as "[0, 1)" or "(0, inf)"; "" for any.
        null: the meaning of null in a configuration; "" if null is not allowed.
        among: the registry that holds the allowed values, if there is one; entries that are added later count too.
        later: whether the field came after policies had been published, whose digests its default does not change.
    """

    help: str
    unit: str = ""
    within: str = ""
    null: str = ""
    among: Collection[str] = ()
    later: bool = False


def option(
    default: Any,
    help: str,
    unit: str = "",
    within: str = "",
    null: str = "",
    among: Collection[str] = (),
    later: bool = False,
) -> Any:
    """A field that is a key of the configuration; see :class:`About`."""
    about = {_KEY: About(help, unit, within, null, among, later)}
    if isinstance(default, list | dict):
        return field(default_factory=lambda: type(default)(default), metadata=about)
    return field(default=default, metadata=about)


def came_later(item: Field[Any], value: Any) -> bool:
    """Whether a field came later (:class:`About`) and has its default."""
    return item.metadata.get(_KEY, About("")).later and value == item.default


def group(kind: type) -> Any:
    """A field that is a group of keys: the options of class ``kind``."""
    return field(default_factory=kind, metadata={_KEY: About((kind.__doc__ or "").splitlines()[0])})


def keys(kind: type) -> tuple[tuple[Field[Any], Any, About], ...]:
    """The fields of ``kind`` that are keys or groups of keys, each with its type and its description."""
    hints = get_type_hints(kind)
    return tuple((item, hints[item.name], item.metadata[_KEY]) for item in fields(kind) if _KEY in item.metadata)


def taken(kind: type[Options], source: Any, **further: Any) -> Options:
    """The options of class ``kind`` with those values of ``source`` that have the same name, and ``further`` ones."""
    both = {item.name for item in fields(kind)} & {item.name for item in fields(source)}  # type: ignore[arg-type]
    return kind(**{name: getattr(source, name) for name in both} | further)


def content(options: Any) -> dict[str, Any]:
    """The keys of options and of the groups in them with their values, nested as in YAML."""
    values = {item.name: getattr(options, item.name) for item, _, _ in keys(type(options))}
    return {name: content(value) if is_dataclass(value) else value for name, value in values.items()}


def check(options: Any, where: str = "") -> None:
    """Check the values of options and of the groups in them.

    Args:
        options: the options.
        where: prefix of their keys, such as "env.".

    Raises:
        UserError: names the first wrong key and its allowed values.
    """
    for item, kind, about in keys(type(options)):
        value, key = getattr(options, item.name), where + item.name
        if is_dataclass(value):
            check(value, f"{key}.")
        elif value is not None:
            _check_value(key, value, choices(kind, about), about.within)


def _check_value(key: str, value: Any, allowed: tuple[str, ...], within: str) -> None:
    if allowed and value not in allowed:
        raise UserError(f"{key}={value} is unknown; choose from {', '.join(allowed)}")
    if within:
        low, high = _ends(within)
        above = value >= low if within[0] == "[" else value > low
        below = value <= high if within[-1] == "]" else value < high
        if not (above and (below or value == high == math.inf)):
            raise UserError(f"{key}={value} is out of range; give {in_words(within)}")


def _ends(within: str) -> tuple[float, float]:
    low, high = within[1:-1].split(",")
    return float(low), float(high)


def in_words(within: str) -> str:
    """An interval in words: "[0, inf)" -> "0 or more"."""
    low, high = (f"{end:g}" for end in _ends(within))
    if high == "inf":
        return f"{low} or more" if within[0] == "[" else f"more than {low}"
    if within[0] + within[-1] == "()":
        return f"a number between {low} and {high}"
    start = f"from {low}" if within[0] == "[" else f"above {low}"
    return f"a number {start} " + (f"to {high}" if within[-1] == "]" else f"to below {high}")


def choices(kind: Any, about: About) -> tuple[str, ...]:
    """The allowed values of a key, if its registry or its type lists them."""
    if about.among:
        return tuple(about.among)
    listed = [part for part in (kind, *get_args(kind)) if get_origin(part) is Literal]
    return get_args(listed[0]) if listed else ()


def schema(kind: type) -> type:
    """The dataclass for Hydra in place of ``kind``: Hydra supports neither Literal nor tuples nor frozen classes."""
    return _schema(kind)  # a cached function has no type of its own


@lru_cache
def _schema(kind: type) -> type:
    entries: list[tuple[str, Any, Any]] = []
    for item, hint, about in keys(kind):
        typed: Any = _typed(hint)
        if about.null:
            typed = Optional[typed]  # noqa: UP045, of a class that is known only at run time
        factory: Any = item.default_factory
        if is_dataclass(typed):
            factory = typed
        elif isinstance(item.default, tuple):
            factory = partial(list, item.default)
        default: Any = field(default=item.default) if factory is MISSING else field(default_factory=factory)
        entries.append((item.name, typed, default))
    bases = tuple(schema(base) for base in kind.__bases__ if is_dataclass(base) and keys(base))
    return make_dataclass(kind.__name__, entries, bases=bases, namespace={"__options__": kind})


def _typed(hint: Any) -> Any:
    if is_dataclass(hint):
        return schema(hint)  # type: ignore[arg-type]
    if get_origin(hint) is Literal:
        return str
    if get_origin(hint) is tuple:
        return list[get_args(hint)[0]]  # type: ignore[misc]
    if get_origin(hint) in (types.UnionType, Union):
        return Optional[_typed(get_args(hint)[0])]  # noqa: UP045
    return hint


def built(values: Any, where: str = "") -> Any:
    """The checked options with the values of an instance of a :func:`schema`; ``where`` as in :func:`check`.

    Raises:
        UserError: names the first wrong key and its allowed values.
    """
    kind, given = values.__options__, {}
    for item, hint, about in keys(kind):
        value, key = getattr(values, item.name), where + item.name
        if is_dataclass(value):
            value = built(value, f"{key}.")
        elif value is not None:
            _check_value(key, value, choices(hint, about), about.within)
        given[item.name] = tuple(value) if get_origin(hint) is tuple else value
    return kind(**given)


def listing(kind: type, where: str = "") -> Iterator[tuple[str, str, str, str]]:
    """Each key's dotted name, default as in YAML, allowed values and help."""
    for item, hint, about in keys(kind):
        if is_dataclass(hint):
            yield from listing(hint, f"{where}{item.name}.")  # type: ignore[arg-type]
            continue
        default = item.default_factory() if item.default_factory is not MISSING else item.default
        allowed = ", ".join(choices(hint, about)) or (in_words(about.within) if about.within else "")
        parts = [allowed, "null" if about.null or type(None) in get_args(hint) else "", about.unit]
        help = about.help + (f"; null: {about.null}" if about.null else "")
        yield where + item.name, _yaml(default), "; ".join(part for part in parts if part), help


def _yaml(value: Any) -> str:
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(_yaml, value))}]"
    words = {"None": "null", "True": "true", "False": "false", "inf": ".inf"}
    return words.get(str(value), str(value))
