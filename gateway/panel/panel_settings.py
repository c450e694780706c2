"""Settings of the panel."""

from typing import Annotated, Final, Literal

from gateway.settings import Settings, setting

LOOPBACK: Final = ("127.0.0.1", "::1", "localhost")


class MapStyle(Settings, frozen=True):
    """One style of the map."""

    name: Annotated[str, setting("What the operator reads.", pattern=r"^[\w .-]{1,32}$")]
    url: Annotated[
        str,
        setting(
            "Where its tiles come from, with {z}, {x} and {y} in it: an https:// or http:// URL, "
            "or the path of an MBTiles or PMTiles file.",
        ),
    ]
    attribution: Annotated[str, setting("Whom to thank for them, as the owner asks.")] = ""
    max_zoom: Annotated[int, setting("Greatest zoom that there is.", ge=1, le=24)] = 19


class PanelSettings(Settings, frozen=True):
    """The page that shows the aircraft in a browser; a process of its own."""

    enabled: Annotated[bool, setting("Whether `mavgate run` starts it.")] = False
    address: Annotated[
        str,
        setting(
            "Where it listens. Any address but this machine's own loopback needs a password, and "
            "TLS or insecure = true."
        ),
    ] = "127.0.0.1"
    port: Annotated[int, setting("Its port; 0 takes any that is free.", ge=0, le=65535)] = 14590
    hosts: Annotated[
        tuple[str, ...],
        setting(
            "Further names by which browsers reach it, without port. It refuses all others, so "
            "that no foreign page can steer the gateway through the browser."
        ),
    ] = ()
    password: Annotated[
        str,
        setting(
            "Hash of the operator's password, as `mavgate panel --hash-password` prints it. Empty: "
            "none is asked, which only loopback allows.",
            pattern=r"^(scrypt\$.+)?$",
        ),
    ] = ""
    viewer_password: Annotated[
        str,
        setting(
            "Hash of a second password, with which one may look and not touch.",
            pattern=r"^(scrypt\$.+)?$",
        ),
    ] = ""
    certificate: Annotated[
        str, setting("PEM file of the TLS certificate, with its chain; empty for no TLS.")
    ] = ""
    certificate_key: Annotated[str, setting("PEM file of its private key.")] = ""
    insecure: Annotated[
        bool,
        setting(
            "Allow other addresses than loopback without TLS: all can read along, passwords too."
        ),
    ] = False
    units: Annotated[
        Literal["metric", "imperial", "aviation"],
        setting("Units at first; each browser may choose its own."),
    ] = "metric"
    tiles_folder: Annotated[str, setting("Where map tiles are kept once they were seen.")] = (
        "~/.cache/mavgate/tiles"
    )
    tiles_limit_mb: Annotated[
        int, setting("What they may take; beyond it the oldest go.", "MB", ge=0, le=1_000_000)
    ] = 500
    upload_limit_mb: Annotated[
        int, setting("Largest recording that a browser may bring.", "MB", ge=1, le=100_000)
    ] = 512
    map_styles: Annotated[
        tuple[MapStyle, ...], setting("Styles of the map, the first one shown at first.")
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
        """Refuse to stand open to others without a lock."""
        if self.address in LOOPBACK:
            return
        if not self.password:
            raise ValueError(f"address {self.address!r} is not loopback: it needs a password")
        if not (self.certificate or self.insecure):
            raise ValueError(
                f"address {self.address!r} is not loopback: it needs a certificate, or "
                "insecure = true if everybody may read along"
            )
