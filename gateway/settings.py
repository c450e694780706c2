"""What every stage's settings share: frozen, strict, and documented where they stand.

A stage declares its own `…Settings(Settings)` beside the code that uses it; each field is
`Annotated` with `Setting(...)`, which carries its unit, meaning and range. `config.py` only fills
them from TOML. The documented `config/gateway.toml` and the MAVLink parameters are derived from
the same annotations, so a range is written once.
"""

import msgspec


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of all settings: immutable, keyword-only, unknown keys refused."""


def setting(
    meaning: str,
    unit: str = "",
    *,
    ge: float | None = None,
    le: float | None = None,
    pattern: str | None = None,
) -> msgspec.Meta:
    """Describe one setting: meaning, unit and what is allowed.

    Parameters
    ----------
    meaning : str
        One or more sentences for the person who edits the file.
    unit : str
        Unit of the value; empty for a name, a switch or a pure number.
    ge, le : float, optional
        Least and greatest allowed number.
    pattern : str, optional
        Regular expression that a text must match.

    Returns
    -------
    msgspec.Meta
        To be used as `Annotated[float, setting(...)]`.
    """
    extra = {"unit": unit}
    if pattern is not None:
        return msgspec.Meta(description=meaning, pattern=pattern, extra=extra)
    return msgspec.Meta(description=meaning, ge=ge, le=le, extra=extra)
