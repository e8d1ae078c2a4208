"""Servers that wait for the client to speak first, and so would be waited for in vain by whoever expects a greeting."""

import contextlib
import http.client
import json
from urllib.parse import urlsplit

SECONDS = 2.0
LARGEST = 1 << 16


def what_waits(url: str) -> str | None:
    """What a server is that took a WebSocket connection and sent no greeting, in words; None where that is not known.

    Model servers of vla-evaluation-harness say what they are at `/config` of the same port.
    """
    address = urlsplit(url)
    kind = http.client.HTTPSConnection if address.scheme == "wss" else http.client.HTTPConnection
    with contextlib.suppress(OSError, http.client.HTTPException, ValueError):
        connection = kind(address.hostname or "", address.port, timeout=SECONDS)
        try:
            connection.request("GET", "/config")
            said = json.loads(connection.getresponse().read(LARGEST))
        finally:
            connection.close()
        if isinstance(said, dict) and {"applied", "config"} <= said.keys():
            return 'is a model server of vla-evaluation-harness, which waits for the client to speak first: kind = "vla_eval" is for these'
    return None
