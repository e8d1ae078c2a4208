"""Going on from a decision point with another policy: what would have come of handing over there."""

from osel_sim.core.errors import UsageError
from osel_sim.episodes.handoffs import decided
from osel_sim.episodes.loop import Moment
from osel_sim.interface.monitor import Turn
from osel_sim.interface.outcome import Outcome


def go_on(moment: Moment, policy: str) -> Outcome:
    """Go back to a decision point and let another policy drive from there to the end; no more decision points follow.

    Steps, time, price and chance are those of the episode so far, so this is to the bit what would have come of it had a monitor said so there.

    Args:
        moment: kept there by `osel_sim.episodes.handoffs.Handoffs.cut`. It stays as it is, to go on from again.
        policy: one of the policies of the episode's `Handoffs`, other than the driver.

    Returns:
        the outcome of the whole episode, from its beginning.

    Raises:
        UsageError: the driver is to hand over to itself (what comes of that, the episode itself tells), or there is no such policy.
    """
    episode = moment.episode.twin()
    watch = episode.watch
    if watch is None or policy == moment.point.driver:
        raise UsageError(f"an episode goes on from a decision point with another policy than {policy!r}, which drives there already")
    turn = Turn(policy)
    turn.check(watch.handoffs.policies)
    episode.show_to(())
    episode.env.restore(moment.snapshot)
    driver, _ = watch.hand_over(episode, turn)
    return decided(episode.course(episode.drive_on(driver, decide=False), None), None)
