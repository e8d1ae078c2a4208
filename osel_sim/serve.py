"""Serve a policy file over WebSocket: `python -m osel_sim.serve remote_large --port 8000`."""

import logging
import sys

from osel_sim.api.serve import ServeConfig, serve
from osel_sim.cli.command import Command
from osel_sim.remote.serving import ShownFormatter

EXAMPLES = """examples:
  python -m osel_sim.serve remote_large                       # 127.0.0.1:8000; makes a token and prints it
  OSEL_SIM_TOKEN=... python -m osel_sim.serve remote_large --host 0.0.0.0 --port 8000
  python -m osel_sim.serve my_policy --policies-dir my_policies

Clients are osel_sim itself (url = "ws://host:8000" in a policy file) and openpi's WebsocketClientPolicy(host, port, api_key=TOKEN).
One line of JSON on standard output says when it is ready. GET /healthz needs no token."""


def _execute(config: ServeConfig) -> int:
    handler = logging.StreamHandler()
    handler.setFormatter(ShownFormatter("%(levelname)s %(name)s: %(message)s"))
    logging.basicConfig(handlers=[handler], level=logging.WARNING)
    serve(config)
    return 0


main = Command("serve", ServeConfig, _execute, EXAMPLES)

if __name__ == "__main__":
    sys.exit(main())
