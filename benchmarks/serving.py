"""How many robots a policy server drives: answers a second, one after another and together (`serve --batch-ms`), for 1, 8 and 32 clients.

    python benchmarks/serving.py [--policy remote_base] [--seconds 10] [--batch-ms 5]

Servers are processes of their own, as `serve` starts them; clients are threads of this one, each of which asks as soon as it has its answer. The last
line is JSON: answers a second by number of clients, `alone` and `together`, and their `ratio`.
"""

import argparse
import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

from osel_sim.formats import library
from osel_sim.interface.specification import specification
from osel_sim.remote.client import RemoteClient
from osel_sim.remote.protocol import TOKEN_VARIABLE, Greeting, differing_observations

TOKEN = "benchmark-token"


@contextlib.contextmanager
def serving(policy: str, *flags: str) -> Iterator[str]:
    """A server's address."""
    command = [sys.executable, "-m", "osel_sim.serve", policy, "--port", "0", *flags]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, TOKEN_VARIABLE: TOKEN})
    try:
        yield json.loads(server.stdout.readline())["url"]
    finally:
        server.terminate()
        server.communicate()


def answers_a_second(url: str, greeting: Greeting, clients: int, seconds: float) -> float:
    """Answers of all clients together, after each has had one."""
    shown = differing_observations(greeting, clients)
    counts, ready, end = [0] * clients, threading.Barrier(clients + 1), [0.0]

    def ask(number: int) -> None:
        with RemoteClient(url, specification(), TOKEN, timeout=600.0) as client:
            client.act(shown[number])
            ready.wait()
            ready.wait()
            while time.perf_counter() < end[0]:
                client.act(shown[number])
                counts[number] += 1

    threads = [threading.Thread(target=ask, args=(number,)) for number in range(clients)]
    for thread in threads:
        thread.start()
    ready.wait()
    start = time.perf_counter()
    end[0] = start + seconds
    ready.wait()
    for thread in threads:
        thread.join()
    return sum(counts) / (time.perf_counter() - start)


def main() -> None:
    parser = argparse.ArgumentParser(description="Answers a second of a policy server.")
    parser.add_argument("--policy", default="remote_base")
    parser.add_argument("--clients", type=int, nargs="+", default=[1, 8, 32])
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--batch-ms", type=float, default=5.0)
    options = parser.parse_args()
    greeting = Greeting.of(library.load_policy(options.policy))
    with serving(options.policy) as alone, serving(options.policy, "--batch-ms", str(options.batch_ms)) as together:
        # Side by side, so that what else the machine does in the meantime meets both.
        found = {
            str(clients): {
                "alone": round(answers_a_second(alone, greeting, clients, options.seconds), 2),
                "together": round(answers_a_second(together, greeting, clients, options.seconds), 2),
            }
            for clients in options.clients
        }
    for clients, figures in found.items():
        print(f"{clients:>3} clients: {figures['alone']:7.2f} answers a second one after another, {figures['together']:7.2f} together")
    ratio = {clients: round(figures["together"] / figures["alone"], 2) if figures["alone"] else None for clients, figures in found.items()}
    print(json.dumps({"policy": options.policy, "batch_ms": options.batch_ms, **found, "ratio": ratio}))


if __name__ == "__main__":
    main()
