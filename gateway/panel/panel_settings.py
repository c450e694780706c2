"""Settings of the panel."""

import base64
import re
from typing import Annotated, Final, Literal

from gateway.hub.endpoint import is_loopback
from gateway.settings import Settings, setting

ORIGIN: Final = re.compile(r"https?://[a-z0-9.-]+(:\d{1,5})?|https?://\[[0-9a-f:]+\](:\d{1,5})?")
"""Origin of a page as a browser writes it; the port only if it is not the default one."""
LEAST_COST: Final = 1 << 14
"""Least N of scrypt: a smaller one makes a stolen hash easy to guess."""
LEAST_BYTES: Final = 16
"""Least length of salt and of digest."""


class MapStyle(Settings, frozen=True):
    """One style of the map."""

    name: Annotated[str, setting("Name shown to the operator.", pattern=r"^[\w .-]{1,32}$")]
    url: Annotated[
        str,
        setting(
            "Source of its tiles: an https:// or http:// URL with {z}, {x} and {y} in it, or the "
            "path of an MBTiles or PMTiles file.",
        ),
    ]
    attribution: Annotated[str, setting("Attribution that the owner requires.")] = ""
    max_zoom: Annotated[int, setting("Greatest available zoom.", ge=1, le=24)] = 19


def why_weak(hashed: str) -> str:
    """Return the reason why a password's hash is not accepted; empty if it is."""
    try:
        _, cost, *parts = hashed.split("$")
        number = int(cost) if cost.isascii() and cost.isdigit() and len(cost) < 9 else 0
        salt, digest = (base64.b64decode(part, validate=True) for part in parts)
    except ValueError:
        return "it is not scrypt$N$salt$hash"
    if number & (number - 1) or number < LEAST_COST:
        return f"its N is not a power of two of at least {LEAST_COST}"
    if min(len(salt), len(digest)) < LEAST_BYTES:
        return f"its salt and its hash must have at least {LEAST_BYTES} bytes"
    return ""


class PanelSettings(Settings, frozen=True):
    """The web page that shows the aircraft; a separate process."""

    enabled: Annotated[bool, setting("Whether `mavgate run` starts the panel.")] = False
    address: Annotated[
        str,
        setting(
            "Address to listen on. Any address but loopback needs a password, and "
            "TLS or insecure = true."
        ),
    ] = "127.0.0.1"
    port: Annotated[int, setting("Port to listen on; 0 for any free one.", ge=0, le=65535)] = 14590
    hosts: Annotated[
        tuple[str, ...],
        setting(
            "Further host names of the panel, without port. All others are refused, so "
            "that no foreign page can control the gateway through the browser."
        ),
    ] = ()
    origins: Annotated[
        tuple[str, ...],
        setting(
            "Pages of other programs that may use the JSON API through the browser, as in "
            "https://example.org:8080. They have the rights of the browser's login."
        ),
    ] = ()
    password: Annotated[
        str,
        setting(
            "Hash of the operator's password, as `mavgate panel --hash-password` prints it. Empty: "
            "no password, which only loopback allows.",
            pattern=r"^(scrypt\$.+)?$",
        ),
    ] = ""
    viewer_password: Annotated[
        str,
        setting(
            "Hash of a second password, for read-only access.",
            pattern=r"^(scrypt\$.+)?$",
        ),
    ] = ""
    certificate: Annotated[
        str,
        setting("PEM file of the TLS certificate, with its chain; empty for no TLS.", path=True),
    ] = ""
    certificate_key: Annotated[
        str,
        setting("PEM file of the private key; empty if it is in the same file.", path=True),
    ] = ""
    insecure: Annotated[
        bool,
        setting("Allow other addresses than loopback without TLS; then all traffic is readable."),
    ] = False
    units: Annotated[
        Literal["metric", "imperial", "aviation"],
        setting("Default units; each browser may choose its own."),
    ] = "metric"
    tiles_folder: Annotated[str, setting("Folder of cached map tiles.")] = "~/.cache/mavgate/tiles"
    tiles_limit_mb: Annotated[
        int,
        setting(
            "Maximum size of the cached tiles; beyond it the oldest are deleted.",
            "MB",
            ge=0,
            le=1_000_000,
        ),
    ] = 500
    upload_limit_mb: Annotated[
        int, setting("Largest recording or map that a browser may upload.", "MB", ge=1, le=100_000)
    ] = 512
    map_styles: Annotated[
        tuple[MapStyle, ...], setting("Styles of the map; the first one is the default.")
    ] = (
        MapStyle(
            name="Street",
            url="https://tile.openstreetmap.org/{z}/{x}/{y}.png",
            attribution="© OpenStreetMap contributors",
        ),
        MapStyle(
            name="Satellite",
            url=(
                "https://server.arcgisonline.com/ArcGIS/rest/services/World_Imagery/MapServer/"
                "tile/{z}/{y}/{x}"
            ),
            attribution="© Esri, Maxar, Earthstar Geographics",
        ),
        MapStyle(
            name="Topographic",
            url="https://a.tile.opentopomap.org/{z}/{x}/{y}.png",
            attribution="© OpenStreetMap contributors, SRTM; © OpenTopoMap (CC-BY-SA)",
            max_zoom=17,
        ),
    )

    def __post_init__(self) -> None:
        """Refuse an address for other machines without password, and a key without certificate."""
        for name in ("password", "viewer_password"):
            if (hashed := getattr(self, name)) and (why := why_weak(hashed)):
                raise ValueError(f"{name}: {why}; `mavgate panel --hash-password` makes one")
        for origin in self.origins:
            if not ORIGIN.fullmatch(origin):
                raise ValueError(
                    f"origins: {origin!r} is not like https://example.org:8080, in lower case"
                )
        if self.certificate_key and not self.certificate:
            raise ValueError("certificate_key is set: it needs a certificate")
        if is_loopback(self.address):
            return
        if not self.password:
            raise ValueError(f"address {self.address!r} is not loopback: it needs a password")
        if not (self.certificate or self.insecure):
            raise ValueError(
                f"address {self.address!r} is not loopback: it needs a certificate, or "
                "insecure = true if anybody may read everything"
            )
