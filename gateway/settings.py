"""Base of all settings: frozen, strict, and documented where they are declared.

A stage declares its own `…Settings(Settings)` in the file of the code that uses it; each field is
`Annotated` with `Setting(...)`, which carries its unit, meaning and range. `config.py` only fills
them from TOML. The documented `config/gateway.toml` and the MAVLink parameters are derived from
the same annotations, so a range is written once.
"""

import types
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Any, Literal, Union, get_args, get_origin

import msgspec


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of all settings: immutable, keyword-only; unknown keys are rejected."""


def setting(
    meaning: str,
    unit: str = "",
    *,
    ge: float | None = None,
    le: float | None = None,
    pattern: str | None = None,
    rotation: bool = False,
    path: bool = False,
    choices: Collection[str] = (),
) -> msgspec.Meta:
    """Describe one setting, as `Annotated[float, setting(...)]`.

    Parameters
    ----------
    meaning : str
        One or more sentences for the person who edits the file.
    unit : str
        Unit of the value; empty for a name, a switch or a pure number.
    ge, le, pattern : optional
        Minimum and maximum of a number; regular expression that a text must match.
    rotation : bool
        Whether the value is a rotation matrix, which is set as angles by parameters.
    path : bool
        Whether the value is a file or folder, where `~` is the home folder.
    choices : collection of str, optional
        The allowed texts if the type does not list them, as for an extensible registry. The
        settings class checks them itself.
    """
    extra = {"unit": unit, "rotation": rotation, "path": path, "choices": choices}
    if pattern is not None:
        return msgspec.Meta(description=meaning, pattern=pattern, extra=extra)
    return msgspec.Meta(description=meaning, ge=_exact(ge), le=_exact(le), extra=extra)


def _exact(bound: float | None) -> float | None:
    """Return an integral bound as an int, which msgspec requires for an int field."""
    return int(bound) if bound is not None and float(bound).is_integer() else bound


@dataclass(frozen=True, slots=True)
class Field:
    """One key of a settings class, with the facts from its annotation."""

    name: str
    type: Any
    """The annotated type, as msgspec requires it for conversion."""
    default: Any
    section: "type[Settings] | None"
    """The settings class, if the key is a section."""
    choices: tuple[str, ...]
    """The allowed texts, if the type is a choice."""
    meaning: str
    unit: str
    is_rotation: bool
    """Whether the value is a rotation matrix."""
    is_path: bool
    """Whether the value is the path of a file or folder."""
    bounds: tuple[float | None, float | None]
    """Minimum and maximum of a number, or of each component of a vector; None if there is no
    bound."""

    @property
    def range(self) -> str:
        """The bounds as text, such as `0 to 1000`; empty if there are none."""
        low, high = self.bounds
        if low is not None and high is not None:
            return f"{low:.12g} to {high:.12g}"
        if low is not None:
            return f"{low:.12g} or more"
        return "" if high is None else f"at most {high:.12g}"


def fields_of(kind: type[Settings]) -> list[Field]:
    """Return the keys of a settings class, plain keys before sections, as TOML requires."""
    found = []
    for info in msgspec.structs.fields(kind):
        factory = info.default_factory
        default = info.default if factory is msgspec.NODEFAULT else factory()
        found.append(_field(info.name, info.type, default))
    return sorted(found, key=lambda field: field.section is not None)


def _field(name: str, kind: Any, default: Any) -> Field:
    plain = _plain(kind)
    metas = list(_metas(kind)) or [msgspec.Meta()]
    meta = metas[0]
    bounded = next((m for m in metas if m.ge is not None or m.le is not None), meta)
    extra = meta.extra or {}
    listed = get_args(plain) if get_origin(plain) is Literal else extra.get("choices", ())
    return Field(
        name=name,
        type=kind,
        default=default,
        section=plain if isinstance(plain, type) and issubclass(plain, Settings) else None,
        choices=tuple(listed),
        meaning=meta.description or "",
        unit=extra.get("unit", ""),
        is_rotation=extra.get("rotation", False),
        is_path=extra.get("path", False),
        bounds=(bounded.ge, bounded.le),
    )


def _plain(kind: Any) -> Any:
    """Strip annotations and `| None` from a type."""
    while hasattr(kind, "__metadata__"):
        kind = kind.__origin__
    if get_origin(kind) in (Union, types.UnionType):
        options = [option for option in get_args(kind) if option is not type(None)]
        if len(options) == 1:
            return _plain(options[0])
    return kind


def _metas(kind: Any) -> Iterator[msgspec.Meta]:
    """Yield every `setting(...)` in a type, the outermost first."""
    for meta in getattr(kind, "__metadata__", ()):
        if isinstance(meta, msgspec.Meta):
            yield meta
    for inner in (getattr(kind, "__origin__", None), *get_args(kind)):
        if inner is not None and inner is not kind:
            yield from _metas(inner)
