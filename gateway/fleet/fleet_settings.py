"""Settings of the fleet."""

from typing import Annotated

from gateway.settings import Settings, setting


class SiteSettings(Settings, frozen=True):
    """What is different for one site."""

    name: Annotated[str, setting("The site.", pattern=r"^[A-Za-z0-9_.-]{1,64}$")]
    passphrase: Annotated[
        str,
        setting(
            "Its signing passphrase. Signed frames are checked and sealed anew with it, since a "
            "changed system id breaks a signature; without it they pass only where none changes."
        ),
    ] = ""


class FleetSettings(Settings, frozen=True):
    """Many sites as one picture: `mavgate fleet`."""

    router: Annotated[
        str, setting("Zenoh router to connect to: tcp/HOST:7447. Empty: it is a router itself.")
    ] = ""
    listen: Annotated[str, setting("Where it listens for sites, if it is the router itself.")] = (
        "tcp/127.0.0.1:7447"
    )
    sites: Annotated[
        tuple[str, ...], setting("Names of the sites to show; * stands for any letters.")
    ] = ("*",)
    zenoh_config: Annotated[
        str, setting("Zenoh's own configuration file: TLS, certificates, access control.")
    ] = ""
    ids_file: Annotated[
        str, setting("Where it is kept which system id a vehicle of a site has here.")
    ] = "~/.config/mavgate/fleet.json"
    site: Annotated[tuple[SiteSettings, ...], setting("What is different for single sites.")] = ()
