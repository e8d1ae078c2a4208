"""Proxies, as the environment names them: which one a connection goes through, and how to except a host."""

import ipaddress
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass

from osel_sim.core.shown import shown

VARIABLES = ("WS_PROXY", "WSS_PROXY", "SOCKS_PROXY", "HTTPS_PROXY", "HTTP_PROXY", "ALL_PROXY", "NO_PROXY")
"""All that HTTP and WebSocket clients look at, in small letters as well."""
CERTIFICATES = ("SSL_CERT_FILE", "SSL_CERT_DIR")


@dataclass(frozen=True)
class Proxy:
    """A proxy.

    Attributes:
        address: with its scheme.
        variable: that names it.
    """

    address: str
    variable: str

    @property
    def socks(self) -> bool:
        """Whether it speaks SOCKS, which needs a package of its own."""
        return self.address.startswith("socks")

    def __str__(self) -> str:
        return f"the proxy {shown(self.address)} ({self.variable})"


def proxy_for(url: str) -> Proxy | None:
    """The proxy that a connection to a WebSocket address goes through, as `websockets` chooses it.

    None for this machine, and for what NO_PROXY excepts: names, addresses, networks.
    """
    from websockets.exceptions import InvalidURI
    from websockets.proxy import get_proxy
    from websockets.uri import parse_uri

    try:
        uri = parse_uri(url)
    except (InvalidURI, ValueError):  # no address: whoever connects says so
        return None
    if is_loopback(uri.host) or _within_excepted(uri.host):
        return None
    address = get_proxy(uri)
    return None if address is None else Proxy(address if "://" in address else f"http://{address}", _variable(address))


def settings(environment: Mapping[str, str] = os.environ) -> list[str]:
    """What the environment says about proxies, and about certificates that are not there, as `NAME=value` without secrets."""
    names = [name for variable in VARIABLES for name in (variable, variable.lower()) if environment.get(name)]
    names += [name for name in CERTIFICATES if environment.get(name) and not os.path.exists(environment[name])]
    return [shown(f"{name}={environment[name][:80]}") for name in names]


def is_loopback(host: str) -> bool:
    """Whether a host is this machine."""
    with suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"


def _within_excepted(host: str) -> bool:
    said = os.environ.get("no_proxy") or os.environ.get("NO_PROXY") or ""
    return any(_within(host, entry.strip().strip("[]")) for entry in said.split(","))


def _within(host: str, network: str) -> bool:
    """Whether a host is an address of a network such as 192.168.0.0/16 or fd00::/8, which the standard library does not read."""
    with suppress(ValueError):
        return ipaddress.ip_address(host) in ipaddress.ip_network(network, strict=False)
    return False


def _variable(address: str) -> str:
    """That names a proxy; as the environment spells it."""
    place = address.rpartition("://")[2]
    spelt = (name for variable in VARIABLES for name in (variable.lower(), variable))
    return next((name for name in spelt if os.environ.get(name, "").rpartition("://")[2] == place), "of the system's settings")
