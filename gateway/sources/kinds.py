"""Kinds of sources by the scheme of their URLs; other packages can add more."""

from collections.abc import Callable
from dataclasses import replace
from typing import Final

from gateway.printable import unknown_choice
from gateway.records import NodeId
from gateway.sources.crsf import CrsfDecoder
from gateway.sources.lines import LinesDecoder
from gateway.sources.ltm import LtmDecoder
from gateway.sources.phone import PhoneDecoder
from gateway.sources.settings import (
    MAX_VEHICLE,
    OPTIONS,
    SourceSettings,
    SourceUrl,
    nodes_of,
    parse_source,
)
from gateway.sources.source import PolledDecoder, SourceDecoder, SourceInput

SourceKind = Callable[[SourceUrl, NodeId], SourceDecoder]
"""Makes a decoder from the URL with its options, and the node of its records; raises ValueError
for an invalid option."""

SOURCE_KINDS: Final[dict[str, tuple[SourceKind, tuple[str, ...]]]] = {
    "lines": (LinesDecoder, ("columns", "names")),
    "crsf": (CrsfDecoder, ("pitch", "type")),
    "ltm": (LtmDecoder, ("pitch", "type")),
    "phone": (PhoneDecoder, ("sensors", "geoid_m")),
}
"""Decoder and options by kind."""


def add_source_kind(name: str, make: SourceKind, options: tuple[str, ...] = ()) -> None:
    """Add a kind of source.

    Parameters
    ----------
    name : str
        Scheme of its URLs.
    make : callable
        Makes the decoder from a parsed URL and the node of its records.
    options : tuple of str
        Names of its URL options, in addition to those of all sources.

    Raises
    ------
    ValueError
        If the name exists already.
    """
    if name in SOURCE_KINDS:
        raise ValueError(f"source kind {name!r} exists already")
    SOURCE_KINDS[name] = (make, options)


def check_source(url: SourceUrl) -> None:
    """Raise ValueError for an unknown kind or option, or an option that is not a number."""
    if url.kind not in SOURCE_KINDS:
        raise ValueError(f"source {url.name!r}: {unknown_choice('kind', url.kind, SOURCE_KINDS)}")
    _, own = SOURCE_KINDS[url.kind]
    allowed = (*OPTIONS, *own)
    if unknown := [name for name in url.options if name not in allowed]:
        raise ValueError(
            f"source {url.name!r}: unknown option {unknown[0]!r}; there are {', '.join(allowed)}"
        )
    if not url.options.get("id", "1").isdecimal():
        raise ValueError(f"source {url.name!r}: id must be a whole number")
    if not 1 <= int(url.options.get("id", 1)) <= MAX_VEHICLE:
        raise ValueError(f"source {url.name!r}: id must be 1 to {MAX_VEHICLE}")


def make_decoder(url: SourceUrl, node: NodeId) -> SourceDecoder:
    """Make the decoder of a URL; raises ValueError as `check_source`."""
    check_source(url)
    make, _ = SOURCE_KINDS[url.kind]
    decoder = make(url, node)
    if url.transport == "poll" and not isinstance(decoder, PolledDecoder):
        raise ValueError(f"source {url.name!r}: {url.kind} cannot be polled")
    return decoder


def make_sources(
    settings: tuple[SourceSettings, ...], read: Callable[[str], str]
) -> list[SourceInput]:
    """Make all sources of the settings; raises ValueError as `make_decoder`.

    `read` returns the text of a file, such as a column map.
    """
    found = []
    for each, node in zip(settings, nodes_of(settings), strict=True):
        url = parse_source(each.url)
        if path := url.options.get("columns"):
            url = replace(url, options=url.options | {"columns": read(path)})
        found.append(SourceInput(url, node, make_decoder(url, node)))
    return found
