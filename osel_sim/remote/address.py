"""Where a policy server listens."""

import socket

from osel_sim.core.errors import RemoteError


def check_address(host: str, port: int) -> None:
    """Whether a server could listen there, before it loads its weights.

    Raises:
        RemoteError: the address cannot be used.
    """
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        with socket.socket(family, kind) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        raise cannot_listen(host, port, error) from None


def cannot_listen(host: str, port: int, error: OSError) -> RemoteError:
    """The error of an address that cannot be used."""
    return RemoteError(f"cannot listen on {host}:{port} ({error.strerror or error})")
