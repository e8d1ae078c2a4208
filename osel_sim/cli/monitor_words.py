"""What a run's monitor came to, in a sentence for the terminal."""

from collections.abc import Mapping
from typing import Any


def monitor_words(name: str, summary: Mapping[str, Any]) -> str:
    """The sentence; `summary` is a run's, with its part `monitor`."""
    told = summary["monitor"]
    prices = ", ".join(f"{policy} {price:.2f}" for policy, price in told["price_by_policy"].items())
    words = (
        f"Monitor {name}: {told['handoffs']:.2f} handoffs an episode; remote policies drove {100 * told['duty_steps']:.0f}% of the steps and had "
        f"{100 * told['duty_calls']:.0f}% of the calls; cents an episode: {prices}"
    )
    if "with" in told:
        words += f"; mean reward {told['with']:.3f}, of the same choices without it {told['without']:.3f} ({told['compared_decisions']} decisions)"
    return words
