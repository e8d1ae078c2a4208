"""What drives the robot: the contract, the kinds, and asking one for actions."""


def register() -> None:
    """Make our policy types and processor steps known to LeRobot's factory."""
    import osel_sim.policy.language_chunk
    import osel_sim.policy.octo_chunk
    import osel_sim.policy.perception_step  # noqa: F401
