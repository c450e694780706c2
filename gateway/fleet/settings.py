"""Settings of the fleet."""

from typing import Annotated

from gateway.settings import Settings, setting


class SiteSettings(Settings, frozen=True):
    """Settings of one site."""

    name: Annotated[str, setting("Name of the site.", pattern=r"^[A-Za-z0-9_.-]{1,64}$")]
    passphrase: Annotated[
        str,
        setting(
            "Signing passphrase of the site. With one, all its frames must be signed: unsigned, "
            "forged and replayed ones are dropped and counted. Signatures are renewed where a "
            "system id changes."
        ),
    ] = ""


class FleetSettings(Settings, frozen=True):
    """The fleet, which joins the vehicles of many sites: `mavgate fleet`."""

    router: Annotated[
        str, setting("Zenoh router to connect to: tls/HOST:7447. Empty: the fleet is the router.")
    ] = ""
    listen: Annotated[
        str,
        setting(
            "Address at which the router listens for sites. Beyond loopback it needs TLS with "
            "client certificates, or user and password, in zenoh_config."
        ),
    ] = "tcp/127.0.0.1:7447"
    insecure: Annotated[
        bool,
        setting(
            "Listen beyond loopback without authentication: everyone who reaches the port reads "
            "all telemetry and can command and imitate every vehicle."
        ),
    ] = False
    sites: Annotated[
        tuple[str, ...], setting("Names of the sites to show; * matches any characters.")
    ] = ("*",)
    zenoh_config: Annotated[
        str, setting("Zenoh's own configuration file: TLS, certificates, access control.")
    ] = ""
    vehicles_per_site: Annotated[
        int, setting("Maximum system ids of a site, and of all sites of a client.", ge=1, le=249)
    ] = 50
    ids_file: Annotated[str, setting("File that keeps the system ids of all vehicles.")] = (
        "~/.config/mavgate/fleet.json"
    )
    site: Annotated[tuple[SiteSettings, ...], setting("Settings of single sites.")] = ()
